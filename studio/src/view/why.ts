// Says in words how a stack fared and why.

import { el } from "../dom";
import type { Shape, StackFacts } from "../types";

export function why(stack: StackFacts, shapes: Shape[]): HTMLElement {
  const name = (block: number) => `block ${block + 1} (${shapes[stack.shapes[block]!]!.name.replaceAll("_", " ")})`;
  const { statics } = stack;
  const list = el("ul", { class: "why" });
  const say = (text: string) => list.append(el("li", {}, text));
  if (stack.first !== null) say(`${capital(name(stack.first))} goes first, ${stack.fell.length > 1 ? `and ${stack.fell.length - 1} more fall` : "and alone"}.`);
  for (const [block, reason] of Object.entries(statics.reasons)) say(`${capital(name(Number(block)))} ${phrase(reason)}.`);
  if (statics.missing > 0) say(`Something would have to hold it with about ${number(statics.missing)} times a cube's weight.`);
  if (stack.stable && statics.margin > 0) say(`It survives a tilt of ${number(statics.margin)}° in the worst direction${statics.push ? `, and a push of ${Math.round(statics.push * 100)} % of any one block's weight` : ""}.`);
  if (stack.stable && statics.margin === 0) say("By statics it is on a knife's edge: the simulator lets it stand.");
  if (!stack.stable && statics.stable) say("At rest it would stand; the blocks were put down too high or into each other, and that fells it.");
  if (stack.comment) say(`${capital(stack.comment)}.`);
  return list;
}

function phrase(reason: string): string {
  if (reason.startsWith("centre of mass")) return `has its ${reason}: nothing holds it there`;
  return countedFromOne(reason);
}

/** Numbers of blocks as the page has them. */
export function countedFromOne(text: string): string {
  return text.replace(/block (\d+)/g, (_, n) => `block ${Number(n) + 1}`).replace(/ and (\d+)/g, (_, n) => ` and ${Number(n) + 1}`);
}

export function capital(text: string): string {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

export function number(value: number): string {
  return value.toFixed(value < 10 ? 1 : 0).replace(/\.0$/, "");
}
