/** Lines over the map: borders of cells (violet, as in the paper's Fig. 20), the voxel that was asked of, robots. */

import {
  BoxGeometry, BufferGeometry, EdgesGeometry, Float32BufferAttribute, Group, LineBasicMaterial, LineSegments, Quaternion,
  Vector3, type Box3,
} from "three";
import type { Place } from "../log_book.ts";
import type { RobotSign, Triple } from "../messages.ts";
import type { Picked } from "./picking.ts";

const VIOLET = 0x9b5de5;
/** Places of a trail, the newest of a robot. */
export const TRAIL_MAX = 500;
/** Nearer to the place before than this a place tells nothing, m. */
const STEP_M = 0.02;
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

  contrastWith(theme: "dark" | "light"): void {
    this.lines.material.color.set(theme === "light" ? 0x101418 : 0xffffff);
  }

  show(picked: Picked | null): void {
    this.lines.visible = picked !== null;
    if (!picked) return;
    this.lines.position.copy(picked.centre);
    this.lines.scale.copy(picked.size).multiplyScalar(1.08);
  }
}

/** One robot: its body's axes and view, and where it was. */
export class RobotMark {
  readonly group = new Group();
  private readonly body: LineSegments;
  private readonly trail: LineSegments;
  /** What commits tell; and what it told itself since the page was opened, in between and beyond. */
  private measured: readonly Place[] = [];
  private readonly told: Place[] = [];

  constructor(colour: string) {
    this.body = new LineSegments(bodyGeometry(), new LineBasicMaterial({ color: colour, depthTest: false }));
    this.trail = new LineSegments(
      new BufferGeometry(), new LineBasicMaterial({ color: colour, transparent: true, opacity: 0.9, depthTest: false }),
    );
    this.trail.frustumCulled = false;
    this.body.renderOrder = this.trail.renderOrder = 9;
    this.body.visible = false;
    this.group.add(this.body, this.trail);
  }

  get position(): Vector3 | null {
    return this.body.visible ? this.body.position : null;
  }

  /** What looks ahead along +x of its rig's z axis: cameras look along z. */
  get ahead(): Vector3 {
    return new Vector3(0, 0, 1).applyQuaternion(this.body.quaternion);
  }

  /** The trail, in the order of time. */
  get places(): Triple[] {
    const places = [...this.measured, ...this.told].sort((a, b) => a.timeS - b.timeS).slice(-TRAIL_MAX);
    return places.map(({ at }) => at);
  }

  /** The trail tells whose it is, whoever is online. */
  setColours(body: string, trail: string): void {
    (this.body.material as LineBasicMaterial).color.set(body);
    (this.trail.material as LineBasicMaterial).color.set(trail);
  }

  update(sign: RobotSign): void {
    const pose = sign.status?.pose;
    // Who tells no pose any more stays where it was last.
    this.body.visible = (pose != null || this.body.visible) && !sign.gone;
    if (!pose) return;
    const place = pose.t_map_rig;
    this.body.position.set(...place);
    this.body.quaternion.copy(new Quaternion(...pose.q_map_rig));
    const last = this.told[this.told.length - 1];
    if (last && new Vector3(...last.at).distanceTo(this.body.position) < STEP_M) return;
    this.told.push({ timeS: pose.time_s, at: place });
    if (this.told.length > TRAIL_MAX) this.told.shift();
    this.drawTrail();
  }

  /** From where it measured what is in the map. */
  wasAt(places: readonly Place[]): void {
    if (places.length === this.measured.length && places.every(({ timeS }, n) => timeS === this.measured[n].timeS)) return;
    this.measured = places;
    this.drawTrail();
  }

  private drawTrail(): void {
    const { places } = this;
    const points = places.slice(1).flatMap((to, n) => [...places[n], ...to]);
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
