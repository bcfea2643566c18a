// The place to draw: tools, snapping, undo, and the same by keyboard.

import { button, choice, el, labelled } from "../dom";
import { Bitmap, CELL, type Point } from "./bitmap";
import { PRESETS, preset } from "./presets";

const TOOLS = { brush: "Brush", eraser: "Eraser", rectangle: "Rectangle", triangle: "Triangle", ellipse: "Circle" } as const;
type Tool = keyof typeof TOOLS;

const SNAPS: Record<string, number> = { cells: CELL, half: CELL / 2, free: 1 };
const MOST_UNDONE = 200;

export class Sketchpad {
  readonly element: HTMLElement;
  drawing = new Bitmap(4);
  private readonly canvas = el("canvas", {
    id: "sketch",
    tabindex: 0,
    role: "img",
    "aria-label": "Drawing. Arrow keys move the cursor, space draws a cell, Delete erases it.",
  });
  private readonly live = el("p", { class: "visually-hidden", role: "status" });
  private tool: Tool = "rectangle";
  private snap = "cells";
  private width = CELL;
  private past: Bitmap[] = [];
  private future: Bitmap[] = [];
  private held: { from: Point; last: Point; before: Bitmap; erase: boolean } | null = null;
  private cursor: Point | null = null; // of the keyboard, in steps of the snap
  private readonly undoButton = button("Undo", () => this.undo(), { title: "Undo (Ctrl+Z)" });
  private readonly redoButton = button("Redo", () => this.redo(), { title: "Redo (Ctrl+Y)" });
  private readonly cells: HTMLSelectElement;

  /** @param changed Called whenever the drawing is another one. */
  constructor(private readonly changed: () => void) {
    this.cells = choice([4, 5, 6, 7, 8].map((n) => [String(n), `${n} × ${n} cells`]), "4", (n) => this.resize(Number(n)));
    this.element = el("div", { class: "sketchpad" }, this.toolbar(), this.canvas, this.live, this.options());
    this.listen();
    this.paint();
  }

  /** Takes another drawing; what was there can be had back by undo. */
  replace(drawing: Bitmap): void {
    if (drawing.equals(this.drawing)) return;
    this.remember(this.drawing);
    this.show(drawing);
  }

  /** Begins with a drawing, and nothing to undo. */
  begin(drawing: Bitmap): void {
    [this.past, this.future] = [[], []];
    this.show(drawing);
  }

  private toolbar(): HTMLElement {
    const tools = el("div", { class: "segmented", role: "radiogroup", "aria-label": "Tool" });
    for (const [tool, name] of Object.entries(TOOLS) as [Tool, string][]) {
      const input = el("input", { type: "radio", name: "tool", value: tool, checked: tool === this.tool, change: () => (this.tool = tool) });
      tools.append(el("label", {}, input, el("span", {}, name)));
    }
    const clear = button("Clear", () => this.replace(new Bitmap(this.drawing.cells)));
    return el("div", { class: "toolbar" }, tools, el("span", { class: "spacer" }), this.undoButton, this.redoButton, clear);
  }

  private options(): HTMLElement {
    const snaps = choice([["cells", "to cells"], ["half", "to half cells"], ["free", "free"]], this.snap, (snap) => {
      this.snap = snap;
      this.cursor = null;
      this.paint();
    });
    const brush = choice([["5", "fine"], ["14", "one cell"], ["28", "two cells"]], String(this.width), (w) => (this.width = Number(w)));
    const presets = choice([["", "choose …"], ...Object.keys(PRESETS).map((name): [string, string] => [name, name])], "", (name) => {
      if (name) this.replace(preset(name));
      presets.value = "";
    });
    presets.id = "presets";
    return el("div", { class: "fields" }, labelled("Example", presets), labelled("Paper", this.cells), labelled("Snap", snaps), labelled("Brush", brush));
  }

