/** From where a place is seen: the direction around it in which nothing that is shown stands near it.
 *
 *     nodes around the place  -->  how far one sees each way from it  -->  the way that is free, from a little above */

import { Box3, Vector3 } from "three";
import { STRIDE } from "../decode/pack.ts";
import type { CameraView } from "../look.ts";
import type { Triple } from "../messages.ts";
import type { Cells } from "./cells.ts";
import { uniforms } from "./materials.ts";

/** Of the eye from the place: at most, and at least where all is cramped; and how far it stays before what is behind it; m. */
const AWAY_M = 2.4;
const NEAREST_M = 0.35;
const BEFORE_M = 0.15;
/** Directions are told apart by 5 degrees: all round, and from nearly below to nearly above. */
const STEP_RAD = Math.PI / 36;
const HEADINGS = 72;
const RISES = 16;
const ROWS = 2 * RISES + 1;
/** A rise that shows what a thing is, and where it stands. */
const GOOD_RISE_RAD = Math.PI / 7;
/** What a direction may cost, m of free sight: by how far its rise is off, and by how far the eye goes round. */
const RISE_COST_M = 0.9;
const ROUND_COST_M = 0.15;
/** The same where a robot saw the place from: walls are as thin as a voxel, and it stood on the right side. */
const WITNESS_COST_M = 1.2;

/** Whether a place is within what is shown: not over a ceiling that is cut off, nor outside of a box. */
export function isShown(place: Vector3): boolean {
  return new Box3(uniforms.uLow.value, uniforms.uHigh.value).containsPoint(place);
}

/** A view of a place with nothing that is shown between; `eye` is where one looks from now, `witness` where a robot saw it from. */
export function visibleFrom(cells: Cells, place: Vector3, eye: Vector3, witness: Vector3 | null = null): CameraView {
  const metM = freeAround(cells, place);
  const roundCostM = witness ? WITNESS_COST_M : ROUND_COST_M;
  let best = { score: -Infinity, heading: 0, rise: 0, awayM: NEAREST_M };
  const towards = (witness ?? eye).clone().sub(place).normalize();
  const direction = new Vector3();
  for (let row = 0; row < ROWS; row++) {
    for (let heading = 0; heading < HEADINGS; heading++) {
      const freeM = Math.min(...around(row, heading).map((at) => metM[at]));
      const awayM = Math.min(AWAY_M, Math.max(freeM - BEFORE_M, NEAREST_M));
      const rise = (row - RISES) * STEP_RAD;
      pointed(direction, heading, rise);
      const cost = RISE_COST_M * Math.abs(rise - GOOD_RISE_RAD) + roundCostM * (1 - direction.dot(towards));
      // What is nearer than the eye can go is no view, however well it lies.
      const score = Math.min(freeM, AWAY_M + BEFORE_M) - cost;
      if (score > best.score) best = { score, heading, rise, awayM };
    }
  }
  const from = place.clone().addScaledVector(pointed(direction, best.heading, best.rise), best.awayM);
  return { eye: from.toArray() as Triple, target: place.toArray() as Triple };
}

/** How far one sees from a place in each direction; what it lies in, and touches, does not count. */
function freeAround(cells: Cells, place: Vector3): Float32Array {
  const { uLow, uHigh, uMinP } = uniforms;
  const metM = new Float32Array(HEADINGS * ROWS).fill(Infinity);
  const near = new Box3().setFromCenterAndSize(place, new Vector3(1, 1, 1).multiplyScalar(2 * (AWAY_M + BEFORE_M)));
  const [low, high] = [uLow.value, uHigh.value];
  for (const { bytes, depth, box } of cells.all.values()) {
    if (!bytes.length || !box.intersectsBox(near)) continue;
    const [edgeM, tallM] = [cells.edgeM / 2 ** depth, cells.heightM / 2 ** depth];
    for (let at = 0; at < bytes.length; at += STRIDE) {
      const x = box.min.x + (bytes[at] + 0.5) * edgeM;
      const y = box.min.y + (bytes[at + 1] + 0.5) * edgeM;
      const z = box.min.z + (bytes[at + 2] + 0.5) * tallM;
      if (x < low.x || y < low.y || z < low.z || x > high.x || y > high.y || z > high.z) continue;
      if (bytes[at + 3] / 255 < uMinP.value) continue;
      cover(metM, x - place.x, y - place.y, z - place.z, edgeM);
    }
  }
  return metM;
}

/** A node, by the middle of it from the place, ends the sight in all directions that it takes. */
function cover(metM: Float32Array, x: number, y: number, z: number, edgeM: number): void {
  // In the place's own node, or next to it.
  if (Math.max(Math.abs(x), Math.abs(y), Math.abs(z)) < 1.01 * edgeM) return;
  const farM = Math.sqrt(x * x + y * y + z * z);
  if (farM - edgeM > AWAY_M + BEFORE_M) return;
  const half = Math.atan((0.75 * edgeM) / farM) / STEP_RAD;
  const rise = Math.asin(z / farM) / STEP_RAD;
  const heading = Math.atan2(y, x) / STEP_RAD;
  const nearM = Math.max(farM - edgeM / 2, 0);
  const last = Math.min(Math.ceil(rise + half), RISES);
  for (let row = Math.max(Math.floor(rise - half), -RISES); row <= last; row++) {
    const wide = Math.min(half / Math.max(Math.cos(row * STEP_RAD), 0.05), HEADINGS / 2);
    for (let n = Math.floor(heading - wide); n <= Math.ceil(heading + wide); n++) {
      const at = (row + RISES) * HEADINGS + ((n % HEADINGS) + HEADINGS) % HEADINGS;
      if (nearM < metM[at]) metM[at] = nearM;
    }
  }
}

/** A direction and those next to it: the eye does not look through a keyhole. */
function around(row: number, heading: number): number[] {
  const rows = [Math.max(row - 1, 0), row, Math.min(row + 1, ROWS - 1)];
  return rows.flatMap((each) => [-1, 0, 1].map((n) => each * HEADINGS + ((heading + n + HEADINGS) % HEADINGS)));
}

function pointed(into: Vector3, heading: number, rise: number): Vector3 {
  const flat = Math.cos(rise);
  return into.set(Math.cos(heading * STEP_RAD) * flat, Math.sin(heading * STEP_RAD) * flat, Math.sin(rise));
}
