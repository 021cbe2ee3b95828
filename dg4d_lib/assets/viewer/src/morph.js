// Morph targets evaluated on the CPU: supports any number of frames, and only those of non-zero weight cost time.
import { BufferAttribute } from "three";

export class Morph {
  /** Replaces three.js's morphing of a mesh. */
  constructor(mesh) {
    const { geometry } = mesh;
    this.weights = mesh.morphTargetInfluences; // the animation writes into it
    this.rest = floats(geometry.attributes.position);
    this.targets = geometry.morphAttributes.position;
    this.position = new BufferAttribute(this.rest.slice(), 3);
    geometry.setAttribute("position", this.position);
    geometry.morphAttributes = {};
  }

  update() {
    const moved = this.position.array;
    moved.set(this.rest);
    this.weights.forEach((weight, i) => {
      if (weight === 0) return;
      const target = this.offsets(i);
      for (let k = 0; k < moved.length; k++) moved[k] += weight * target[k];
    });
    this.position.needsUpdate = true;
  }

  offsets(i) {
    if (this.targets[i].isBufferAttribute || this.targets[i].isInterleavedBufferAttribute) {
      this.targets[i] = floats(this.targets[i]);
    }
    return this.targets[i];
  }
}

/** Converts an attribute of any component type to rows of three floats. */
function floats(attribute) {
  const rows = new Float32Array(3 * attribute.count);
  for (let i = 0; i < attribute.count; i++) {
    rows[3 * i] = attribute.getX(i);
    rows[3 * i + 1] = attribute.getY(i);
    rows[3 * i + 2] = attribute.getZ(i);
  }
  return rows;
}
