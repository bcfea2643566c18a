// Tilting the table and pushing a block, harder and harder: the simulator says when the stack falls, statics where the
// limit is.

import { post, told } from "../api";
import { button, choice, el, labelled } from "../dom";
import type { Disturbed, StackFacts, StacksFile } from "../types";
import { arrow } from "./marks";
import type { Stage } from "./stage";
import { number } from "./why";

const DIRECTIONS: [string, string][] = [["0", "to the right"], ["180", "to the left"], ["-90", "to the front"], ["90", "to the back"]];
const MOST_TILT = 45; // [degrees]
const MOST_PUSH = 2; // [weights of the block]

/** A slider with two marks under it: the limit of statics, and where the stack fell. */
class Track {
  readonly slider: HTMLInputElement;
  readonly element: HTMLElement;
  private readonly value = el("span", { class: "value" });
  private readonly limit = el("span", { class: "limit" });
  private readonly fall = el("span", { class: "limit fall" });

  constructor(label: string, name: string, private readonly most: number, step: number, private readonly unit: (value: number) => string) {
    this.slider = el("input", { type: "range", min: 0, max: most, step, value: 0, "aria-label": name });
    this.element = el("label", { class: "field" }, el("span", {}, `${label} `, this.value), el("span", { class: "track" }, this.slider, this.limit, this.fall));
  }

  show(value: number): void {
    this.slider.value = String(value);
    this.value.textContent = value ? this.unit(value) : "";
  }

  markLimit(value: number, of: string): void {
    mark(this.limit, value / this.most, `statics${of}: ${this.unit(value)}`);
  }

  markFall(value: number | null): void {
    mark(this.fall, (value ?? 0) / this.most, value === null ? "" : `fell at ${this.unit(value)}`);
  }
}

export class Disturbances {
  readonly element: HTMLElement;
  private readonly tilted = new Track("Tilt the table", "Tilt of the table in degrees", MOST_TILT, 0.5, (value) => `${value.toFixed(1)}°`);
  private readonly pushed = new Track("Push a block", "Push in weights of the block", MOST_PUSH, 0.05, (value) => `${value.toFixed(2)} × weight`);
  private readonly answer = el("p", { class: "answer", role: "status" });
  private readonly block = choice([], "", () => void this.push());
  private tiltDirection = "0";
  private pushDirection = "0";
  private asked: AbortController | null = null;
  private file: StacksFile | null = null;
  private stack: StackFacts | null = null;
  private place = 0;

  /** @param begins Called before the stage is used. */
  constructor(
    private readonly stage: Stage,
    private readonly begins: () => void,
  ) {
    const towards = choice(DIRECTIONS, "0", (value) => {
      this.tiltDirection = value;
      if (Number(this.tilted.slider.value)) void this.tilt();
    });
    const pushed = choice(DIRECTIONS, "0", (value) => {
      this.pushDirection = value;
      void this.push();
    });
    this.tilted.slider.addEventListener("input", () => this.preview(this.tilted));
    this.tilted.slider.addEventListener("change", () => void this.tilt());
    this.pushed.slider.addEventListener("input", () => this.preview(this.pushed));
    this.pushed.slider.addEventListener("change", () => void this.push());
    const untilItFalls = (track: Track, go: () => Promise<void>) =>
      button("Until it falls", () => {
        track.show(Number(track.slider.max));
        void go();
      });
    this.element = el(
      "div",
      { class: "disturb" },
      el("div", { class: "row" }, this.tilted.element, labelled("Direction", towards), untilItFalls(this.tilted, () => this.tilt())),
      el("div", { class: "row" }, this.pushed.element, labelled("Block", this.block), labelled("Direction", pushed), untilItFalls(this.pushed, () => this.push())),
      this.answer,
    );
  }

  /** Takes the stack that is disturbed from now on. */
  take(file: StacksFile, place: number, stack: StackFacts, names: string[]): void {
    this.reset();
    Object.assign(this, { file, place, stack });
    this.block.replaceChildren(...stack.shapes.map((shape, i) => el("option", { value: i }, `${i + 1} ${names[shape]!.replaceAll("_", " ")}`)));
    this.block.value = String(stack.shapes.length - 1);
    this.tilted.markLimit(stack.statics.margin, "");
    this.pushed.markLimit(stack.statics.push ?? 0, ", weakest block");
  }

