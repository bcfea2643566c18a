// Silhouettes of target and stack over each other, from three sides.

import { unpackRows } from "../draw/bitmap";
import { bytesOf, el } from "../dom";
import type { ViewName, Views } from "../types";

export function overlays(views: Views, size: number): HTMLElement {
  const row = el("div", { class: "overlays" });
  for (const name of ["front", "side", "top"] as ViewName[]) {
    const { target, stack, iou } = views[name];
    const canvas = el("canvas", { width: size, height: size, role: "img", "aria-label": `${name} view: IoU ${iou.toFixed(2)}` });
    paint(canvas, unpackRows(bytesOf(target), size), unpackRows(bytesOf(stack), size));
    row.append(el("figure", {}, canvas, el("figcaption", {}, `${name} `, el("b", {}, iou.toFixed(2)))));
  }
  return row;
}

function paint(canvas: HTMLCanvasElement, target: Uint8Array, stack: Uint8Array): void {
  const pen = canvas.getContext("2d")!;
  const style = getComputedStyle(document.documentElement);
  const names = ["--paper", "--only-target", "--only-stack", "--both"];
  const colours = names.map((name) => style.getPropertyValue(name).trim());
  target.forEach((wanted, i) => {
    pen.fillStyle = colours[wanted + 2 * stack[i]!]!;
    pen.fillRect(i % canvas.width, Math.floor(i / canvas.width), 1, 1);
  });
}
