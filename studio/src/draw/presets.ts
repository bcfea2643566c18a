// Drawings to begin with, in cells: rectangles and triangles as left, bottom, width, height.

import { Bitmap, CELL } from "./bitmap";

type Box = [left: number, bottom: number, width: number, height: number];

interface Preset {
  cells: number;
  boxes?: Box[];
  triangles?: Box[];
}

export const PRESETS: Record<string, Preset> = {
  House: { cells: 4, boxes: [[0.5, 0, 1, 2], [2.5, 0, 1, 2], [0.5, 2, 3, 1]], triangles: [[1.5, 3, 1, 1]] },
  Arch: { cells: 4, boxes: [[0.5, 0, 1, 3], [2.5, 0, 1, 3], [0.5, 3, 3, 1]] },
  Tower: { cells: 4, boxes: [[1.5, 0, 1, 3]], triangles: [[1.5, 3, 1, 1]] },
  Stairs: { cells: 4, boxes: [[0, 0, 4, 1], [1, 1, 3, 1], [2, 2, 2, 1], [3, 3, 1, 1]] },
  Gate: { cells: 4, boxes: [[0, 0, 1, 3], [3, 0, 1, 3], [0, 2, 4, 1]], triangles: [[0, 3, 1, 1], [3, 3, 1, 1]] },
  "Letter T": { cells: 4, boxes: [[1.5, 0, 1, 3], [0.5, 3, 3, 1]] },
  Pyramid: { cells: 6, boxes: [[0, 0, 6, 1], [1, 1, 4, 1], [2, 2, 2, 1]], triangles: [[2.5, 3, 1, 1]] },
  Castle: {
    cells: 6,
    boxes: [[0, 0, 1, 4], [5, 0, 1, 4], [1, 0, 4, 2], [2, 2, 2, 1]],
    triangles: [[0, 4, 1, 1], [5, 4, 1, 1]],
  },
};

export function preset(name: string): Bitmap {
  const { cells, boxes = [], triangles = [] } = PRESETS[name]!;
  const drawing = new Bitmap(cells);
  const corners = ([left, bottom, width, height]: Box) =>
    [
      { x: left * CELL, y: (cells - bottom - height) * CELL },
      { x: (left + width) * CELL, y: (cells - bottom) * CELL },
    ] as const;
  for (const box of boxes) drawing.rectangle(1, ...corners(box));
  for (const box of triangles) drawing.triangle(1, ...corners(box));
  return drawing;
}
