// What the server sends; stackgen/studio says what it means.

export type Pose = [number, number, number, number, number, number, number]; // position [cell], quaternion x y z w

export interface Shape {
  name: string;
  colour: [number, number, number];
  points: number[][];
  normals: number[][];
  triangles: number[][];
  edges: number[][];
}

export interface Method {
  name: string;
  title: string;
  steps: number | null;
}

export interface Start {
  methods: Method[];
  shapes: Shape[];
  most_blocks: number;
}

export interface Clip {
  frames: Pose[][];
  rate: number; // frames in a second
  joints?: number[][]; // of the arm, in each frame
}

export interface Rollout extends Clip {
  shapes: number[];
  stable: boolean;
  at_rest: boolean;
  fell: number[];
  first: number | null;
  seconds: number;
}

export interface Disturbed extends Rollout {
  reached: number; // tilt or push that was held in the end
  growth: number; // of it in a second
  fell_at: number | null;
}

export interface Statics {
  stable: boolean;
  margin: number;
  push: number | null;
  missing: number;
  unheld: number[];
  reasons: Record<string, string>;
  centers: number[][];
  center: number[];
  contacts: { blocks: [number, number]; points: number[][] }[];
}

export type ViewName = "front" | "side" | "top";
export type Views = Record<ViewName, { target: string; stack: string; iou: number }>;

export interface StackFacts extends Rollout {
  poses: Pose[];
  front_iou: number | null;
  matches: boolean | null;
  comment: string;
  statics: Statics;
  views: Views | null;
}

export interface StacksFile {
  grid: { width: number; height: number; image_size: number; pixels_per_cell: number };
  block_list?: Record<string, number>;
  comment?: string;
  cell_size_m?: number;
  stacks: unknown[];
}

export type Message =
  | { kind: "blocks"; shapes: number[]; draws: number }
  | { kind: "noise"; step: number; steps: number; stacks: Pose[][] }
  | { kind: "checked"; stable: boolean }
  | { kind: "file"; file: StacksFile; command: string; picture: string; notes: string[] }
  | ({ kind: "stack"; number: number } & StackFacts)
  | { kind: "error"; detail: string };

export interface Wish {
  method: string;
  number: number;
  seed: number;
  blocks: Record<string, number> | null;
  inventory: Record<string, number> | null;
  sampler: { kind: string | null; steps: number | null };
  verified: boolean;
}

export interface Reading {
  bits: string;
  cells: number;
  kind: string;
  sure: number;
  told: string;
  notes: string[];
  overlay: string;
}
