// Babylon.js shows moments of animated GLBs.
// Usage: node play_babylon.mjs REQUEST; see play.mjs.
import { play } from "./play.mjs";

await play(`
  import { Engine } from "@babylonjs/core/Engines/engine.js";
  import { Scene } from "@babylonjs/core/scene.js";
  import { FreeCamera } from "@babylonjs/core/Cameras/freeCamera.js";
  import { Vector3 } from "@babylonjs/core/Maths/math.vector.js";
  import { Color4 } from "@babylonjs/core/Maths/math.color.js";
  import { AppendSceneAsync } from "@babylonjs/core/Loading/sceneLoader.js";
  import { MeshoptCompression } from "@babylonjs/core/Meshes/Compression/meshoptCompression.js";
  import "@babylonjs/core/Animations/animatable.js";
  import "@babylonjs/core/Loading/loadingScreen.js";
  import "@babylonjs/core/Materials/Textures/Loaders/index.js";
  import "@babylonjs/loaders/glTF/2.0/glTFLoader.js";
  import "@babylonjs/loaders/glTF/2.0/Extensions/EXT_meshopt_compression.js";
  import "@babylonjs/loaders/glTF/2.0/Extensions/EXT_texture_webp.js";
  import "@babylonjs/loaders/glTF/2.0/Extensions/KHR_animation_pointer.js";
  import "@babylonjs/loaders/glTF/2.0/Extensions/KHR_mesh_quantization.js";
  import "@babylonjs/loaders/glTF/2.0/Extensions/KHR_texture_transform.js";
  import { MeshoptDecoder } from "three/addons/libs/meshopt_decoder.module.js";

  window.MeshoptDecoder = MeshoptDecoder;
  MeshoptCompression.Configuration.decoder.url = "data:text/javascript,"; // the decoder is here already
  const FRAMES_PER_SECOND = 60; // what the loader makes of seconds

  window.open_ = async (url, { position, fov, size }) => {
    const canvas = document.createElement("canvas");
    Object.assign(canvas, { width: size, height: size });
    const engine = new Engine(canvas, true, { preserveDrawingBuffer: true });
    const scene = new Scene(engine);
    scene.useRightHandedSystem = true;
    scene.clearColor = new Color4(0, 0, 0, 0);
    const camera = new FreeCamera("camera", new Vector3(...position), scene);
    camera.setTarget(Vector3.Zero());
    Object.assign(camera, { fov: (fov * Math.PI) / 180, minZ: 0.01, maxZ: 100 });
    await AppendSceneAsync(url, scene);
    scene.materials.forEach((material) => (material.unlit = true));
    const groups = scene.animationGroups;
    groups.forEach((group) => group.start(true).pause());
    await scene.whenReadyAsync();
    const facts = {
      animations: groups.map((group) => group.name),
      duration: Math.max(...groups.map((group) => group.to)) / FRAMES_PER_SECOND,
    };
    return [facts, async (seconds) => {
      groups.forEach((group) => group.goToFrame(seconds * FRAMES_PER_SECOND));
      scene.render(); // a texture that begins to move gets another shader, for the next picture
      await scene.whenReadyAsync();
      scene.render();
      return canvas.toDataURL("image/png");
    }];
  };
`);
