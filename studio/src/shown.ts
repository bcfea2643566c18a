// The page of `stackgen show`, and a notebook's view: stacks to turn and choose from, and how they settle.

import { button, el } from "./dom";
import type { Pose, Shape } from "./types";
import { Stage } from "./view/stage";

/** What stackgen/viz/scene.py describes. */
export interface Shown {
  title: string;
  shapes: Shape[];
  stacks: { shapes: number[]; sampled: Pose[]; stable?: boolean; fell?: number[]; drop?: number[]; settled?: Pose[] }[];
}

const SETTLING = 0.7; // [s]

export function show({ title, shapes, stacks }: Shown): void {
  const stage = new Stage(shapes, title);
  const facts = el("p", { role: "status" });
  const name = (stack: Shown["stacks"][number], block: number) => `block ${block}, ${shapes[stack.shapes[block]!]!.name.replaceAll("_", " ")}`;
  const choose = (number: number) => {
    const stack = stacks[number]!;
    [...tabs.children].forEach((tab, i) => tab.setAttribute("aria-pressed", String(i === number)));
    const fallen = (stack.fell ?? []).map((block) => `${name(stack, block)}: ${stack.drop![block]!.toFixed(1)} cells`);
    facts.textContent = `Stack ${number + 1} of ${stacks.length}, ${stack.shapes.length} blocks${fallen.length ? `; what fell: ${fallen.join("; ")}` : ""}.`;
    stage.present(stack.shapes, stack.sampled);
    if (!stack.settled) return;
    const told = { during: "settling", verdict: stack.stable ? "stands" : "falls", stable: stack.stable!, red: stack.fell! };
    stage.holdRollout({ frames: [stack.sampled, stack.settled], rate: 1 / SETTLING }, told, false);
  };
  const tabs = el("div", { class: "tabs", role: "group", "aria-label": "Stacks" });
  stacks.forEach(({ stable }, i) => tabs.append(button(String(i + 1), () => choose(i), { class: stable === undefined ? "" : stable ? "stands" : "falls" })));
  document.body.className = "shown";
  document.body.append(el("header", {}, el("h1", {}, title), tabs), stage.element, facts);
  stage.world.colour();
  choose(0);
}
