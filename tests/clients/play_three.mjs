// three.js shows moments of animated GLBs.
// Usage: node play_three.mjs REQUEST; see play.mjs.
import { play } from "./play.mjs";

await play(`
  import * as THREE from "three";
  import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
  import { MeshoptDecoder } from "three/addons/libs/meshopt_decoder.module.js";

  window.open_ = async (url, { position, fov, size, shading }) => {
    const renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true, preserveDrawingBuffer: true });
    renderer.setSize(size, size);
    renderer.setClearColor(0, 0);
    const camera = new THREE.PerspectiveCamera(fov, 1, 0.01, 100);
    camera.position.set(...position);
    camera.lookAt(0, 0, 0);
    const { scene, animations } = await new GLTFLoader().setMeshoptDecoder(MeshoptDecoder).loadAsync(url);
    scene.traverse((part) => {
      if (!part.isMesh) return;
      part.material = shading === "normals"
        ? new THREE.MeshNormalMaterial({ side: THREE.DoubleSide })
        : new THREE.MeshBasicMaterial({ map: part.material.map, side: THREE.DoubleSide });
    });
    const mixer = new THREE.AnimationMixer(scene);
    animations.forEach((clip) => mixer.clipAction(clip).play());
    const facts = {
      animations: animations.map((clip) => clip.name),
      duration: Math.max(...animations.map((clip) => clip.duration)),
    };
    return [facts, (seconds) => {
      mixer.setTime(seconds);
      renderer.render(scene, camera);
      return renderer.domElement.toDataURL("image/png");
    }];
  };
`);
