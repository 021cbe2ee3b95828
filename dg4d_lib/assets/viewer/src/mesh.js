// Animated mesh of a GLB, unlit with its baked colors, or as a clay model with wireframe.
import { AnimationMixer, DoubleSide, Mesh, MeshBasicMaterial, MeshLambertMaterial } from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { MeshoptDecoder } from "three/examples/jsm/libs/meshopt_decoder.module.js";
import { Morph } from "./morph.js";
import { pointersOf } from "./pointers.js";

const CLAY = { color: 0xc9ced8, side: DoubleSide, flatShading: true, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 };
const EDGES = { color: 0x1f3a7a, wireframe: true, transparent: true, opacity: 0.38 };
const EARLY = 2e-5; // seconds; the key of a frame may lie a little after its time, because keys are float32

/** Parses a GLB; its first animation is played. */
export async function readMesh(bytes) {
  const loader = new GLTFLoader().setMeshoptDecoder(MeshoptDecoder);
  const gltf = await loader.parseAsync(bytes.buffer, "");
  return new AnimatedMesh(gltf, await pointersOf(gltf));
}

class AnimatedMesh {
  constructor(gltf, pointers) {
    this.object = gltf.scene;
    this.pointers = pointers;
    this.parts = [];
    this.object.traverse((node) => node.isMesh && this.parts.push(node));
    this.morphs = this.parts.filter((part) => part.geometry.morphAttributes.position).map((part) => new Morph(part));
    this.clay = new MeshLambertMaterial(CLAY);
    const edges = new MeshBasicMaterial(EDGES);
    this.colored = this.parts.map((part) => flat(part.material));
    this.pointers.connect(this.parts.map((part) => part.material), this.colored);
    this.edges = this.parts.map((part) => new Mesh(part.geometry, edges));
    this.edges.forEach((lines, i) => this.parts[i].add(lines));
    for (const drawn of [...this.parts, ...this.edges]) drawn.frustumCulled = false; // bounding spheres do not include the morph targets
    const [clip] = gltf.animations;
    this.duration = Math.max(clip?.duration ?? 0, pointers.duration);
    const keys = [...(clip?.tracks ?? []), ...pointers.tracks].map(({ times }) => times);
    this.fps = Math.round(1e3 / Math.min(...keys.map(shortest))) / 1e3; // 0 if nothing moves
    this.mixer = new AnimationMixer(this.object);
    if (clip) this.mixer.clipAction(clip).play();
    this.show("mesh");
    this.seek(0);
  }

  /** Selects "mesh" or "wireframe"; any other mode hides the mesh. */
  show(what) {
    this.object.visible = what === "mesh" || what === "wireframe";
    this.parts.forEach((part, i) => (part.material = what === "wireframe" ? this.clay : this.colored[i]));
    this.edges.forEach((lines) => (lines.visible = what === "wireframe"));
  }

  seek(seconds) {
    const time = this.duration > 0 ? (seconds + EARLY) % this.duration : 0;
    this.mixer.setTime(time);
    this.pointers.seek(time);
    this.morphs.forEach((morph) => morph.update());
    this.object.updateMatrixWorld();
    for (const part of this.parts) part.visible = part.matrixWorld.determinant() !== 0; // frames are hidden by scale 0
  }
}

/** Returns the shortest interval between keys in seconds; infinite for a single key. */
function shortest(times) {
  return Math.min(Infinity, ...Array.from(times.subarray(1), (time, i) => time - times[i]));
}

/** Creates an unlit material. */
function flat(material) {
  const { name, map, color, side, transparent, opacity, alphaTest, vertexColors } = material;
  return new MeshBasicMaterial({ name, map, color, side, transparent, opacity, alphaTest, vertexColors, toneMapped: false });
}