  private listen(): void {
    const canvas = this.canvas;
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button > 2) return;
      canvas.setPointerCapture(event.pointerId);
      const from = this.at(event);
      const erase = this.tool === "eraser" || event.button === 2;
      this.held = { from, last: from, before: this.drawing, erase };
      this.cursor = null;
      this.drag(event);
    });
    canvas.addEventListener("pointermove", (event) => this.held && this.drag(event));
    canvas.addEventListener("pointerup", () => this.release());
    canvas.addEventListener("pointercancel", () => this.release());
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("blur", () => {
      this.cursor = null;
      this.paint();
    });
    document.addEventListener("keydown", (event) => {
      if (!(event.ctrlKey || event.metaKey) || (event.target as HTMLElement).matches("input[type=text], input[type=number]")) return;
      const again = event.key.toLowerCase() === "y" || (event.key.toLowerCase() === "z" && event.shiftKey);
      if (!again && event.key.toLowerCase() !== "z") return;
      event.preventDefault();
      if (again) this.redo();
      else this.undo();
    });
  }

  private at(event: PointerEvent): Point {
    const box = this.canvas.getBoundingClientRect();
    const scale = this.drawing.size / box.width;
    return { x: (event.clientX - box.left) * scale, y: (event.clientY - box.top) * scale };
  }

  private drag(event: PointerEvent): void {
    const held = this.held!;
    const to = this.at(event);
    const step = SNAPS[this.snap]!;
    const value = held.erase ? 0 : 1;
    if (this.tool !== "brush" && this.tool !== "eraser") {
      this.drawing = held.before.copy();
      this.drawing[this.tool](value, ...spanned(held.from, to, step));
    } else {
      const drawing = this.drawing === held.before ? this.drawing.copy() : this.drawing;
      if (step === 1) drawing.line(value, held.last, to, this.width);
      else for (const point of between(held.last, to, step / 2)) drawing.rectangle(value, ...spanned(point, point, step));
      held.last = to;
      this.drawing = drawing;
    }
    this.paint();
  }

  private release(): void {
    if (!this.held) return;
    const { before } = this.held;
    this.held = null;
    if (this.drawing.equals(before)) return;
    this.remember(before);
    this.show(this.drawing);
  }

  private key(event: KeyboardEvent): void {
    const moves: Record<string, [number, number]> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const step = Math.max(SNAPS[this.snap]!, CELL / 2);
    const most = this.drawing.size / step - 1;
    const cursor = this.cursor ?? { x: Math.floor(most / 2), y: most };
    const move = moves[event.key];
    const draws = event.key === " " || event.key === "Enter";
    if (!move && !draws && event.key !== "Delete" && event.key !== "Backspace") return;
    event.preventDefault();
    if (move) {
      this.cursor = { x: clamp(cursor.x + move[0], 0, most), y: clamp(cursor.y + move[1], 0, most) };
      this.paint();
    } else {
      const next = this.drawing.copy();
      next.rectangle(draws ? 1 : 0, { x: cursor.x * step, y: cursor.y * step }, { x: (cursor.x + 1) * step, y: (cursor.y + 1) * step });
      this.cursor = cursor;
      this.replace(next);
    }
    this.live.textContent = `column ${this.cursor!.x + 1}, ${most - this.cursor!.y + 1} from the ground`;
  }

  private remember(drawing: Bitmap): void {
    this.past = [...this.past, drawing].slice(-MOST_UNDONE);
    this.future = [];
  }

  private undo(): void {
    const last = this.past.pop();
    if (!last) return;
    this.future.push(this.drawing);
    this.show(last);
  }

  private redo(): void {
    const next = this.future.pop();
    if (!next) return;
    this.past.push(this.drawing);
    this.show(next);
  }

  private resize(cells: number): void {
    this.replace(this.drawing.resized(cells));
  }

  private show(drawing: Bitmap): void {
    this.drawing = drawing;
    this.cells.value = String(drawing.cells);
    this.undoButton.disabled = !this.past.length;
    this.redoButton.disabled = !this.future.length;
    this.paint();
    this.changed();
  }

  /** Paints paper, grid, drawing and the keyboard's cursor. */
  paint(): void {
    const { size, cells, pixels } = this.drawing;
    const scale = Math.max(2, Math.ceil(560 / size));
    this.canvas.width = this.canvas.height = size * scale;
    const pen = this.canvas.getContext("2d")!;
    const style = getComputedStyle(document.documentElement);
    const colour = (name: string) => style.getPropertyValue(name).trim();
    pen.fillStyle = colour("--paper");
    pen.fillRect(0, 0, size * scale, size * scale);
    pen.fillStyle = colour("--ink");
    for (let y = 0; y < size; y++)
      for (let x = 0; x < size; ) {
        const from = x;
        while (x < size && pixels[y * size + x]) x++;
        if (x > from) pen.fillRect(from * scale, y * scale, (x - from) * scale, scale);
        else x++;
      }
    pen.strokeStyle = colour("--grid");
    for (let i = 1; i < cells * 2; i++) {
      pen.globalAlpha = i % 2 ? 0.35 : 1;
      if (i % 2 && this.snap === "cells") continue;
      const at = (i * CELL * scale) / 2 + 0.5;
      pen.beginPath();
      pen.moveTo(at, 0);
      pen.lineTo(at, size * scale);
      pen.moveTo(0, at);
      pen.lineTo(size * scale, at);
      pen.stroke();
    }
    pen.globalAlpha = 1;
    if (this.cursor) {
      const step = Math.max(SNAPS[this.snap]!, CELL / 2) * scale;
      pen.strokeStyle = colour("--accent");
      pen.lineWidth = 4;
      pen.strokeRect(this.cursor.x * step + 2, this.cursor.y * step + 2, step - 4, step - 4);
    }
  }
}

/** The smallest box on the grid of a snap that holds two points. */
function spanned(a: Point, b: Point, step: number): [Point, Point] {
  return [
    { x: Math.floor(Math.min(a.x, b.x) / step) * step, y: Math.floor(Math.min(a.y, b.y) / step) * step },
    { x: (Math.floor(Math.max(a.x, b.x) / step) + 1) * step, y: (Math.floor(Math.max(a.y, b.y) / step) + 1) * step },
  ];
}

function* between(a: Point, b: Point, step: number): Generator<Point> {
  const number = Math.max(1, Math.ceil(Math.hypot(b.x - a.x, b.y - a.y) / step));
  for (let i = 0; i <= number; i++) yield { x: a.x + ((b.x - a.x) * i) / number, y: a.y + ((b.y - a.y) * i) / number };
}

function clamp(value: number, low: number, high: number): number {
  return Math.min(high, Math.max(low, value));
}
