// A stage: the 3-D view, its badge, and the bar that plays.

import * as three from "three";
import { button, el } from "../dom";
import type { Clip, Pose, Rollout, Shape } from "../types";
import { Player } from "./player";
import { World } from "./world";

const SLOT = 5.5; // distance of stacks side by side [cell]

export class Stage {
  readonly element: HTMLElement;
  readonly world: World;
  readonly player: Player;
  private readonly badge = el("p", { class: "badge", role: "status" });
  private readonly seekBar = el("input", { type: "range", min: 0, max: 1, step: 0.001, value: 0, "aria-label": "Moment" });
  private readonly playButton = button("Play", () => this.player.toggle(), { disabled: true });
  private marks: three.Object3D | null = null;

  constructor(shapes: Shape[], name: string) {
    this.world = new World(shapes);
    this.world.canvas.setAttribute("aria-label", `${name}: 3-D view. Drag to turn, wheel or pinch to zoom, arrow keys to move.`);
    this.player = new Player((poses) => this.world.pose(poses), () => this.world.paint(), () => this.moved());
    this.world.onFrame = (seconds) => this.player.step(seconds);
    this.seekBar.addEventListener("input", () => this.player.seek(Number(this.seekBar.value) * this.player.duration));
    const bar = el("div", { class: "play" }, this.playButton, this.seekBar);
    this.element = el("div", { class: "stage" }, this.world.canvas, this.badge, bar);
  }

  /** Shows a word over the picture. */
  say(text: string, kind: "" | "stands" | "falls" | "busy" = ""): void {
    this.badge.textContent = text;
    this.badge.className = `badge ${kind}`;
  }

  /** Shows several stacks of the same blocks side by side; the frames hold the poses of each. */
  arrange(shapes: number[], number: number): (stacks: Pose[][]) => Pose[] {
    const across = Math.min(4, number);
    const down = Math.ceil(number / across);
    this.world.setBlocks(Array.from({ length: number }, () => shapes).flat());
    this.world.tilt(0, 0);
    this.setMarks(null);
    this.world.home(across * SLOT * 0.95, 4 + down);
    const place = (i: number) => [((i % across) - (across - 1) / 2) * SLOT, (Math.floor(i / across) - (down - 1) / 2) * SLOT] as const;
    return (stacks) =>
      stacks.flatMap((poses, i) => poses.map(([x, y, z, ...turn]): Pose => [x + place(i)[0], y + place(i)[1], z, ...turn]));
  }

  /** Shows one stack. */
  present(shapes: number[], poses: Pose[]): void {
    this.player.clip = { frames: [], rate: 1 };
    this.world.setBlocks(shapes);
    this.setMarks(null);
    const extent = (axis: number) => Math.max(...poses.map((pose) => Math.abs(pose[axis]!)), 1) + 1;
    this.world.home(2 * extent(0), extent(2));
    this.world.pose(poses);
  }

  async playClip(clip: Clip, more = false): Promise<void> {
    this.playButton.disabled = false;
    await this.player.play(clip, more);
  }

  /** Plays what the simulator saw, and shows at its end which block went first. */
  async playRollout(rollout: Rollout): Promise<void> {
    this.world.mark([]);
    this.setMarks(null);
    await this.playClip(rollout);
    this.world.mark(rollout.first === null ? [] : [rollout.first]);
    this.say(rollout.stable ? "stands" : "falls", rollout.stable ? "stands" : "falls");
  }

  /** Stops, and shows the beginning. */
  still(): void {
    this.player.seek(0);
    this.world.mark([]);
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
    this.playButton.textContent = playing ? "Pause" : "Play";
  }
}
