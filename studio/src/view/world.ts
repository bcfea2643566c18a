// The 3-D view: blocks on a table, an orbiting camera, marks that explain. z is up, lengths are cells.

import * as three from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import type { Pose, Shape } from "../types";

const FALLEN = new three.Color(0xd62728);
const LINES = new three.LineBasicMaterial({ color: 0x2c303a });

interface Block {
  group: three.Group; // of both others
  body: three.Mesh<three.BufferGeometry, three.MeshStandardMaterial>;
  lines: three.LineSegments;
  colour: three.Color;
}

export class World {
  readonly canvas: HTMLCanvasElement;
  readonly table = new three.Group(); // all that tilts with the table
  readonly extras = new three.Group(); // marks, and the arm
  onPick: (block: number) => void = () => {};
  onFrame: (seconds: number) => boolean = () => false; // answers whether it goes on
  private readonly renderer: three.WebGLRenderer;
  private readonly scene = new three.Scene();
  private readonly camera = new three.PerspectiveCamera(35, 1, 0.1, 300);
  private readonly controls: OrbitControls;
  private meshes: ReturnType<typeof meshOf>[] = []; // of each shape
  private blocks: Block[] = [];
  private poses: Pose[] = [];
  private explosion = 0;
  private asked = false;
  private last = 0; // moment of the last frame of what goes on; 0 at its beginning [ms]
  private size: [number, number] = [4, 4]; // of what is looked at [cell]

  constructor(shapes: Shape[]) {
    try {
      this.renderer = new three.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
    } catch {
      throw new Error("This browser shows no 3-D graphics (WebGL).");
    }
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = three.PCFShadowMap;
    this.canvas = this.renderer.domElement;
    this.canvas.setAttribute("role", "img");
    this.canvas.tabIndex = 0;
    this.setShapes(shapes);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.addEventListener("change", () => this.paint());
    this.controls.listenToKeyEvents(this.canvas);
    this.controls.maxPolarAngle = Math.PI * 0.55;
    this.controls.minDistance = 2;
    this.controls.maxDistance = 80;
    this.scene.add(this.table);
    this.table.add(this.extras);
    this.light();
    this.ground();
    this.home(4, 4);
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    this.canvas.addEventListener("click", (event) => this.pick(event));
    this.colour();
  }

  /** Takes the shapes that blocks are of from now on. */
  setShapes(shapes: Shape[]): void {
    this.meshes = shapes.map(meshOf);
  }

  /** Shows blocks of these shapes, all at the origin until they are posed. */
  setBlocks(shapes: number[]): void {
    for (const { group } of this.blocks) this.table.remove(group);
    this.blocks = shapes.map((shape) => {
      const { faces, edges, colour } = this.meshes[shape]!;
      const body = new three.Mesh(faces, new three.MeshStandardMaterial({ color: colour, roughness: 0.75 }));
      body.castShadow = body.receiveShadow = true;
      const lines = new three.LineSegments(edges, LINES);
      const group = new three.Group().add(body, lines);
      this.table.add(group);
      return { group, body, lines, colour };
    });
  }

  /** Moves the blocks. */
  pose(poses: Pose[]): void {
    this.poses = poses;
    const mean = (axis: 0 | 1) => poses.reduce((sum, pose) => sum + pose[axis], 0) / Math.max(1, poses.length);
    const [x, y, further] = [mean(0), mean(1), this.explosion];
    this.blocks.forEach(({ group }, i) => {
      const pose = poses[i];
      if (!pose) return;
      group.position.set(pose[0] + (pose[0] - x) * further, pose[1] + (pose[1] - y) * further, pose[2] * (1 + further));
      group.quaternion.set(pose[3], pose[4], pose[5], pose[6]);
    });
    this.paint();
  }

  explode(factor: number): void {
    this.explosion = factor;
    this.pose(this.poses);
  }

  /** Paints some blocks red, and makes others see-through. */
  mark(red: number[], faint: (block: number) => boolean = () => false): void {
    this.blocks.forEach(({ body, lines, colour }, i) => {
      body.material.color.copy(red.includes(i) ? FALLEN : colour);
      body.material.transparent = faint(i);
      body.material.opacity = faint(i) ? 0.12 : 1;
      body.castShadow = lines.visible = !faint(i);
    });
    this.paint();
  }

