// Gaussian splat renderer, consistent with the library's rasterizers: one quad per splat, EWA projection, back to front.
import {
  BufferAttribute, CustomBlending, DataTexture, DynamicDrawUsage, FloatType, GLSL3, InstancedBufferAttribute,
  InstancedBufferGeometry, Mesh, OneFactor, OneMinusSrcAlphaFactor, RGBAFormat, RawShaderMaterial, UnsignedByteType,
  Vector2,
} from "three";
import vertexShader from "./cloud.vert";
import fragmentShader from "./cloud.frag";
import { farToNear } from "./order.js";

const PER_LINE = 1024; // Gaussians per texture row; same value as in the shader
const CORNERS = [-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0];

export class Cloud {
  constructor(splats) {
    const { count, colors } = splats;
    this.splats = splats;
    this.count = count;
    const lines = Math.ceil(count / PER_LINE);
    this.rows = new Float32Array(12 * PER_LINE * lines);
    this.motion = new DataTexture(this.rows, 3 * PER_LINE, lines, RGBAFormat, FloatType);
    const texels = new Uint8Array(4 * PER_LINE * lines);
    for (let i = 0; i < 4 * count; i++) texels[4 * (i % count) + Math.floor(i / count)] = colors[i];
    const paint = new DataTexture(texels, PER_LINE, lines, RGBAFormat, UnsignedByteType);
    paint.needsUpdate = true;
    const geometry = new InstancedBufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(CORNERS), 3));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    this.order = new InstancedBufferAttribute(new Uint32Array(count), 1).setUsage(DynamicDrawUsage);
    geometry.setAttribute("order", this.order);
    geometry.instanceCount = count;
    this.material = new RawShaderMaterial({
      name: "splats",
      glslVersion: GLSL3,
      vertexShader,
      fragmentShader,
      uniforms: { motion: { value: this.motion }, paint: { value: paint }, size: { value: new Vector2() } },
      transparent: true,
      depthTest: false,
      depthWrite: false,
      premultipliedAlpha: true,
      blending: CustomBlending,
      blendSrc: OneFactor,
      blendDst: OneMinusSrcAlphaFactor,
    });
    this.object = new Mesh(geometry, this.material);
    this.object.frustumCulled = false;
  }

  show(what) {
    this.object.visible = what === "splats";
  }

  seek(seconds) {
    this.splats.at(seconds, this.rows.subarray(0, 12 * this.count));
    this.motion.needsUpdate = true;
  }

  /** Updates depth order and quad sizes, which depend on the view; call before every frame. */
  look(camera, { width, height }) {
    farToNear(this.rows, 12, this.count, camera.matrixWorldInverse.elements, this.order.array);
    this.order.needsUpdate = true;
    this.material.uniforms.size.value.set(width, height);
  }
}
