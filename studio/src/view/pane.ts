// A pane: one method's answer to the drawing, from the noise to what can be downloaded.

import { isAbort, messages, told } from "../api";
import { button, el, labelled } from "../dom";
import type { Message, Method, Pose, Shape, Start, StackFacts, StacksFile, Wish } from "../types";
import { Building } from "./build";
import { Disturbances } from "./disturb";
import { downloads } from "./downloads";
import { explain } from "./marks";
import { overlays } from "./overlays";
import { Stage, type Told } from "./stage";
import { why } from "./why";

type FileMessage = Extract<Message, { kind: "file" }>;
type StackMessage = Extract<Message, { kind: "stack" }>;

const EXPLAINED_AFTER = 1500; // [ms] after a fall
const NOISE_RATE = 14; // frames of denoising in a second

export class Pane {
  readonly element: HTMLElement;
  readonly stage: Stage;
  private readonly title = el("h3", {}, "Structures");
  private readonly state = el("p", { class: "state", role: "status" });
  private readonly tabs = el("div", { class: "tabs", role: "group", "aria-label": "Structures" });
  private readonly facts = el("div", { class: "facts" });
  private readonly share = el("div", { class: "share" });
  private readonly disturbances: Disturbances;
  private readonly building: Building;
  private readonly tools: HTMLElement;
  private readonly weights = el("input", { type: "checkbox", change: () => this.markWeights() });
  private stacks: StackFacts[] = [];
  private file: FileMessage | null = null;
  private shown = 0;
  private shapes: Shape[];
  private running: AbortController | null = null;

  constructor(
    private readonly start: Start,
    number: number,
    private readonly onBlocks: (counts: Record<string, number>) => void,
  ) {
    this.stage = new Stage(start.shapes, `Structure ${number}`);
    this.shapes = start.shapes;
    this.disturbances = new Disturbances(this.stage, () => this.building.reset());
    this.building = new Building(this.stage, () => this.disturbances.reset());
    this.stage.world.onPick = (block) => this.disturbances.choose(block);
    const explosion = el("input", { type: "range", min: 0, max: 1.5, step: 0.01, value: 0, "aria-label": "Explode" });
    explosion.addEventListener("input", () => this.stage.world.explode(Number(explosion.value)));
    const home = button("Reset the view", () => this.stage.world.home());
    const again = button("Drop it again", () => void this.drop());
    this.tools = el(
      "div",
      { class: "tools", hidden: true },
      el("div", { class: "row" }, again, home, labelled("Explode", explosion), el("label", { class: "check" }, this.weights, "Show weights")),
      this.disturbances.element,
      this.building.element,
    );
    this.element = el(
      "section",
      { class: "pane", "aria-label": `Method ${number}` },
      el("header", {}, this.title, this.state),
      this.stage.element,
      this.tabs,
      this.facts,
      this.tools,
      this.share,
    );
  }

  /** Asks a method for stacks, and shows how they come to be. */
  async run(method: Method, drawing: { cells: number; bits: string }, wish: Wish): Promise<void> {
    this.cancel();
    const running = (this.running = new AbortController());
    this.use(this.start.shapes);
    this.clear(method);
    const began = performance.now();
    let frames: Pose[][] = [];
    let arrange: (stacks: Pose[][]) => Pose[] = () => [];
    let noise: Promise<void> | null = null;
    let [checked, standing] = [0, 0];
    try {
      for await (const message of messages<Message>("/api/generate", { drawing, wish: { ...wish, method: method.name } }, running.signal)) {
        if (message.kind === "blocks") {
          arrange = this.stage.arrange(message.shapes, message.draws);
          this.stage.say(method.steps ? "denoising …" : "proposing …", "busy");
        } else if (message.kind === "noise") {
          frames.push(arrange(message.stacks));
          if (!noise) {
            this.element.dataset.firstFrame = String(Math.round(performance.now() - began));
            noise = this.stage.player.play({ frames, rate: NOISE_RATE }, true);
          }
          this.stage.player.grown(message.step < message.steps);
        } else if (message.kind === "checked") {
          [checked, standing] = [checked + 1, standing + Number(message.stable)];
          this.state.textContent = `${standing} of ${checked} simulated stand`;
        } else if (message.kind === "file") {
          this.take(message, began);
        } else if (message.kind === "stack") {
          this.add(message);
        }
      }
      await noise;
      if (!running.signal.aborted) this.choose(0);
    } catch (error) {
      if (running.signal.aborted && isAbort(error)) this.stage.say("cancelled");
      else this.refuse(told(error));
    } finally {
      if (this.running === running) this.running = null;
    }
  }

  cancel(): void {
    this.running?.abort();
    this.running = null;
  }

