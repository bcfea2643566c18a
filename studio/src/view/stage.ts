// A stage: the 3-D view, its badge, and the bar that plays.

import * as three from "three";
import { button, el } from "../dom";
import type { Clip, Pose, Shape } from "../types";
import { Player } from "./player";
import { World } from "./world";

const SLOT = 4.5; // distance of stacks side by side [cell]
const FARTHEST = 9; // from the middle at which blocks are still looked at: the edge of the table [cell]

export type Tone = "" | "stands" | "falls" | "busy";

/** What the badge says of a clip, and which blocks light up: while it plays nothing but what goes on. */
export interface Told {
  during: string;
  verdict: string;
  stable: boolean;
  red: number[];
}

export class Stage {
  readonly element: HTMLElement;
  readonly world: World;
  readonly player: Player;
  private readonly badge = el("p", { class: "badge", role: "status" });
  private readonly seekBar = el("input", { type: "range", min: 0, max: 1, step: 0.001, value: 0, "aria-label": "Moment" });
  private readonly playButton = button("Play", () => this.player.toggle());
  private readonly bar = el("div", { class: "play", hidden: true }, this.playButton, this.seekBar);
  onMoment: (time: number) => void = () => {}; // of the clip [s]
  private marks: three.Object3D | null = null;
  told: Told | null = null;

  constructor(shapes: Shape[], name: string) {
    this.world = new World(shapes);
    this.world.canvas.setAttribute("aria-label", `${name}: 3-D view. Drag to turn, wheel or pinch to zoom, arrow keys to move.`);
    this.player = new Player((poses) => this.world.pose(poses), () => this.world.paint(), () => this.moved());
    this.world.onFrame = (seconds) => this.player.step(seconds);
    this.seekBar.addEventListener("input", () => this.player.seek(Number(this.seekBar.value) * this.player.duration));
    this.element = el("div", { class: "stage" }, this.world.canvas, this.badge, this.bar);
  }

  /** Shows a word over the picture. */
  say(text: string, tone: Tone = ""): void {
    if (this.badge.textContent !== text) this.badge.textContent = text;
    this.badge.className = `badge ${tone}`;
  }

  /** Shows several stacks of the same blocks side by side; the frames hold the poses of each. */
  arrange(shapes: number[], number: number): (stacks: Pose[][]) => Pose[] {
    const across = Math.min(4, number);
    const down = Math.ceil(number / across);
    this.still();
    this.world.setBlocks(Array.from({ length: number }, () => shapes).flat());
    this.world.home(across * SLOT * 0.9, 4 + down);
    const place = (i: number) => [((i % across) - (across - 1) / 2) * SLOT, (Math.floor(i / across) - (down - 1) / 2) * SLOT] as const;
    return (stacks) =>
      stacks.flatMap((poses, i) => poses.map(([x, y, z, ...turn]): Pose => [x + place(i)[0], y + place(i)[1], z, ...turn]));
  }

  /** Shows one stack. */
  present(shapes: number[], poses: Pose[]): void {
    this.world.setBlocks(shapes);
    this.player.clip = { frames: [], rate: 1 };
    this.still();
    const extent = (axis: number) => Math.max(...poses.map((pose) => Math.abs(pose[axis]!)), 1) + 1;
    this.world.home(2 * extent(0), extent(2));
    this.world.pose(poses);
  }

  /** Plays what the simulator saw; when it stops, the badge tells the verdict. */
  async playRollout(clip: Clip, told: Told): Promise<void> {
    this.still();
    this.told = told;
    const reach = Math.max(...clip.frames.at(-1)!.flatMap(([x, y]) => [Math.abs(x), Math.abs(y)]));
    this.world.widen(2 * Math.min(FARTHEST, reach + 1));
    await this.player.play(clip);
  }

  /** Shows the beginning or the end of a rollout, and its verdict. */
  holdRollout(clip: Clip, told: Told, end: boolean): void {
    this.still();
    this.told = told;
    this.player.clip = clip;
    this.player.seek(end ? this.player.duration : 0);
  }

  /** Stops, and shows the beginning on a level table, without a verdict. */
  still(): void {
    this.told = null;
    this.onMoment = () => {};
    this.say("");
    this.player.seek(0);
    this.world.mark([]);
    this.world.tilt(0, 0);
    this.setMarks(null);
  }

  setMarks(marks: three.Object3D | null): void {
    if (this.marks) this.world.extras.remove(this.marks);
    this.marks = marks;
    if (marks) this.world.extras.add(marks);
    this.world.paint();
  }

  private moved(): void {
    const { time, duration, playing } = this.player;
    this.seekBar.value = String(duration ? time / duration : 0);
    this.bar.hidden = !duration;
    this.playButton.textContent = playing ? "Pause" : "Play";
    this.onMoment(time);
    if (!this.told) return;
    const { during, verdict, stable, red } = this.told;
    this.world.mark(playing ? [] : red);
    this.say(playing ? during : verdict, playing ? "busy" : stable ? "stands" : "falls");
  }
}
