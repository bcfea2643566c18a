// Marks that explain a verdict: where the weights are, what they would have to rest on, what pushes.

import * as three from "three";
import type { Statics } from "../types";

const WEIGHT = 0x1d4ed8;
const LACKING = 0xd62728;
const HOLDS = 0x1e824c;

/** Plumb lines from the centres of mass; patches of contact under the blocks that nothing holds. */
export function explain(statics: Statics): three.Object3D {
  const group = new three.Group();
  statics.centers.forEach((center, block) => {
    const lacking = block in statics.reasons;
    const [x, y, z] = center as [number, number, number];
    const below = statics.contacts
      .filter((contact) => contact.blocks.includes(block))
      .flatMap((contact) => contact.points.map((point) => point[2]!))
      .filter((height) => height < z);
    const foot = below.length ? Math.max(...below) : 0;
    group.add(ball(center, 0.075, lacking ? LACKING : WEIGHT));
    if (!lacking) return;
    group.add(line([[x, y, z], [x, y, foot]], LACKING), ball([x, y, foot], 0.06, LACKING));
    for (const contact of statics.contacts) if (contact.blocks[0] === block) group.add(patch(contact.points));
  });
  const [x, y, z] = statics.center as [number, number, number];
  group.add(ball(statics.center, 0.12, HOLDS), line([[x, y, z], [x, y, 0]], HOLDS));
  return group;
}

/** An arrow at a block: a force of so many times its weight. */
export function arrow(center: number[], direction: number, force: number): three.Object3D {
  const towards = three.MathUtils.degToRad(direction);
  const along = new three.Vector3(Math.cos(towards), Math.sin(towards), 0);
  const length = 0.6 + force;
  const start = new three.Vector3(...(center as [number, number, number])).addScaledVector(along, -length - 0.6);
  const made = new three.ArrowHelper(along, start, length, LACKING, 0.35, 0.25);
  for (const part of [made.line, made.cone]) onTop(part.material as three.Material);
  return made;
}

function ball(at: number[], radius: number, colour: number): three.Object3D {
  const made = new three.Mesh(new three.SphereGeometry(radius, 20, 14), onTop(new three.MeshBasicMaterial({ color: colour })));
  made.position.set(at[0]!, at[1]!, at[2]!);
  return made;
}

function line(points: number[][], colour: number): three.Object3D {
  const geometry = new three.BufferGeometry().setFromPoints(points.map((p) => new three.Vector3(p[0], p[1], p[2])));
  return new three.Line(geometry, onTop(new three.LineBasicMaterial({ color: colour })));
}

function patch(points: number[][]): three.Object3D {
  const geometry = new three.BufferGeometry();
  geometry.setAttribute("position", new three.Float32BufferAttribute(points.flat(), 3));
  geometry.setIndex(points.slice(2).flatMap((_, i) => [0, i + 1, i + 2]));
  return new three.Mesh(geometry, onTop(new three.MeshBasicMaterial({ color: 0xf59e0b, opacity: 0.7, side: three.DoubleSide })));
}

function onTop<M extends three.Material>(material: M): M {
  return Object.assign(material, { depthTest: false, transparent: true });
}
