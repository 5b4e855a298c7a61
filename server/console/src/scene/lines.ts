/** Lines over the map: borders of cells (violet, as in the paper's Fig. 20), the voxel that was asked of, robots. */

import {
  BoxGeometry, BufferGeometry, EdgesGeometry, Float32BufferAttribute, Group, LineBasicMaterial, LineSegments, Quaternion,
  Vector3, type Box3,
} from "three";
import type { RobotSign, Triple } from "../messages.ts";
import type { Picked } from "./picking.ts";

const VIOLET = 0x9b5de5;
const TRAIL_MAX = 500;
const ARM_M = 0.35;

/** Borders of cells; each edge once, however many cells share it. */
export class CellGrid {
  readonly lines: LineSegments;
  private drawn = "";

  constructor(colour: number = VIOLET, opacity = 0.55) {
    this.lines = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ color: colour, transparent: true, opacity }));
  }

  update(boxes: Box3[]): void {
    const keys = boxes.map(({ min }) => min.toArray().join()).sort();
    if (keys.join(";") === this.drawn) return;
    this.drawn = keys.join(";");
    const edges = new Map<string, number[]>();
    for (const { min, max } of boxes) {
      const corner = (n: number) => [n & 1 ? max.x : min.x, n & 2 ? max.y : min.y, n & 4 ? max.z : min.z];
      for (let n = 0; n < 8; n++) {
        for (const bit of [1, 2, 4]) {
          if (n & bit) continue;
          const edge = [...corner(n), ...corner(n | bit)];
          edges.set(edge.map((value) => Math.round(value * 1e4)).join(), edge);
        }
      }
    }
    this.lines.geometry.dispose();
    this.lines.geometry = new BufferGeometry();
    this.lines.geometry.setAttribute("position", new Float32BufferAttribute([...edges.values()].flat(), 3));
  }
}

/** The outline of what was picked, drawn over everything. */
export class Outline {
  readonly lines = new LineSegments(
    new EdgesGeometry(new BoxGeometry(1, 1, 1)), new LineBasicMaterial({ color: 0xffffff, depthTest: false }),
  );

  constructor() {
    this.lines.visible = false;
    this.lines.renderOrder = 10;
  }

  show(picked: Picked | null): void {
    this.lines.visible = picked !== null;
    if (!picked) return;
    this.lines.position.copy(picked.centre);
    this.lines.scale.setScalar(picked.edgeM * 1.08);
  }
}

/** One robot: its body's axes and view, and where it was since the page was opened. */
export class RobotMark {
  readonly group = new Group();
  private readonly body: LineSegments;
  private readonly trail: LineSegments;
  private readonly places: Vector3[] = [];

  constructor(colour: string) {
    this.body = new LineSegments(bodyGeometry(), new LineBasicMaterial({ color: colour, depthTest: false }));
    this.trail = new LineSegments(
      new BufferGeometry(), new LineBasicMaterial({ color: colour, transparent: true, opacity: 0.8, depthTest: false }),
    );
    this.trail.frustumCulled = false;
    this.body.renderOrder = this.trail.renderOrder = 9;
    this.group.add(this.body, this.trail);
    this.group.visible = false;
  }

  get position(): Vector3 | null {
    return this.group.visible ? this.body.position : null;
  }

  /** What looks ahead along +x of its rig's z axis: cameras look along z. */
  get ahead(): Vector3 {
    return new Vector3(0, 0, 1).applyQuaternion(this.body.quaternion);
  }

  update(sign: RobotSign, colour: string): void {
    const pose = sign.status?.pose;
    // Who tells no pose any more stays where it was last.
    this.group.visible = (pose != null || this.places.length > 0) && !sign.gone;
    for (const line of [this.body, this.trail]) (line.material as LineBasicMaterial).color.set(colour);
    if (!pose) return;
    const place = new Vector3(...(pose.t_map_rig as Triple));
    this.body.position.copy(place);
    this.body.quaternion.copy(new Quaternion(...pose.q_map_rig));
    const last = this.places[this.places.length - 1];
    if (last && last.distanceTo(place) < 0.02) return;
    this.places.push(place);
    if (this.places.length > TRAIL_MAX) this.places.shift();
    const points = this.places.slice(1).flatMap((to, n) => [...this.places[n].toArray(), ...to.toArray()]);
    this.trail.geometry.dispose();
    this.trail.geometry = new BufferGeometry();
    this.trail.geometry.setAttribute("position", new Float32BufferAttribute(points, 3));
  }
}

/** A diamond where the rig is, and the pyramid that its cameras see. */
function bodyGeometry(): BufferGeometry {
  const a = ARM_M;
  const lines: Triple[] = [];
  const tips: Triple[] = [[a, 0, 0], [0, a, 0], [-a, 0, 0], [0, -a, 0]].map((tip) => tip.map((v) => v * 0.6) as Triple);
  tips.forEach((tip, n) => {
    lines.push(tip, tips[(n + 1) % 4], tip, [0, 0, a * 0.6], tip, [0, 0, -a * 0.6]);
  });
  const corners: Triple[] = [[1, 0.8, 1.6], [-1, 0.8, 1.6], [-1, -0.8, 1.6], [1, -0.8, 1.6]];
  const far = corners.map((corner) => corner.map((v) => v * a * 1.6) as Triple);
  far.forEach((corner, n) => lines.push([0, 0, 0], corner, corner, far[(n + 1) % 4]));
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new Float32BufferAttribute(lines.flat(), 3));
  return geometry;
}
