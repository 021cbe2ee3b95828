// Playback clock, looping; seconds since the first frame.

export const SPEEDS = [0.25, 0.5, 0.75, 1, 1.5, 2, 4];
const LONGEST_TICK = 0.25; // seconds; a page that was hidden goes on where it was

export class Player {
  /** Creates a clock; without a frame rate the asset is static. */
  constructor(duration, fps) {
    this.duration = duration;
    this.fps = fps;
    this.time = 0;
    this.playing = true;
    this.speed = 1;
  }

  get frames() {
    return Math.max(1, Math.round(this.duration * this.fps));
  }

  /** Index of the current frame, from 0. */
  get frame() {
    return Math.floor(this.time * this.fps + 1e-4) % this.frames;
  }

  advance(seconds) {
    this.seek(this.time + Math.min(seconds, LONGEST_TICK) * this.speed);
  }

  seek(seconds) {
    const turn = this.duration > 0 ? seconds % this.duration : 0;
    this.time = turn < 0 ? turn + this.duration : turn;
  }

  /** Steps to the next (1) or previous (-1) frame. */
  step(direction) {
    this.playing = false;
    const between = this.time * this.fps - this.frame > 1e-3;
    this.seek((this.frame + (between && direction < 0 ? 0 : direction)) / this.fps);
  }

  /** Selects the next faster (1) or slower (-1) speed. */
  shift(direction) {
    const at = SPEEDS.indexOf(this.speed) + direction;
    this.speed = SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, at))];
  }
}
