// A drawing: a square of cells that stands on the ground, 14 x 14 pixels each, and what can be done to it.

import { base64Of, bytesOf } from "../dom";

export const CELL = 14;

export interface Point {
  x: number; // [pixel], to the right
  y: number; // [pixel], down
}

export class Bitmap {
  readonly size: number;
  constructor(
    readonly cells: number,
    readonly pixels: Uint8Array = new Uint8Array((cells * CELL) ** 2),
  ) {
    this.size = cells * CELL;
  }

  copy(): Bitmap {
    return new Bitmap(this.cells, this.pixels.slice());
  }

  get empty(): boolean {
    return !this.pixels.includes(1);
  }

  equals(other: Bitmap): boolean {
    return this.cells === other.cells && this.pixels.every((pixel, i) => pixel === other.pixels[i]);
  }

  /** Sets the pixels whose centres a test accepts. */
  fill(value: 0 | 1, inside: (x: number, y: number) => boolean): void {
    for (let y = 0; y < this.size; y++)
      for (let x = 0; x < this.size; x++) if (inside(x + 0.5, y + 0.5)) this.pixels[y * this.size + x] = value;
  }

  rectangle(value: 0 | 1, a: Point, b: Point): void {
    const [left, right] = [Math.min(a.x, b.x), Math.max(a.x, b.x)];
    const [top, bottom] = [Math.min(a.y, b.y), Math.max(a.y, b.y)];
    this.fill(value, (x, y) => x > left && x < right && y > top && y < bottom);
  }

  triangle(value: 0 | 1, a: Point, b: Point): void {
    const [left, right] = [Math.min(a.x, b.x), Math.max(a.x, b.x)];
    const [top, bottom] = [Math.min(a.y, b.y), Math.max(a.y, b.y)];
    const middle = (left + right) / 2;
    this.fill(value, (x, y) => y > top && y < bottom && Math.abs(x - middle) < ((right - left) / 2) * ((y - top) / (bottom - top)));
  }

  ellipse(value: 0 | 1, a: Point, b: Point): void {
    const [middleX, middleY] = [(a.x + b.x) / 2, (a.y + b.y) / 2];
    const [halfX, halfY] = [Math.abs(a.x - b.x) / 2, Math.abs(a.y - b.y) / 2];
    this.fill(value, (x, y) => Math.hypot((x - middleX) / halfX, (y - middleY) / halfY) < 1);
  }

  line(value: 0 | 1, a: Point, b: Point, width: number): void {
    const length = Math.hypot(b.x - a.x, b.y - a.y);
    this.fill(value, (x, y) => {
      const t = length ? Math.max(0, Math.min(1, ((x - a.x) * (b.x - a.x) + (y - a.y) * (b.y - a.y)) / length ** 2)) : 0;
      return Math.hypot(x - a.x - t * (b.x - a.x), y - a.y - t * (b.y - a.y)) <= width / 2;
    });
  }

  /** The same drawing in the middle of another number of cells, on the ground; what does not fit is cut off. */
  resized(cells: number): Bitmap {
    const to = new Bitmap(cells);
    const [dx, dy] = [Math.floor((to.size - this.size) / 2 / CELL) * CELL, to.size - this.size];
    for (let y = 0; y < to.size; y++)
      for (let x = 0; x < to.size; x++) {
        const [fromX, fromY] = [x - dx, y - dy];
        if (fromX >= 0 && fromX < this.size && fromY >= 0 && fromY < this.size)
          to.pixels[y * to.size + x] = this.pixels[fromY * this.size + fromX]!;
      }
    return to;
  }

  /** Bits row by row, rows padded to bytes, as base64: what the server takes. */
  pack(): string {
    return base64Of(packRows(this.pixels, this.size));
  }

  static unpack(bits: string, cells: number): Bitmap {
    return new Bitmap(cells, unpackRows(bytesOf(bits), cells * CELL));
  }

  /** Lengths of runs of equal pixels, as base64 for a link. */
  shorten(): string {
    const runs: number[] = [];
    let [value, run] = [0, 0];
    for (const pixel of this.pixels) {
      if (pixel !== value) {
        runs.push(run);
        [value, run] = [pixel, 0];
      }
      run++;
    }
    if (value) runs.push(run);
    const bytes: number[] = [];
    for (let run of runs) {
      for (; run > 127; run >>= 7) bytes.push(128 | (run & 127));
      bytes.push(run);
    }
    return base64Of(Uint8Array.from(bytes)).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
  }

  static lengthen(text: string, cells: number): Bitmap {
    const drawing = new Bitmap(cells);
    let [at, value, run, shift] = [0, 0, 0, 0];
    for (const byte of bytesOf(text.replaceAll("-", "+").replaceAll("_", "/"))) {
      run |= (byte & 127) << shift;
      shift += 7;
      if (byte & 128) continue;
      drawing.pixels.fill(value, at, at + run);
      [at, value, run, shift] = [at + run, 1 - value, 0, 0];
    }
    return drawing;
  }
}

export function unpackRows(bytes: Uint8Array, size: number): Uint8Array {
  const width = Math.ceil(size / 8);
  return Uint8Array.from({ length: size * size }, (_, i) => {
    const [x, y] = [i % size, Math.floor(i / size)];
    return (bytes[y * width + (x >> 3)]! >> (7 - (x & 7))) & 1;
  });
}

function packRows(pixels: Uint8Array, size: number): Uint8Array {
  const width = Math.ceil(size / 8);
  const bytes = new Uint8Array(width * size);
  pixels.forEach((pixel, i) => {
    const [x, y] = [i % size, Math.floor(i / size)];
    bytes[y * width + (x >> 3)]! |= pixel << (7 - (x & 7));
  });
  return bytes;
}
