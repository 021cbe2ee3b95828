// Stable counting sort by depth into 65,536 layers.

const LAYERS = 65536;
const starts = new Uint32Array(LAYERS + 1);
let layers = new Uint16Array(0);
let depths = new Float32Array(0);

/**
 * Sorts the indices of points from far to near.
 * @param {Float32Array} rows - rows of `stride` numbers that start with a position.
 * @param {number[]} view - world-to-camera matrix, column-major; the camera looks along -z.
 * @param {Uint32Array} order - output.
 */
export function farToNear(rows, stride, count, view, order) {
  if (layers.length < count) [layers, depths] = [new Uint16Array(count), new Float32Array(count)];
  let [least, most] = [Infinity, -Infinity];
  for (let i = 0, at = 0; i < count; i++, at += stride) {
    const depth = view[2] * rows[at] + view[6] * rows[at + 1] + view[10] * rows[at + 2];
    depths[i] = depth;
    if (depth < least) least = depth;
    if (depth > most) most = depth;
  }
  const scale = most > least ? (LAYERS - 1) / (most - least) : 0;
  starts.fill(0);
  for (let i = 0; i < count; i++) {
    layers[i] = (depths[i] - least) * scale; // cut to a whole number
    starts[layers[i] + 1]++;
  }
  for (let k = 0; k < LAYERS; k++) starts[k + 1] += starts[k];
  for (let i = 0; i < count; i++) order[starts[layers[i]]++] = i;
}
