// The reader of KHR_gaussian_splatting that comes with three.js.
// Usage: node read_splat_glb.mjs FILE.glb
// Prints {centers: [[x, y, z], ...], covariances: [[xx, xy, xz, yy, yz, zz], ...], colors: [[r, g, b, a], ...]};
// colors are bytes.
import { readFile } from "node:fs/promises";

globalThis.self ??= globalThis; // three.js looks for a browser
const addons = "three/examples/jsm/loaders";
const { GLTFLoader } = await import(`${addons}/GLTFLoader.js`);
const { GLTFGaussianSplatLoaderExtension } = await import(`${addons}/GLTFGaussianSplatLoaderExtension.js`);

const loader = new GLTFLoader();
loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
const content = new Uint8Array(await readFile(process.argv[2]));
const { scene } = await loader.parseAsync(content.buffer, "");
const splats = scene.getObjectByProperty("isGaussianSplat", true).splatGeometry;
const rows = (name) => {
  const { array, itemSize, count } = splats.getAttribute(name);
  return Array.from({ length: count }, (_, i) => Array.from(array.slice(i * itemSize, (i + 1) * itemSize)));
};
console.log(JSON.stringify({ centers: rows("position"), covariances: rows("covariance"), colors: rows("color") }));
