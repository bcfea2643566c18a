// What is asked for: methods, blocks, number, seed, sampler.

import { choice, el, labelled } from "./dom";
import type { Method, Start, Wish } from "./types";

type BlocksMode = "any" | "exactly" | "at-most";

export interface Settings {
  method: string;
  compared: string; // "" for none
  number: number;
  seed: number;
  verified: boolean;
  mode: BlocksMode;
  counts: Record<string, number>;
  kind: string;
  steps: number;
}

export const DEFAULTS: Settings = {
  method: "best",
  compared: "taught-verdicts",
  number: 3,
  seed: 0,
  verified: true,
  mode: "any",
  counts: {},
  kind: "dpm",
  steps: 10,
};

export class SettingsForm {
  readonly element: HTMLElement;
  private counters: Record<string, HTMLInputElement> = {};
  private predicted: Record<string, number> = {};

  constructor(
    private readonly start: Start,
    readonly settings: Settings,
    private readonly changed: () => void,
  ) {
    this.element = el("div", { class: "settings" });
    this.build();
  }

  /** Another way to ask the server for the same. */
  wish(method: Method): Wish {
    const { number, seed, verified, mode, counts, kind, steps } = this.settings;
    const chosen = Object.fromEntries(Object.entries(counts).filter(([, n]) => n > 0));
    const denoises = method.steps !== null;
    return {
      method: method.name,
      number,
      seed,
      blocks: mode === "exactly" ? chosen : null,
      inventory: mode === "at-most" ? chosen : null,
      sampler: denoises ? { kind, steps: Math.min(steps, method.steps!) } : { kind: null, steps: null },
      verified,
    };
  }

  method(name: string): Method | undefined {
    return this.start.methods.find((method) => method.name === name);
  }

  /** Takes a block list that a method chose: it is where editing begins. */
  predict(counts: Record<string, number>): void {
    this.predicted = counts;
    if (this.settings.mode !== "any") return;
    for (const [name, counter] of Object.entries(this.counters)) counter.value = String(counts[name] ?? 0);
  }

  private build(): void {
    const { settings, start } = this;
    const set = <K extends keyof Settings>(key: K, value: Settings[K]) => {
      settings[key] = value;
      this.changed();
    };
    const titles = start.methods.map(({ name, title }): [string, string] => [name, title]);
    const method = choice(titles, settings.method, (name) => (set("method", name), this.build()));
    method.id = "method";
    const compared = choice([["", "nothing else"], ...titles], settings.compared, (name) => (set("compared", name), this.build()));
    compared.id = "compared";
    const number = count(settings.number, 1, 6, (value) => set("number", value));
    number.id = "number";
    const seed = count(settings.seed, 0, 2 ** 31 - 1, (value) => set("seed", value));
    const verified = el("input", { type: "checkbox", checked: settings.verified, change: () => set("verified", verified.checked) });
    const both = [this.method(settings.method), this.method(settings.compared)].filter((m) => m !== undefined);
    const steps = Math.max(0, ...both.map((m) => m.steps ?? 0));
    const rows: HTMLElement[] = [
      labelled("Method", method),
      labelled("Beside it", compared),
      this.blocks(set),
      el("div", { class: "fields" }, labelled("Structures", number), labelled("Seed", seed)),
    ];
    if (both.some((m) => m.name !== "best"))
      rows.push(el("label", { class: "check" }, verified, "Verified: draw many, keep the best that stand"));
    if (steps) {
      const kind = choice([["dpm", "DPM-Solver++"], ["ddim", "DDIM"], ["ddpm", "DDPM"]], settings.kind, (value) => set("kind", value));
      rows.push(el("div", { class: "fields" }, labelled("Sampler", kind), labelled(`Steps, 1 to ${steps}`, count(Math.min(settings.steps, steps), 1, steps, (value) => set("steps", value)))));
    }
    this.element.replaceChildren(...rows);
  }

  private blocks(set: <K extends keyof Settings>(key: K, value: Settings[K]) => void): HTMLElement {
    const { settings, start } = this;
    const modes: [BlocksMode, string][] = [["any", "chosen for me"], ["exactly", "exactly these"], ["at-most", "at most these"]];
    const mode = choice(modes, settings.mode, (value) => {
      const empty = !Object.values(settings.counts).some(Boolean);
      if (value !== "any" && empty) settings.counts = { ...this.predicted };
      set("mode", value as BlocksMode);
      this.build();
    });
    mode.id = "blocks";
    mode.setAttribute("aria-label", "Blocks");
    const counters = el("div", { class: "counters" });
    this.counters = {};
    start.shapes.forEach(({ name, colour }) => {
      const shown = settings.mode === "any" ? this.predicted : settings.counts;
      const counter = count(shown[name] ?? 0, 0, 20, (value) => set("counts", { ...settings.counts, [name]: value }));
      counter.disabled = settings.mode === "any";
      this.counters[name] = counter;
      const field = labelled(name.replaceAll("_", " "), counter);
      field.style.setProperty("--shape", `rgb(${colour.map((c) => Math.round(c * 255)).join(" ")})`);
      counters.append(field);
    });
    return el("fieldset", {}, el("legend", {}, "Blocks"), mode, counters);
  }
}

function count(value: number, min: number, max: number, change: (value: number) => void): HTMLInputElement {
  const input = el("input", { type: "number", min, max, step: 1, value, inputmode: "numeric" });
  input.addEventListener("change", () => {
    const whole = Math.round(Number(input.value)) || min;
    input.value = String(Math.max(min, Math.min(max, whole)));
    change(Number(input.value));
  });
  return input;
}
