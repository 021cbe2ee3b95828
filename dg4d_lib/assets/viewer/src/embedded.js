// What the page was filled with, by the id of its elements: deflated bytes in base64, or JSON.

/** The bytes of a block; null if the page has none of this name. */
export async function bytesOf(name) {
  const element = document.getElementById(`data-${name}`);
  if (!element) return null;
  const text = atob(element.textContent);
  element.remove(); // the bytes are enough
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return inflate(bytes);
}

/** The bytes behind a zlib stream. */
export async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** The provenance: nested objects of strings and numbers. */
export function facts() {
  return JSON.parse(document.getElementById("data-facts").textContent);
}

/** An address under which an element of the page can show bytes. */
export function addressOf(bytes, type) {
  return URL.createObjectURL(new Blob([bytes], { type }));
}
