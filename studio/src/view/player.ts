// Plays frames of poses: smoothly between them, at their rate, as they come. Where somebody wants less motion, only
// what they start themselves is played; else its end is shown.

import type { Clip, Pose } from "../types";

export class Player {
  clip: Clip = { frames: [], rate: 1 };
  time = 0; // [s]
  speed = 1;
  playing = false;
  pose: (joints: number[]) => void = () => {}; // the arm
  private waiting = false; // for frames that are still to come
  private hurried = false; // straight to the end
  private ended: () => void = () => {};

  constructor(
    private readonly show: (poses: Pose[]) => void,
    private readonly awake: () => void,
    private readonly moved: () => void,
  ) {}

  /** Plays a clip from its beginning; the promise says that it was played, or that somebody chose another moment. */
  play(clip: Clip, more = false): Promise<void> {
    const hurried = matchMedia("(prefers-reduced-motion: reduce)").matches;
    Object.assign(this, { clip, time: 0, playing: true, waiting: more, hurried });
    this.ended();
    this.awake();
    return new Promise((resolve) => (this.ended = resolve));
  }

  /** Says that frames came, and whether more are still to come. */
  grown(more: boolean): void {
    this.waiting = more;
    this.awake();
  }

  get duration(): number {
    return Math.max(0, this.clip.frames.length - 1) / this.clip.rate;
  }

  /** Stops, and shows one moment. */
  seek(time: number): void {
    this.playing = false;
    this.time = Math.max(0, Math.min(this.duration, time));
    this.draw();
    this.ended();
  }

  get atEnd(): boolean {
    return !this.playing && this.time >= this.duration;
  }

  toggle(): void {
    if (!this.playing && this.time >= this.duration) this.time = 0;
    this.playing = !this.playing;
    this.hurried = false;
    this.draw();
    this.awake();
  }

  /** Lets time pass; answers whether there is more to show. */
  step(seconds: number): boolean {
    if (!this.playing) return false;
    this.time = this.hurried ? this.duration : Math.min(this.duration, this.time + seconds * this.speed);
    this.draw();
    if (this.time < this.duration) return true;
    if (!this.waiting) {
      this.playing = false;
      this.moved();
      this.ended();
    }
    return false;
  }

  private draw(): void {
    const { frames, rate } = this.clip;
    if (!frames.length) return this.moved();
    const place = Math.min(frames.length - 1, this.time * rate);
    const [from, to] = [frames[Math.floor(place)]!, frames[Math.ceil(place)]!];
    this.show(from === to ? from : from.map((pose, i) => (pose === to[i] ? pose : between(pose, to[i]!, place % 1))));
    const [before, after] = [this.clip.joints?.[Math.floor(place)], this.clip.joints?.[Math.ceil(place)]];
    if (before && after) this.pose(before.map((angle, i) => angle + (after[i]! - angle) * (place % 1)));
    this.moved();
  }
}

export function between(a: Pose, b: Pose, t: number): Pose {
  const sign = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6] < 0 ? -1 : 1;
  const mixed = a.map((value, i) => value + ((i > 2 ? sign : 1) * b[i]! - value) * t) as Pose;
  const length = Math.hypot(mixed[3], mixed[4], mixed[5], mixed[6]) || 1;
  for (let i = 3; i < 7; i++) mixed[i]! /= length;
  return mixed;
}
