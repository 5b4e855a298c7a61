/** Walking: one looks around where one stands, and goes no farther than what is shown leaves free. */

import { Box3, Spherical, Vector3 } from "three";
import type { Triple } from "../messages.ts";
import type { Cells } from "./cells.ts";
import { freeM, isFree } from "./line_of_sight.ts";
import type { Stage } from "./stage.ts";
import { EYES_M } from "./standpoint.ts";

const STEP_M = 0.2;
/** Half of a body's width, so that no step leads through a wall; and what lies lower over the floor is stepped on. */
const HALF_M = 0.2;
const STEPPED_ON_M = 0.5;
/** Floors so much lower or higher are gone to, m. */
const RISE_M = 0.5;
const AHEAD_M = 3;
const TURN_RAD = Math.PI / 30;
const RAD_PER_PX = 0.004;
/** Up and down one looks almost straight. */
const STEEP_RAD = 0.1;

export class Walker {
  isOn = false;
  private readonly stage: Stage;
  private readonly cells: Cells;

  constructor(stage: Stage, cells: Cells) {
    this.stage = stage;
    this.cells = cells;
    let last: [number, number] | null = null;
    stage.canvas.addEventListener("pointerdown", ({ clientX, clientY }) => (last = [clientX, clientY]));
    stage.canvas.addEventListener("pointermove", ({ clientX, clientY, buttons }) => {
      if (!this.isOn || !buttons || !last) return;
      this.look((clientX - last[0]) * RAD_PER_PX, (clientY - last[1]) * RAD_PER_PX);
      last = [clientX, clientY];
    });
  }

  begin(): void {
    this.isOn = true;
    this.stage.controls.enabled = false;
  }

  end(): void {
    this.isOn = false;
    this.stage.controls.enabled = true;
  }

  /** Turn the head, in steps of 6 degrees. */
  turn(right: number, down: number): void {
    this.look(-right * TURN_RAD, -down * TURN_RAD);
  }

  /** Go a step, or as much of it as is free; along a wall if it is in the way. */
  step(right: number, ahead: number): void {
    const { eye, target } = this.stage.view;
    const from = new Vector3(...eye);
    const sight = new Vector3(...target).sub(from);
    const level = sight.clone().setZ(0).normalize();
    const way = level.clone().multiplyScalar(ahead).add(new Vector3(level.y, -level.x, 0).multiplyScalar(right));
    const to = from.clone();
    for (const part of [way, new Vector3(way.x, 0, 0), new Vector3(0, way.y, 0)]) {
      to.copy(from).addScaledVector(part, STEP_M);
      to.z += this.riseM(to);
      // Who stands in something may leave it.
      if (part.lengthSq() > 1e-3 && (this.isFree(to) || !this.isFree(from))) break;
      to.copy(from);
    }
    if (to.equals(from)) return;
    this.stage.place({ eye: to.toArray() as Triple, target: to.clone().add(sight).toArray() as Triple });
  }

  /** Whether a body has room whose eyes are here. */
  private isFree(eye: Vector3): boolean {
    const half = new Vector3(HALF_M, HALF_M, 0);
    return isFree(this.cells, new Box3(eye.clone().sub(half).setZ(eye.z - EYES_M + STEPPED_ON_M), eye.clone().add(half)));
  }

  /** How much the floor here lies higher than that under a person whose eyes are here; 0: none is near. */
  private riseM(eye: Vector3): number {
    const belowM = freeM(this.cells, eye, eye.clone().setZ(eye.z - EYES_M - RISE_M));
    return belowM >= EYES_M + RISE_M || belowM < EYES_M - RISE_M ? 0 : EYES_M - belowM;
  }

  private look(left: number, up: number): void {
    const { eye, target } = this.stage.view;
    const sight = new Vector3(...target).sub(new Vector3(...eye));
    const sphere = new Spherical().setFromCartesianCoords(sight.x, sight.z, -sight.y);
    sphere.theta += left;
    sphere.phi = Math.min(Math.max(sphere.phi - up, STEEP_RAD), Math.PI - STEEP_RAD);
    sphere.radius = AHEAD_M;
    const turned = new Vector3().setFromSpherical(sphere);
    this.stage.place({ eye, target: new Vector3(...eye).add(new Vector3(turned.x, -turned.z, turned.y)).toArray() as Triple });
  }
}
