// Entry point: connects embedded data, stage, clock and controls. `window.dg4d` is the scripting interface.
import { bytesOf, camera, facts } from "./embedded.js";
import { Cloud } from "./cloud.js";
import { Controls, reducedMotion } from "./controls.js";
import { readMesh } from "./mesh.js";
import { Player } from "./player.js";
import { fillPanel } from "./panel.js";
import { readSplats } from "./splats.js";
import { Stage, canDraw } from "./stage.js";

const NO_WEBGL =
  "This browser cannot show 3D content: WebGL 2 is missing or disabled. Open preview.mp4 or turntable.mp4 instead.";

const stageElement = document.getElementById("stage");

/** Loads the embedded representations, keyed by display mode. */
async function read() {
  const glb = await bytesOf("glb");
  const mesh = glb && (await readMesh(glb));
  const packed = await bytesOf("splats");
  const splats = packed && (await readSplats(packed));
  return { mesh, cloud: splats && new Cloud(splats) };
}

async function start() {
  const video = fillPanel(facts(), await bytesOf("picture"), await bytesOf("video"));
  if (!canDraw()) throw new Error(NO_WEBGL);
  const { mesh, cloud } = await read();
  const player = new Player(Math.max(mesh?.duration ?? 0, cloud?.splats.duration ?? 0), cloud?.splats.fps || mesh?.fps || 1);
  player.playing = player.frames > 1 && !reducedMotion;
  const stage = new Stage(stageElement, camera());
  const modes = [...(mesh ? ["mesh"] : []), ...(cloud ? ["splats"] : []), ...(mesh ? ["wireframe"] : [])];
  const shown = [mesh, cloud].filter(Boolean);
  stage.world.add(...shown.map(({ object }) => object));
  let mode;

  const show = (what) => {
    if (!modes.includes(what)) throw new Error(`unknown display mode ${what}; available: ${modes.join(", ")}`);
    mode = what;
    for (const one of shown) one.show(what);
    draw();
  };
  const draw = () => {
    for (const one of shown) if (one.object.visible) one.seek(player.time);
    stage.draw((camera, pixels) => mode === "splats" && cloud.look(camera, pixels));
    controls.update(mode);
  };
  const state = () => ({
    time: player.time,
    duration: player.duration,
    frame: player.frame,
    frames: player.frames,
    fps: player.fps,
    playing: player.playing,
    speed: player.speed,
    shown: mode,
    modes,
    dark: document.documentElement.dataset.theme === "dark",
  });
  const controls = new Controls({ player, stage, video, modes, show, draw });
  document.querySelector("footer").hidden = player.frames === 1;
  show(modes[0]);
  stageElement.removeAttribute("data-loading");
  Object.assign(window.dg4d, {
    state,
    show,
    draw,
    seek(seconds) {
      player.playing = false;
      player.seek(seconds);
      draw();
    },
    play() {
      player.playing = true;
    },
  });
  animate(player, stage, draw);
}

/** Redraws when time, view or size changed. */
function animate(player, stage, draw) {
  let last = performance.now();
  const tick = (now) => {
    requestAnimationFrame(tick);
    stage.controls.update();
    if (player.playing) player.advance((now - last) / 1000);
    last = now;
    if (player.playing || stage.stale) draw();
  };
  requestAnimationFrame(tick);
}

function refuse(error) {
  stageElement.removeAttribute("data-loading");
  document.body.toggleAttribute("data-still", true);
  document.querySelector("video").controls = true;
  const notice = document.getElementById("notice");
  notice.hidden = false;
  notice.textContent = error.message;
  if (error.message === NO_WEBGL) return;
  notice.textContent = `The asset cannot be shown: ${error.message}`;
  console.error(error);
}

// `ready` resolves with the first frame and rejects if loading fails.
window.dg4d = { ready: null };
window.dg4d.ready = start();
window.dg4d.ready.catch(refuse);