  /** Tilts the table; the angle in degrees, the direction in which it dips from above. */
  tilt(degrees: number, direction: number): void {
    const towards = three.MathUtils.degToRad(direction);
    this.table.setRotationFromAxisAngle(new three.Vector3(-Math.sin(towards), Math.cos(towards), 0), three.MathUtils.degToRad(degrees));
    this.paint();
  }

  /** Looks from the front at something of this size; by default at what was looked at last. */
  home(width: number = this.size[0], height: number = this.size[1]): void {
    this.size = [width, height];
    const size = Math.max(width, height, 2);
    this.controls.target.set(0, 0, height * 0.45);
    const aspect = Math.min(1, this.camera.aspect);
    this.camera.position.set(0.75, -2.0, 0.75).multiplyScalar((size * 1.05) / Math.sqrt(aspect)).add(this.controls.target);
    this.controls.update();
    this.paint();
  }

  /** Steps back, where something wider is to be seen. */
  widen(width: number): void {
    if (width > this.size[0]) this.home(width);
  }

  /** Draws again soon. */
  paint(): void {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame((now) => {
      this.asked = false;
      const seconds = this.last ? Math.min(0.5, (now - this.last) / 1000) : 1 / 60;
      const goesOn = this.onFrame(seconds);
      this.last = goesOn ? now : 0;
      if (goesOn) this.paint();
      this.renderer.render(this.scene, this.camera);
    });
  }

  /** The view as a PNG. */
  picture(): Promise<Blob> {
    this.renderer.render(this.scene, this.camera);
    return new Promise((resolve, reject) => this.canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("no picture"))), "image/png"));
  }

  /** Takes the colours of the page. */
  colour(): void {
    const style = getComputedStyle(document.documentElement);
    this.scene.background = new three.Color(style.getPropertyValue("--sky").trim() || "#fafafc");
    const ground = this.table.getObjectByName("ground") as three.Mesh<three.BufferGeometry, three.MeshStandardMaterial>;
    ground.material.color.set(style.getPropertyValue("--table").trim() || "#e6e2da");
    this.paint();
  }

  private light(): void {
    const sun = new three.DirectionalLight(0xffffff, 2.2);
    sun.position.set(-8, -12, 20);
    sun.castShadow = true;
    sun.shadow.mapSize.set(1024, 1024);
    Object.assign(sun.shadow.camera, { left: -14, right: 14, top: 14, bottom: -14, far: 60 });
    sun.shadow.bias = -0.002;
    this.scene.add(sun, new three.HemisphereLight(0xffffff, 0xb8b4aa, 1.6));
  }

  private ground(): void {
    const ground = new three.Mesh(new three.CylinderGeometry(9, 9, 0.3, 96), new three.MeshStandardMaterial({ roughness: 1 }));
    ground.rotation.x = Math.PI / 2;
    ground.position.z = -0.15;
    ground.name = "ground";
    ground.receiveShadow = true;
    this.table.add(ground);
  }

  private pick(event: MouseEvent): void {
    const box = this.canvas.getBoundingClientRect();
    const at = new three.Vector2(((event.clientX - box.left) / box.width) * 2 - 1, 1 - ((event.clientY - box.top) / box.height) * 2);
    const ray = new three.Raycaster();
    ray.setFromCamera(at, this.camera);
    const bodies: three.Object3D[] = this.blocks.map((block) => block.body);
    const hit = ray.intersectObjects(bodies, false)[0];
    if (hit) this.onPick(bodies.indexOf(hit.object));
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.paint();
  }
}

function meshOf(shape: Shape): { faces: three.BufferGeometry; edges: three.BufferGeometry; colour: three.Color } {
  const faces = new three.BufferGeometry();
  faces.setAttribute("position", new three.Float32BufferAttribute(shape.points.flat(), 3));
  faces.setAttribute("normal", new three.Float32BufferAttribute(shape.normals.flat(), 3));
  faces.setIndex(shape.triangles.flat());
  const edges = new three.BufferGeometry();
  edges.setAttribute("position", new three.Float32BufferAttribute(shape.edges.flatMap(([a, b]) => [...shape.points[a!]!, ...shape.points[b!]!]), 3));
  const [red, green, blue] = shape.colour;
  return { faces, edges, colour: new three.Color().setRGB(red, green, blue, three.SRGBColorSpace) };
}