  /** Shows a file that was made before. */
  open(title: string, file: StacksFile, stacks: StackFacts[], shapes: Shape[]): void {
    this.cancel();
    this.use(shapes);
    this.clear({ name: "", title, steps: null });
    this.take({ kind: "file", file, command: "", picture: "", notes: [] }, null);
    for (const [number, stack] of stacks.entries()) this.add({ kind: "stack", number, ...stack });
    this.choose(0);
  }

  /** Takes the colours of the page. */
  colour(): void {
    this.stage.world.colour();
    this.tell();
  }

  private use(shapes: Shape[]): void {
    if (shapes === this.shapes) return;
    this.shapes = shapes;
    this.stage.world.setShapes(shapes);
  }

  private clear(method: Method): void {
    this.stacks = [];
    this.file = null;
    this.element.classList.add("asked"); // what comes has its place from now on, so that nothing jumps
    this.tools.hidden = false;
    this.tools.inert = true;
    this.title.textContent = method.title;
    this.state.textContent = "";
    this.stage.say("asking …", "busy");
    this.disturbances.reset();
    this.building.reset();
    this.tabs.replaceChildren();
    this.facts.replaceChildren();
    this.share.replaceChildren();
    delete this.element.dataset.done;
  }

  private refuse(sentence: string): void {
    this.stage.say("no answer", "falls");
    this.tools.hidden = true;
    this.facts.replaceChildren(el("p", { class: "error", role: "alert" }, sentence));
  }

  private take(message: FileMessage, began: number | null): void {
    this.file = message;
    const seconds = began === null ? "" : ` in ${((performance.now() - began) / 1000).toFixed(1)} s`;
    const number = message.file.stacks.length;
    this.state.textContent = `${number} structure${number === 1 ? "" : "s"}${seconds}`;
    if (message.file.block_list) this.onBlocks(message.file.block_list);
  }

  private add({ number, ...stack }: StackMessage): void {
    this.stacks.push(stack);
    const match = stack.front_iou === null ? "" : ` · IoU ${stack.front_iou.toFixed(2)}`;
    const [text, verdict] = stack.stable ? [match, "stands"] : [" · falls", "falls"];
    const tab = button(`${number + 1}${text}`, () => this.choose(number), { class: verdict, "aria-pressed": "false" });
    if (stack.stable) tab.append(el("span", { class: "visually-hidden" }, ", stands"));
    this.tabs.append(tab);
  }

  private choose(number: number): void {
    if (!this.stacks.length || !this.file) return;
    this.shown = number;
    [...this.tabs.children].forEach((tab, i) => tab.setAttribute("aria-pressed", String(i === number)));
    const stack = this.stacks[number]!;
    this.tell();
    this.share.replaceChildren(downloads(this.file, number, this.stage.world));
    this.building.take(this.file.file, number, stack);
    this.disturbances.take(this.file.file, number, stack, this.shapes.map((shape) => shape.name));
    this.tools.inert = false;
    this.stage.present(stack.shapes, stack.frames[0]!);
    void this.drop();
  }

  /** Says how the stack fared, and shows its silhouettes. */
  private tell(): void {
    const stack = this.stacks[this.shown];
    if (!stack || !this.file) return;
    const { file, notes } = this.file;
    const views = stack.views ? [overlays(stack.views, file.grid.image_size)] : [];
    this.facts.replaceChildren(
      ...notes.map((note) => el("p", { class: "note" }, note)),
      el("div", { class: "columns" }, why(stack, this.shapes), ...views),
    );
  }

  /** Switches gravity on; what falls is explained a moment later. */
  private async drop(): Promise<void> {
    const stack = this.stacks[this.shown]!;
    const told = verdictOn(stack);
    this.disturbances.reset();
    this.building.reset();
    await this.stage.playRollout(stack, told);
    this.element.dataset.done = "";
    if (stack.stable && !this.weights.checked) return;
    if (!stack.stable) await new Promise((resolve) => setTimeout(resolve, EXPLAINED_AFTER));
    if (this.stage.told === told && this.stage.player.atEnd) this.markWeights();
  }

  private markWeights(): void {
    const stack = this.stacks[this.shown];
    if (!stack) return;
    this.disturbances.reset();
    this.building.reset();
    const marked = this.weights.checked || !stack.stable;
    this.stage.holdRollout(stack, verdictOn(stack), !marked);
    this.stage.setMarks(marked ? explain(stack.statics) : null);
  }
}

function verdictOn({ stable, first }: StackFacts): Told {
  return { during: "gravity on", verdict: stable ? "stands" : "falls", stable, red: first === null ? [] : [first] };
}
