// The arm builds the stack: its motion is streamed, played, and stepped through block by block.

import { isAbort, messages, post, told } from "../api";
import { button, choice, el, labelled } from "../dom";
import type { Clip, Pose, StackFacts, StacksFile } from "../types";
import { Arm } from "./arm";
import type { Stage } from "./stage";
import { countedFromOne, number } from "./why";

type BuildMessage =
  | { kind: "planned"; blocks: number; of: number }
  | { kind: "order"; order: number[]; shapes: number[]; rate: number }
  | { kind: "motion"; frames: { joints: number[]; blocks: Record<string, Pose> }[] }
  | { kind: "placed"; blocks: number }
  | { kind: "built"; stands: boolean; seconds: number; iou: number | null; unplanned: string[] }
  | { kind: "error"; detail: string };

export class Building {
  readonly element: HTMLElement;
  private readonly status = el("p", { role: "status", class: "answer" });
  private readonly go = button("Have the arm build it", () => void this.build());
  private readonly stop = button("Stop", () => this.reset(), { hidden: true });
  private readonly back = button("Previous block", () => this.step(-1), { hidden: true });
  private readonly next = button("Next block", () => this.step(1), { hidden: true });
  private readonly order = el("input", { type: "range", min: 0, max: 1, step: 1, value: 1, "aria-label": "Blocks in the order of building" });
  private readonly speed: HTMLSelectElement;
  private starts: number[] = []; // moments at which blocks are begun [s]
  private placing: number[] | null = null;
  private running: AbortController | null = null;
  private arm: Arm | null = null;
  private file: StacksFile | null = null;
  private stack: StackFacts | null = null;
  private place = 0;

  /** @param begins Called before the stage is used. */
  constructor(
    private readonly stage: Stage,
    private readonly begins: () => void,
  ) {
    this.order.addEventListener("input", () => void this.showOrder());
    this.speed = choice([["1", "real time"], ["4", "4 times"], ["12", "12 times"]], "4", (value) => {
      if (this.arm) this.stage.player.speed = Number(value);
    });
    this.element = el(
      "div",
      { class: "build" },
      el("div", { class: "row" }, labelled("Build order: so many blocks", this.order)),
      el("div", { class: "row" }, this.go, this.stop, this.back, this.next, labelled("Speed", this.speed)),
      this.status,
    );
  }

  /** Takes the stack that is built from now on. */
  take(file: StacksFile, place: number, stack: StackFacts): void {
    this.reset();
    Object.assign(this, { file, place, stack, placing: null });
    this.order.max = String(stack.shapes.length);
    this.order.value = this.order.max; // only now: a larger value would have been cut
  }

  /** Stops a build, and takes the arm away. */
  reset(): void {
    if (this.running) {
      this.running.abort();
      this.stage.say(""); // a plan that failed says so beside it
    }
    this.running = null;
    if (this.arm) {
      this.stage.world.table.remove(this.arm.object);
      this.stage.present(this.stack!.shapes, this.stack!.frames[0]!); // the blocks are where they were fetched
    }
    this.arm = null;
    this.stage.player.speed = 1;
    this.status.textContent = "";
    this.stop.hidden = this.back.hidden = this.next.hidden = true;
    this.go.hidden = false;
    if (this.stack) this.order.value = this.order.max;
  }

  private async showOrder(): Promise<void> {
    const stack = this.stack!;
    try {
      if (!this.placing) {
        this.status.textContent = "Looking for a safe order …";
        const found = await post<{ order: number[]; margins: number[] }>("/api/order", { file: this.file, stack: this.place });
        if (this.stack !== stack) return;
        this.placing = found.order;
      }
      const wanted = this.order.value;
      if (this.arm) this.reset();
      this.order.value = wanted;
      const placed = this.placing.slice(0, Number(wanted));
      this.begins();
      this.stage.still();
      this.stage.world.pose(stack.poses);
      this.stage.world.mark([], (block) => !placed.includes(block));
      this.status.textContent = placed.length ? `Block ${placed.at(-1)! + 1} is number ${placed.length} to be placed.` : "Nothing is placed yet.";
    } catch (error) {
      this.status.textContent = countedFromOne(told(error));
    }
  }

  private async build(): Promise<void> {
    this.reset();
    const running = (this.running = new AbortController());
    this.go.hidden = true;
    this.stop.hidden = false;
    this.stop.textContent = "Stop";
    this.starts = [];
    const clip: Clip & { joints: number[][] } = { frames: [], joints: [], rate: 12 };
    const { stage } = this;
    this.begins();
    stage.still();
    stage.say("planning …", "busy");
    let played: Promise<void> | null = null;
    let [stands, last] = ["", false];
    try {
      for await (const message of messages<BuildMessage>("/api/build", { file: this.file, stack: this.place }, running.signal)) {
        if (message.kind === "planned") this.status.textContent = `Planning: ${message.blocks} of ${message.of} blocks`;
        else if (message.kind === "order") {
          clip.rate = message.rate;
          this.arm = await Arm.load(this.file!.cell_size_m ?? 0.05, running.signal);
          if (running.signal.aborted) return;
          stage.present(message.shapes, this.stack!.poses);
          stage.world.table.add(this.arm.object);
          stage.world.home(11, 12);
          this.starts.push(0);
          this.back.hidden = this.next.hidden = false;
        } else if (message.kind === "motion") {
          for (const frame of message.frames) {
            const poses = [...(clip.frames.at(-1) ?? [])];
            for (const [block, pose] of Object.entries(frame.blocks)) poses[Number(block)] = pose;
            clip.frames.push(poses);
            clip.joints.push(frame.joints);
          }
          if (!played) {
            stage.player.pose = (joints) => this.arm?.pose(joints);
            stage.player.speed = Number(this.speed.value);
            stage.say("building", "busy");
            played = stage.player.play(clip, true);
          }
          stage.player.grown(true);
        } else if (message.kind === "placed") {
          this.starts.push(clip.frames.length / clip.rate);
          this.status.textContent = `${message.blocks} of ${this.stack!.shapes.length} blocks are simulated`;
        } else if (message.kind === "built") {
          last = message.stands;
          const match = message.iou === null ? "" : `, front IoU ${message.iou.toFixed(2)}`;
          stands = `Built in ${number(message.seconds)} s of the arm's time, and it ${last ? "stands" : "does not stand"}${match}.`;
          for (const contact of message.unplanned) stands += ` Not planned: ${contact}.`;
        }
      }
      stage.player.grown(false);
      this.status.textContent = stands;
      await played;
      if (running.signal.aborted) return;
      const [verdict, tone] = last ? (["built, and stands", "stands"] as const) : (["does not stand", "falls"] as const);
      stage.onMoment = () => (stage.player.atEnd ? stage.say(verdict, tone) : stage.say("building", "busy"));
      stage.onMoment(stage.player.time);
      this.stop.textContent = "Remove arm";
      this.element.dataset.built = "";
    } catch (error) {
      if (running.signal.aborted && isAbort(error)) return;
      this.reset();
      this.status.textContent = countedFromOne(told(error));
    }
  }

  private step(by: number): void {
    const { player } = this.stage;
    const here = this.starts.filter((start) => start <= player.time + 1e-6).length - 1;
    const back = by < 0 && player.time - this.starts[here]! > 0.5 ? 0 : by;
    player.seek(this.starts[Math.max(0, Math.min(this.starts.length - 1, here + back))]!);
  }
}
