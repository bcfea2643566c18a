// Tilting the table and pushing a block: the simulator says what becomes of the stack, statics where the limit is.

import { post, told } from "../api";
import { choice, el, labelled } from "../dom";
import type { Rollout, StackFacts, StacksFile } from "../types";
import { arrow } from "./marks";
import type { Stage } from "./stage";
import { number } from "./why";

const DIRECTIONS: [string, string][] = [["0", "to the right"], ["180", "to the left"], ["-90", "to the front"], ["90", "to the back"]];
const MOST_TILT = 45; // [degrees]
const MOST_PUSH = 2; // [weights of the block]

export class Disturbances {
  readonly element: HTMLElement;
  private readonly tiltSlider = slider(0, MOST_TILT, 0.5, "Tilt of the table in degrees");
  private readonly pushSlider = slider(0, MOST_PUSH, 0.05, "Push in weights of the block");
  private readonly tiltLimit = el("span", { class: "limit" });
  private readonly pushLimit = el("span", { class: "limit" });
  private readonly tiltValue = el("output");
  private readonly pushValue = el("output");
  private readonly answer = el("p", { class: "answer", role: "status" });
  private readonly block = el("select", { "aria-label": "Block that is pushed" });
  private tiltDirection = "0";
  private pushDirection = "0";
  private asked: AbortController | null = null;
  private file: StacksFile | null = null;
  private stack: StackFacts | null = null;
  private place = 0;

  constructor(private readonly stage: Stage) {
    const towards = choice(DIRECTIONS, "0", (value) => ((this.tiltDirection = value), this.tilt()));
    const pushed = choice(DIRECTIONS, "0", (value) => ((this.pushDirection = value), this.push()));
    this.tiltSlider.addEventListener("input", () => this.previewTilt());
    this.tiltSlider.addEventListener("change", () => this.tilt());
    this.pushSlider.addEventListener("input", () => this.previewPush());
    this.pushSlider.addEventListener("change", () => this.push());
    this.block.addEventListener("change", () => this.push());
    this.element = el(
      "div",
      { class: "disturb" },
      el("div", { class: "row" }, labelled("Tilt the table", this.tracked(this.tiltSlider, this.tiltLimit)), this.tiltValue, labelled("Direction", towards)),
      el("div", { class: "row" }, labelled("Push a block", this.tracked(this.pushSlider, this.pushLimit)), this.pushValue, labelled("Block", this.block), labelled("Direction", pushed)),
      this.answer,
    );
  }

  /** Takes the stack that is disturbed from now on. */
  take(file: StacksFile, place: number, stack: StackFacts, names: string[]): void {
    Object.assign(this, { file, place, stack });
    this.block.replaceChildren(...stack.shapes.map((shape, i) => el("option", { value: i }, `${i + 1} ${names[shape]!.replaceAll("_", " ")}`)));
    this.block.value = String(stack.shapes.length - 1);
    limit(this.tiltLimit, statics(stack.statics.margin, MOST_TILT), `statics: ${number(stack.statics.margin)}°`);
    limit(this.pushLimit, statics(stack.statics.push ?? 0, MOST_PUSH), `statics, the weakest block: ${(stack.statics.push ?? 0).toFixed(2)}`);
    this.reset();
  }

  /** Puts table and blocks back. */
  reset(): void {
    this.asked?.abort();
    this.tiltSlider.value = this.pushSlider.value = "0";
    this.tiltValue.textContent = this.pushValue.textContent = this.answer.textContent = "";
    this.stage.world.tilt(0, 0);
    this.stage.setMarks(null);
  }

  /** Chooses the block to push. */
  choose(block: number): void {
    this.block.value = String(block);
    if (Number(this.pushSlider.value)) void this.push();
  }

  private tracked(input: HTMLInputElement, mark: HTMLElement): HTMLElement {
    return el("span", { class: "track" }, input, mark);
  }

  private previewTilt(): void {
    this.pushSlider.value = "0";
    this.pushValue.textContent = "";
    this.tiltValue.textContent = `${this.tiltSlider.value}°`;
    this.stage.still();
    this.stage.world.tilt(Number(this.tiltSlider.value), Number(this.tiltDirection));
  }

  private previewPush(): void {
    this.tiltSlider.value = "0";
    this.tiltValue.textContent = "";
    this.pushValue.textContent = `${Number(this.pushSlider.value).toFixed(2)} × its weight`;
    this.stage.still();
    this.stage.world.tilt(0, 0);
    const center = this.stack!.statics.centers[Number(this.block.value)]!;
    this.stage.setMarks(arrow(center, Number(this.pushDirection), Number(this.pushSlider.value)));
  }

  private async tilt(): Promise<void> {
    if (!this.stack) return;
    this.previewTilt();
    const degrees = Number(this.tiltSlider.value);
    await this.ask("tilt", { degrees, direction: Number(this.tiltDirection) }, (stands) =>
      `Tilted by ${number(degrees)}° it ${stands ? "stands" : "falls"}; statics gives ${number(this.stack!.statics.margin)}° in the worst direction.`,
    );
  }

  private async push(): Promise<void> {
    if (!this.stack || !Number(this.pushSlider.value)) return;
    this.previewPush();
    const force = Number(this.pushSlider.value);
    const block = Number(this.block.value);
    await this.ask("push", { block, force, direction: Number(this.pushDirection) }, (stands) =>
      `Pushed at block ${block + 1} with ${force.toFixed(2)} times its weight it ${stands ? "stands" : "falls"}.`,
    );
  }

  private async ask(what: "tilt" | "push", how: object, say: (stands: boolean) => string): Promise<void> {
    this.asked?.abort();
    const asked = (this.asked = new AbortController());
    try {
      const rollout = await post<Rollout>(`/api/${what}`, { file: this.file, stack: this.place, ...how }, asked.signal);
      this.answer.textContent = say(rollout.stable);
      this.answer.className = `answer ${rollout.stable ? "stands" : "falls"}`;
      this.stage.say(what === "tilt" ? "tilted" : "pushed", "busy");
      await this.stage.playRollout(rollout);
    } catch (error) {
      if (!asked.signal.aborted) this.answer.textContent = told(error);
    }
  }
}

function slider(min: number, max: number, step: number, name: string): HTMLInputElement {
  return el("input", { type: "range", min, max, step, value: 0, "aria-label": name });
}

function statics(value: number, most: number): number {
  return Math.min(1, value / most);
}

function limit(mark: HTMLElement, share: number, text: string): void {
  mark.style.setProperty("--at", String(share));
  mark.title = text;
  mark.textContent = text;
  mark.classList.toggle("right", share > 0.5);
}
