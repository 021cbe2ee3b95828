// Data embedded in the page, by element id: deflated bytes in base64, or JSON.

/** Returns the bytes of a block; null if the page has none of this name. */
export async function bytesOf(name) {
  const element = document.getElementById(`data-${name}`);
  if (!element) return null;
  const text = atob(element.textContent);
  element.remove(); // frees the base64 text
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return inflate(bytes);
}

/** Decompresses a zlib stream. */
export async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Returns the provenance: nested objects of strings and numbers. */
export function facts() {
  return JSON.parse(document.getElementById("data-facts").textContent);
}

/** Returns `radius`, `target` and `whole_fov_y_deg` of the input camera; empty in pages without them. */
export function camera() {
  return JSON.parse(document.getElementById("data-camera")?.textContent ?? "{}");
}

/** Returns an object URL for bytes. */
export function addressOf(bytes, type) {
  return URL.createObjectURL(new Blob([bytes], { type }));
}
