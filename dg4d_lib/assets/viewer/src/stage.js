// Canvas, camera and orbit controls. The canvas is transparent, so the page's background shows through.
import { DirectionalLight, Group, HemisphereLight, PerspectiveCamera, Scene, Spherical, WebGLRenderer } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

// The camera of the input picture: on +z, looking at the origin; as in dg4d_lib/cameras/orbit.py.
const FOV_DEG = 49.1; // of the shorter side
const RADIUS = 2;
const NEAREST = 0.3;
const FARTHEST = 12;
const MOST_PIXELS_PER_POINT = 2; // sharper screens would only be slower

/** Returns the tangent of half an angle in degrees. */
const tanHalf = (deg) => Math.tan((deg * Math.PI) / 360);

/** Returns true if the browser supports WebGL 2. */
export function canDraw() {
  return Boolean(document.createElement("canvas").getContext("webgl2"));
}

export class Stage {
  /**
   * `view`: distance `radius` of the input camera and the `target` that it looks at, in the coordinates of the asset, and
   * `whole_fov_y_deg`, the field of view that holds the whole asset from all sides; the camera starts farther away instead.
   */
  constructor(element, { radius = RADIUS, target = [0, 0, 0], whole_fov_y_deg: whole = FOV_DEG } = {}) {
    this.element = element;
    this.start = Math.min(FARTHEST, (RADIUS * tanHalf(whole)) / tanHalf(FOV_DEG));
    this.renderer = new WebGLRenderer({ canvas: element.querySelector("canvas"), antialias: true, alpha: true });
    this.scene = new Scene();
    this.world = new Group(); // shows assets of any size and place as the input camera saw them
    this.world.scale.setScalar(RADIUS / radius);
    this.world.position.set(...target).multiplyScalar(-RADIUS / radius);
    this.scene.add(this.world);
    this.camera = new PerspectiveCamera(FOV_DEG, 1, 0.02, 100);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    Object.assign(this.controls, { enableDamping: true, minDistance: NEAREST, maxDistance: FARTHEST });
    this.stale = true;
    this.controls.addEventListener("change", () => (this.stale = true));
    this.renderer.domElement.addEventListener("webglcontextrestored", () => (this.stale = true));
    new ResizeObserver(() => this.resize()).observe(element);
    this.light();
    this.reset();
    this.resize();
    this.followPixelRatio();
  }

  /** Resets the camera to the direction of the input view, from where the whole asset is seen. */
  reset() {
    this.controls.enableDamping = false;
    this.controls.update(); // stops the damped rotation
    this.controls.enableDamping = true;
    this.controls.target.set(0, 0, 0);
    this.camera.position.set(0, 0, this.start);
    this.controls.update();
    this.stale = true;
  }

  /** Turns the camera around its target by angles in radians: `across` around the vertical axis, `up` over the top. */
  turn(across, up) {
    this.orbit((at) => {
      at.theta -= across;
      at.phi -= up;
    });
  }

  /** Multiplies the distance from the target by a factor. */
  zoom(factor) {
    this.orbit((at) => (at.radius = Math.min(FARTHEST, Math.max(NEAREST, at.radius * factor))));
  }

  /** Changes the position of the camera in spherical coordinates around its target. */
  orbit(change) {
    const { target } = this.controls;
    const at = new Spherical().setFromVector3(this.camera.position.clone().sub(target));
    change(at);
    this.camera.position.setFromSpherical(at.makeSafe()).add(target);
    this.controls.update();
    this.stale = true;
  }

  /** Renders the scene immediately. */
  draw(before) {
    this.camera.updateMatrixWorld();
    before(this.camera, this.pixels);
    this.renderer.render(this.scene, this.camera);
    this.stale = false;
  }

  /** Width and height of the picture in pixels. */
  get pixels() {
    const { width, height } = this.renderer.domElement;
    return { width, height };
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, MOST_PIXELS_PER_POINT));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    const half = tanHalf(FOV_DEG) / Math.min(1, this.camera.aspect);
    this.camera.fov = (360 / Math.PI) * Math.atan(half);
    this.camera.updateProjectionMatrix();
    this.stale = true;
  }

  /** Resizes when the pixel ratio changes, as on another screen; a query matches one ratio, so each needs its own. */
  followPixelRatio() {
    const moved = () => (this.resize(), this.followPixelRatio());
    matchMedia(`(resolution: ${devicePixelRatio}dppx)`).addEventListener("change", moved, { once: true });
  }

  /** For the clay under the wireframe; textures are shown as they are. */
  light() {
    const lamp = new DirectionalLight(0xffffff, 1.6);
    lamp.position.set(-1, 1.5, 1);
    this.camera.add(lamp, lamp.target);
    lamp.target.position.set(0, 0, -1);
    this.scene.add(this.camera, new HemisphereLight(0xffffff, 0x8890a0, 1.9));
  }
}