  /** Forgets what was asked; the sliders go back. */
  reset(): void {
    this.asked?.abort();
    this.answer.textContent = "";
    for (const track of [this.tilted, this.pushed]) {
      track.show(0);
      track.markFall(null);
    }
  }

  /** Chooses the block to push. */
  choose(block: number): void {
    this.block.value = String(block);
    if (Number(this.pushed.slider.value)) void this.push();
  }

  /** Shows the tilt or the push that is being chosen, of a stack that does not move yet. */
  private preview(track: Track): void {
    const value = Number(track.slider.value);
    this.reset();
    this.begins();
    track.show(value);
    this.stage.still();
    if (track === this.tilted) this.stage.world.tilt(value, Number(this.tiltDirection));
    else this.stage.setMarks(arrow(this.stack!.statics.centers[Number(this.block.value)]!, Number(this.pushDirection), value));
  }

  private async tilt(): Promise<void> {
    const [degrees, direction] = [Number(this.tilted.slider.value), Number(this.tiltDirection)];
    this.preview(this.tilted);
    await this.ask("tilt", this.tilted, { degrees, direction }, (angle) => this.stage.world.tilt(angle, direction), (at, stands) => {
      const limit = `statics gives ${number(this.stack!.statics.margin)}° in the worst direction`;
      return [`${at.toFixed(1)}°`, stands ? `Tilted by ${number(at)}° it stands; ${limit}.` : `It falls at ${at.toFixed(1)}°; ${limit}.`];
    });
  }

  private async push(): Promise<void> {
    const [force, block, direction] = [Number(this.pushed.slider.value), Number(this.block.value), Number(this.pushDirection)];
    if (!force) return;
    this.preview(this.pushed);
    const center = this.stack!.statics.centers[block]!;
    const push = (amount: number, moved: number[]) => this.stage.setMarks(arrow(center.map((x, i) => x + moved[i]!), direction, amount));
    await this.ask("push", this.pushed, { block, force, direction }, push, (at, stands) => {
      const limit = `statics gives ${(this.stack!.statics.push ?? 0).toFixed(2)} for the weakest block and direction`;
      const times = `${at.toFixed(2)} times its weight`;
      return [`${at.toFixed(2)} × weight`, stands ? `It stands when block ${block + 1} is pushed with ${times}; ${limit}.` : `It falls when block ${block + 1} is pushed with ${times}; ${limit}.`];
    }, block);
  }

  /** Has the simulator disturb the stack, and plays what it saw: how much it is disturbed grows with time. */
  private async ask(
    what: "tilt" | "push",
    track: Track,
    how: object,
    disturb: (amount: number, moved: number[]) => void,
    say: (at: number, stands: boolean) => [brief: string, whole: string],
    block = 0,
  ): Promise<void> {
    const asked = (this.asked = new AbortController());
    const { stage } = this;
    stage.say("simulating …", "busy");
    try {
      const rollout = await post<Disturbed>(`/api/${what}`, { file: this.file, stack: this.place, ...how }, asked.signal);
      const [brief, whole] = say(rollout.fell_at ?? rollout.reached, rollout.stable);
      const verdict = `${rollout.stable ? "stands" : "falls"} at ${brief}`;
      void stage.playRollout(rollout, { during: what === "tilt" ? "tilting" : "pushing", verdict, stable: rollout.stable, red: rollout.first === null ? [] : [rollout.first] });
      stage.onMoment = (time) => {
        const amount = Math.min(rollout.reached, rollout.growth * time);
        const [now, start] = [rollout.frames[Math.floor(time * rollout.rate + 1e-6)]![block]!, rollout.frames[0]![block]!];
        disturb(amount, now.slice(0, 3).map((x, i) => x - start[i]!));
        track.show(amount);
        if (!stage.player.atEnd) return;
        track.markFall(rollout.fell_at);
        this.answer.textContent = whole;
        this.answer.className = `answer ${rollout.stable ? "stands" : "falls"}`;
      };
    } catch (error) {
      if (asked.signal.aborted) return;
      stage.say("");
      this.answer.textContent = told(error);
      this.answer.className = "answer falls";
    }
  }
}

function mark(element: HTMLElement, share: number, text: string): void {
  element.style.setProperty("--at", String(Math.min(1, share)));
  element.textContent = text;
  element.classList.toggle("right", share > 0.5);
}
