// The arm: links that hang on each other, and meshes on them, posed by joint angles.

import * as three from "three";
import { post } from "../api";
import { bytesOf } from "../dom";

interface Link {
  name: string;
  parent: string | null;
  frame: number[]; // 4 x 4, row by row [cell]
  joint: "fixed" | "revolute" | "prismatic";
  axis?: number[];
  shapes: { frame: number[]; triangles?: string; box?: number[] }[];
}

export class Arm {
  readonly object = new three.Group();
  private readonly revolute: { group: three.Group; axis: three.Vector3 }[] = [];
  private readonly sliding: { group: three.Group; axis: three.Vector3 }[] = [];

  /** Fetches what the arm looks like; cells have this edge [m]. */
  static async load(cell: number, signal: AbortSignal): Promise<Arm> {
    const { links } = await post<{ links: Link[] }>("/api/arm", { cell_size: cell }, signal);
    return new Arm(links);
  }

  constructor(links: Link[]) {
    const groups = new Map<string | null, three.Object3D>([[null, this.object]]);
    for (const link of links) {
      const fixed = new three.Group();
      matrix(link.frame).decompose(fixed.position, fixed.quaternion, fixed.scale);
      const moving = new three.Group();
      fixed.add(moving);
      groups.get(link.parent)!.add(fixed);
      groups.set(link.name, moving);
      const axis = new three.Vector3(...((link.axis ?? [1, 0, 0]) as [number, number, number]));
      if (link.joint === "revolute") this.revolute.push({ group: moving, axis });
      if (link.joint === "prismatic") this.sliding.push({ group: moving, axis });
      const dark = link.name === "palm" || link.joint === "prismatic";
      for (const shape of link.shapes) moving.add(meshOf(shape, dark ? 0x3c4250 : 0xb9c3d3));
    }
  }

  /** Poses it: the angle of each joint [rad], then the opening of the jaws [cell]. */
  pose(joints: number[]): void {
    this.revolute.forEach(({ group, axis }, i) => group.quaternion.setFromAxisAngle(axis, joints[i]!));
    const opening = joints[this.revolute.length]!;
    for (const { group, axis } of this.sliding) group.position.copy(axis).multiplyScalar(opening / 2);
  }
}

function meshOf(shape: Link["shapes"][number], colour: number): three.Object3D {
  let geometry: three.BufferGeometry;
  if (shape.box) geometry = new three.BoxGeometry(...(shape.box as [number, number, number]));
  else {
    geometry = new three.BufferGeometry();
    geometry.setAttribute("position", new three.BufferAttribute(new Float32Array(bytesOf(shape.triangles!).buffer), 3));
    geometry.computeVertexNormals();
  }
  const mesh = new three.Mesh(geometry, new three.MeshStandardMaterial({ color: colour, roughness: 0.5, metalness: 0.15, side: three.DoubleSide }));
  mesh.castShadow = mesh.receiveShadow = true;
  matrix(shape.frame).decompose(mesh.position, mesh.quaternion, mesh.scale);
  return mesh;
}

function matrix(rows: number[]): three.Matrix4 {
  return new three.Matrix4().fromArray(rows).transpose();
}
