// Buttons, scrub bar and keyboard shortcuts.
import { SPEEDS } from "./player.js";

const VIDEO_DRIFT = 0.12; // seconds; larger offsets of the video are corrected by seeking
const TURN = Math.PI / 24; // of the camera, per key press
const ZOOM = 1.1; // of its distance, per key press
export const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)").matches;
const byId = (id) => document.getElementById(id);

export class Controls {
  constructor({ player, stage, video, modes, show, draw }) {
    Object.assign(this, { player, stage, video, modes, show, draw });
    this.buttons = [...byId("modes").children];
    for (const button of this.buttons) {
      button.hidden = !modes.includes(button.dataset.show);
      button.addEventListener("click", () => show(button.dataset.show));
    }
    byId("speed").append(...SPEEDS.map((speed) => new Option(`${speed}×`, speed)));
    byId("speed").addEventListener("change", ({ target }) => this.change(() => (player.speed = Number(target.value))));
    byId("scrub").max = player.duration;
    byId("scrub").addEventListener("input", ({ target }) => this.change(() => this.scrub(Number(target.value))));
    byId("play").addEventListener("click", () => this.toggle());
    byId("reset").addEventListener("click", () => stage.reset());
    byId("background").addEventListener("click", () => this.darken());
    byId("details").addEventListener("click", () => this.unfold());
    document.addEventListener("keydown", (event) => this.press(event));
    if (window !== window.parent) this.unfold(false); // another page embeds the viewer
    this.darken(matchMedia("(prefers-color-scheme: dark)").matches);
  }

  /** Shows the state of the clock; called after every frame. */
  update(mode) {
    const { player } = this;
    for (const button of this.buttons) button.setAttribute("aria-pressed", button.dataset.show === mode);
    byId("scrub").value = player.time;
    byId("scrub").style.setProperty("--done", `${(100 * player.time) / (player.duration || 1)}%`);
    byId("speed").value = player.speed;
    byId("play").dataset.playing = player.playing;
    const digits = String(player.frames).length;
    const frame = String(player.frame + 1).padStart(digits, "\u2007");
    byId("readout").textContent = `${player.time.toFixed(2)} s · frame ${frame}/${player.frames}`;
    this.follow();
  }

  /** Synchronizes the driving video with the clock. */
  follow() {
    const { player, video } = this;
    if (!video || !(video.duration > 0)) return;
    const wanted = player.time % video.duration;
    const off = Math.abs(video.currentTime - wanted);
    const drift = Math.min(off, video.duration - off);
    if (drift > (player.playing ? VIDEO_DRIFT * Math.max(1, player.speed) : 0.01) && !video.seeking) video.currentTime = wanted;
    video.playbackRate = player.speed;
    if (player.playing && video.paused) video.play().catch(() => {}); // if the browser refuses autoplay, the video follows by seeking
    if (!player.playing && !video.paused) video.pause();
  }

  change(deed) {
    deed();
    this.draw();
  }

  toggle() {
    this.change(() => (this.player.playing = !this.player.playing));
  }

  scrub(seconds) {
    this.player.playing = false;
    this.player.seek(Math.min(seconds, this.player.duration * (1 - 1e-6))); // so that the end of the bar does not wrap to the start
  }

  darken(dark = document.documentElement.dataset.theme !== "dark") {
    document.documentElement.dataset.theme = dark ? "dark" : "light";
  }

  unfold(open = document.body.hasAttribute("data-folded")) {
    document.body.toggleAttribute("data-folded", !open);
    byId("details").setAttribute("aria-expanded", open);
    if (open) byId("panel").scrollIntoView({ behavior: reducedMotion ? "auto" : "smooth", block: "nearest" });
  }

  press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("select, summary")) return;
    if (event.key === " " && event.target.closest("button")) return; // the browser presses the button
    const { player } = this;
    const deeds = {
      " ": () => this.toggle(),
      ArrowLeft: () => this.change(() => player.step(-1)),
      ArrowRight: () => this.change(() => player.step(1)),
      ArrowUp: () => this.change(() => player.shift(1)),
      ArrowDown: () => this.change(() => player.shift(-1)),
      Home: () => this.change(() => this.scrub(0)),
      "+": () => this.stage.zoom(1 / ZOOM),
      "=": () => this.stage.zoom(1 / ZOOM), // the key of + without shift
      "-": () => this.stage.zoom(ZOOM),
      r: () => this.stage.reset(),
      b: () => this.darken(),
      i: () => this.unfold(),
    };
    ["mesh", "splats", "wireframe"].forEach((mode, i) => {
      if (this.modes.includes(mode)) deeds[i + 1] = () => this.show(mode);
    });
    const turns = {
      ArrowLeft: () => this.stage.turn(-TURN, 0),
      ArrowRight: () => this.stage.turn(TURN, 0),
      ArrowUp: () => this.stage.turn(0, -TURN),
      ArrowDown: () => this.stage.turn(0, TURN),
    };
    const deed = (event.shiftKey && turns[event.key]) || (deeds[event.key] ?? deeds[event.key.toLowerCase()]);
    if (!deed) return;
    event.preventDefault();
    deed();
  }
}
