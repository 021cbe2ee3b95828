// Decoder of animated splats; the format is documented in dg4d_lib/assets/formats/web_splats.py.
import { inflate } from "./embedded.js";

const MAGIC = "D4WS";

/** Decodes a file to `MovingSplats`. */
export async function readSplats(bytes) {
  const { buffer, byteOffset } = bytes;
  if (new TextDecoder().decode(bytes.subarray(0, 4)) !== MAGIC) throw new Error("the splat data is not in the .websplats format");
  const start = 8 + new DataView(buffer, byteOffset).getUint32(4, true);
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(8, start)));
  return new MovingSplats(header, await inflate(bytes.subarray(start)));
}

class MovingSplats {
  constructor(header, content) {
    const { count, frames } = header;
    Object.assign(this, header);
    this.duration = frames / header.fps;
    this.colors = content.subarray(0, 4 * count); // red, green, blue, opacity; one after the other
    const size = frames * 3 * count;
    const fields = [0, 1, 2].map((k) => content.subarray(4 * count + 2 * k * size, 4 * count + 2 * (k + 1) * size));
    [this.places, this.turns, this.sizes] = fields.map((field) => undone(field, frames, count));
    this.states = new Map(); // the frames that were asked for last
  }

  /** Writes the state at a time into rows of 12 numbers: position and 0, quaternion xyzw, log scales and 0. */
  at(seconds, rows) {
    const position = (seconds * this.fps) % this.frames;
    const before = Math.floor(position);
    const share = position - before;
    const [a, b] = [before, (before + 1) % this.frames].map((frame) => this.state(frame));
    this.states = new Map([[before, a], [(before + 1) % this.frames, b]]);
    for (let i = 0; i < rows.length; i += 12) {
      for (let k = i; k < i + 3; k++) {
        rows[k] = a[k] + share * (b[k] - a[k]);
        rows[k + 8] = a[k + 8] + share * (b[k + 8] - a[k + 8]);
      }
      const q = i + 4; // of the two signs of a rotation, the nearer one
      const near = a[q] * b[q] + a[q + 1] * b[q + 1] + a[q + 2] * b[q + 2] + a[q + 3] * b[q + 3] < 0 ? -share : share;
      for (let k = q; k < q + 4; k++) rows[k] = (1 - share) * a[k] + near * b[k];
    }
  }

  /** Returns the rows of one frame. */
  state(frame) {
    const kept = this.states.get(frame);
    if (kept) return kept;
    const rows = new Float32Array(12 * this.count);
    const field = (values, axis) => values.subarray((3 * frame + axis) * this.count, (3 * frame + axis + 1) * this.count);
    const [x, y, z] = [0, 1, 2].map((axis) => field(this.turns, axis));
    for (let axis = 0; axis < 3; axis++) {
      const [place, size] = [field(this.places, axis), field(this.sizes, axis)];
      for (let i = 0; i < this.count; i++) {
        rows[12 * i + axis] = this.corner[axis] + this.position_step * place[i];
        rows[12 * i + 8 + axis] = this.scale_step * size[i];
      }
    }
    for (let i = 0; i < this.count; i++) {
      const angle = this.rotation_step * Math.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i]);
      const along = angle > 0 ? (this.rotation_step * Math.sin(angle / 2)) / angle : 0;
      rows[12 * i + 4] = along * x[i];
      rows[12 * i + 5] = along * y[i];
      rows[12 * i + 6] = along * z[i];
      rows[12 * i + 7] = Math.cos(angle / 2);
    }
    return rows;
  }
}

/** Decodes low and high bytes of zigzag differences, over Gaussians first and then over frames. */
function undone(bytes, frames, count) {
  const size = frames * 3 * count;
  const values = new Int16Array(size); // wraps around, as the writer's does
  for (let i = 0; i < size; i++) {
    const zigzag = bytes[i] | (bytes[size + i] << 8);
    values[i] = (zigzag >>> 1) ^ -(zigzag & 1);
  }
  for (let i = 0; i < size; i++) if (i % count) values[i] += values[i - 1];
  for (let i = 3 * count; i < size; i++) values[i] += values[i - 3 * count];
  return values;
}
