// The reader of USDZ that comes with three.js; it knows no animation and shows the first moment.
// Usage: node read_usdz.mjs FILE.usdz
// Prints {meshes: [{name, corners: [[x, y, z], ...], uvs: [[u, v], ...], textured}]}; three corners are a triangle.
import { readFile } from "node:fs/promises";

globalThis.self ??= globalThis; // three.js looks for a browser
const picture = { addEventListener() {}, removeEventListener() {} }; // and for its decoder of pictures
globalThis.document ??= { createElementNS: () => picture };
const { USDLoader } = await import("three/examples/jsm/loaders/USDLoader.js");

const content = new Uint8Array(await readFile(process.argv[2]));
const scene = new USDLoader().parse(content.buffer);
const rows = (attribute) => {
  const { array, itemSize, count } = attribute;
  return Array.from({ length: count }, (_, i) => Array.from(array.slice(i * itemSize, (i + 1) * itemSize)));
};
const meshes = [];
scene.traverse((thing) => {
  if (!thing.isMesh || !thing.geometry.attributes.position) return;
  const { position, uv } = thing.geometry.attributes;
  meshes.push({ name: thing.name, corners: rows(position), uvs: rows(uv), textured: thing.material.map !== null });
});
console.log(JSON.stringify({ meshes }));
