/** Where a person would stand in the map, and which way they would look: on a floor that is known, as far as can be seen.
 *
 *     columns of nodes  -->  tops with a person's room above them  -->  the height at which most are: the floor
 *     nodes around the eye  -->  how far one sees each way  -->  the way that is free farthest, and not into a hole
 */

import { Vector3 } from "three";
import { STRIDE } from "../decode/pack.ts";
import type { CameraView } from "../look.ts";
import type { Triple } from "../messages.ts";
import type { Cells } from "./cells.ts";

/** Of a person's eyes over the floor, and of what is over their head; m. */
const EYES_M = 1.6;
const ROOM_M = 1.8;
/** A floor is told from a table by what else lies as high; and floors of other storeys are farther below than that; m. */
const FLAT_M = 0.2;
const STOREY_M = 3.5;
/** Columns are as wide as a person, or as the coarsest node; m. */
const COLUMN_M = 0.4;
/** Looks are counted in steps of 5 degrees: all round, and so many to each side and up and down of what the eye takes in. */
const STEP_RAD = Math.PI / 36;
const HEADINGS = 72;
const ASIDE = 6;
const UP = 5;
const AHEAD_M = 3;

interface Node {
  readonly centre: Vector3;
  readonly edgeM: number;
}

interface Floor {
  readonly x: number;
  readonly y: number;
  readonly z: number;
}

/** As near to a place as a floor is known that is not above it; null: none is. Two callings give the same. */
export function standing(cells: Cells, near: Vector3): CameraView | null {
  const nodes = nodesOf(cells);
  const floors = floorsBelow(nodes, near.z);
  const counts = new Map<number, number>();
  const levelOf = (z: number) => Math.round(z / FLAT_M);
  for (const { z } of floors) counts.set(levelOf(z), (counts.get(levelOf(z)) ?? 0) + 1);
  const [level] = [...counts].reduce((most, one) => (one[1] > most[1] || (one[1] === most[1] && one[0] < most[0]) ? one : most), [0, 0]);
  const off = ({ x, y }: Floor) => Math.hypot(x - near.x, y - near.y);
  const at = floors.filter(({ z }) => Math.abs(z - level * FLAT_M) <= FLAT_M).sort((a, b) => off(a) - off(b) || a.x - b.x || a.y - b.y)[0];
  if (!at) return null;
  const eye = new Vector3(at.x, at.y, at.z + EYES_M);
  const heading = clearest(nodes, eye) * STEP_RAD;
  const target = eye.clone().add(new Vector3(Math.cos(heading), Math.sin(heading), 0).multiplyScalar(AHEAD_M));
  return { eye: eye.toArray() as Triple, target: target.toArray() as Triple };
}

function nodesOf(cells: Cells): Node[] {
  const found: Node[] = [];
  for (const cell of cells.all.values()) {
    const edgeM = cells.edgeM / 2 ** cell.depth;
    for (let at = 0; at < cell.bytes.length; at += STRIDE) {
      const centre = new Vector3(cell.bytes[at], cell.bytes[at + 1], cell.bytes[at + 2]).addScalar(0.5);
      found.push({ centre: centre.multiplyScalar(edgeM).add(cell.box.min), edgeM });
    }
  }
  return found;
}

/** Tops of nodes with room for a person above them, one a column: the highest that is not above a height. */
function floorsBelow(nodes: readonly Node[], topM: number): Floor[] {
  const widthM = nodes.reduce((most, { edgeM }) => Math.max(most, edgeM), COLUMN_M);
  const columns = new Map<string, Node[]>();
  for (const node of nodes) {
    const key = `${Math.floor(node.centre.x / widthM)},${Math.floor(node.centre.y / widthM)}`;
    if (!columns.has(key)) columns.set(key, []);
    columns.get(key)!.push(node);
  }
  const found: Floor[] = [];
  for (const column of columns.values()) {
    const rising = column.sort((a, b) => a.centre.z - b.centre.z || a.centre.x - b.centre.x || a.centre.y - b.centre.y);
    for (let n = rising.length - 1; n >= 0; n--) {
      const { centre, edgeM } = rising[n];
      const z = centre.z + edgeM / 2;
      const above = rising[n + 1];
      if (z > topM || z < topM - STOREY_M || (above && above.centre.z - above.edgeM / 2 < z + ROOM_M)) continue;
      found.push({ x: centre.x, y: centre.y, z });
      break;
    }
  }
  return found;
}

/** The heading, counted from +x to +y, in which one sees farthest on the average; where nothing is met is no sight. */
function clearest(nodes: readonly Node[], eye: Vector3): number {
  const rows = 2 * UP + 1;
  const metM = new Array<number>(HEADINGS * rows).fill(Infinity);
  const off = new Vector3();
  for (const { centre, edgeM } of nodes) {
    off.subVectors(centre, eye);
    const distanceM = Math.max(off.length(), edgeM);
    const half = edgeM / 2 / distanceM / STEP_RAD;
    const up = Math.asin(off.z / distanceM) / STEP_RAD;
    const aside = Math.atan2(off.y, off.x) / STEP_RAD;
    for (let row = Math.max(Math.round(up - half), -UP); row <= Math.min(Math.round(up + half), UP); row++) {
      for (let n = Math.round(aside - half); n <= Math.round(aside + half); n++) {
        const at = ((n + HEADINGS) % HEADINGS) * rows + row + UP;
        metM[at] = Math.min(metM[at], distanceM);
      }
    }
  }
  const sums = Array.from({ length: HEADINGS }, (_, n) =>
    metM.slice(n * rows, (n + 1) * rows).reduce((sum, metres) => sum + (Number.isFinite(metres) ? metres : 0), 0),
  );
  const around = sums.map((_, n) =>
    Array.from({ length: 2 * ASIDE + 1 }, (_, k) => sums[(n + k - ASIDE + HEADINGS) % HEADINGS]).reduce((sum, one) => sum + one),
  );
  return around.indexOf(Math.max(...around));
}
