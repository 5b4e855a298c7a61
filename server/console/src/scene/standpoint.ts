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
import type { ShownCell } from "./shown_cell.ts";

/** Of a person's eyes over the floor, and of what is over their head; m. */
export const EYES_M = 1.6;
const ROOM_M = 1.8;
/** A floor is told from a table by what else lies as high; and floors of other storeys are farther below than that; m. */
const FLAT_M = 0.2;
const STOREY_M = 3.5;
/** Columns are as wide as a person, or as the coarsest node; m. */
const COLUMN_M = 0.4;
/** More than a map has side by side. */
const COLUMNS = 2 ** 24;
/** Looks are counted in steps of 5 degrees: all round, and so many to each side and up and down of what the eye takes in. */
const STEP_RAD = Math.PI / 36;
const HEADINGS = 72;
const ASIDE = 6;
const UP = 5;
const AHEAD_M = 3;

/** Floors are looked for so near first, of as many nodes as there may be; m. */
const NEAR_M = 8;

interface Node {
  readonly x: number;
  readonly y: number;
  readonly z: number;
  readonly edgeM: number;
  readonly tallM: number;
}

/** As near to a place as a floor is known that is not above it; null: none is. Two callings give the same. */
export function standing(cells: Cells, near: Vector3): CameraView | null {
  const all = [...cells.all.values()];
  const close = all.filter(({ box }) => box.distanceToPoint(near.clone().setZ(box.min.z)) <= NEAR_M);
  const found = floorsBelow(close, cells, near.z);
  const floors = found.length ? found : floorsBelow(all, cells, near.z);
  const counts = new Map<number, number>();
  const levelOf = (z: number) => Math.round(z / FLAT_M);
  for (const { z } of floors) counts.set(levelOf(z), (counts.get(levelOf(z)) ?? 0) + 1);
  const [level] = [...counts].reduce((most, one) => (one[1] > most[1] || (one[1] === most[1] && one[0] < most[0]) ? one : most), [0, 0]);
  const off = ({ x, y }: Node) => Math.hypot(x - near.x, y - near.y);
  const at = floors.filter(({ z }) => Math.abs(z - level * FLAT_M) <= FLAT_M).sort((a, b) => off(a) - off(b) || a.x - b.x || a.y - b.y)[0];
  if (!at) return null;
  const eye = new Vector3(at.x, at.y, at.z + EYES_M);
  const heading = clearest(all, cells, eye) * STEP_RAD;
  const target = eye.clone().add(new Vector3(Math.cos(heading), Math.sin(heading), 0).multiplyScalar(AHEAD_M));
  return { eye: eye.toArray() as Triple, target: target.toArray() as Triple };
}

/** Edge and height of a cell, m. */
type CellSize = Pick<Cells, "edgeM" | "heightM">;

/** All nodes: their centres, m in the map, edges and heights. */
function visit(cells: readonly ShownCell[], cell: CellSize, take: (x: number, y: number, z: number, edgeM: number, tallM: number) => void): void {
  for (const { bytes, depth, box } of cells) {
    const [edgeM, tallM] = [cell.edgeM / 2 ** depth, cell.heightM / 2 ** depth];
    const { x, y, z } = box.min;
    for (let at = 0; at < bytes.length; at += STRIDE) {
      take(x + (bytes[at] + 0.5) * edgeM, y + (bytes[at + 1] + 0.5) * edgeM, z + (bytes[at + 2] + 0.5) * tallM, edgeM, tallM);
    }
  }
}

/** Tops of nodes with room for a person above them, one a column: the highest that is not above a height. */
function floorsBelow(cells: readonly ShownCell[], cell: CellSize, topM: number): Node[] {
  const widthM = cells.reduce((most, { points, depth }) => (points ? Math.max(most, cell.edgeM / 2 ** depth) : most), COLUMN_M);
  const columns = new Map<number, Node[]>();
  visit(cells, cell, (x, y, z, edgeM, tallM) => {
    if (z < topM - STOREY_M - tallM || z > topM + ROOM_M + tallM) return;
    const key = Math.floor(x / widthM) * COLUMNS + Math.floor(y / widthM);
    const column = columns.get(key);
    if (column) column.push({ x, y, z, edgeM, tallM });
    else columns.set(key, [{ x, y, z, edgeM, tallM }]);
  });
  const found: Node[] = [];
  for (const column of columns.values()) {
    const rising = column.sort((a, b) => a.z - b.z || a.x - b.x || a.y - b.y);
    for (let n = rising.length - 1; n >= 0; n--) {
      const z = rising[n].z + rising[n].tallM / 2;
      const above = rising[n + 1];
      if (z > topM || z < topM - STOREY_M || (above && above.z - above.tallM / 2 < z + ROOM_M)) continue;
      found.push({ ...rising[n], z });
      break;
    }
  }
  return found;
}

/** The heading, counted from +x to +y, in which one sees farthest on the average; where nothing is met is no sight. */
function clearest(cells: readonly ShownCell[], cell: CellSize, eye: Vector3): number {
  const rows = 2 * UP + 1;
  const metM = new Array<number>(HEADINGS * rows).fill(Infinity);
  visit(cells, cell, (x, y, z, edgeM) => {
    const distanceM = Math.max(Math.sqrt((x - eye.x) ** 2 + (y - eye.y) ** 2 + (z - eye.z) ** 2), edgeM);
    const half = edgeM / 2 / distanceM / STEP_RAD;
    const up = Math.asin((z - eye.z) / distanceM) / STEP_RAD;
    const aside = Math.atan2(y - eye.y, x - eye.x) / STEP_RAD;
    for (let row = Math.max(Math.round(up - half), -UP); row <= Math.min(Math.round(up + half), UP); row++) {
      for (let n = Math.round(aside - half); n <= Math.round(aside + half); n++) {
        const at = ((n + HEADINGS) % HEADINGS) * rows + row + UP;
        metM[at] = Math.min(metM[at], distanceM);
      }
    }
  });
  const sums = Array.from({ length: HEADINGS }, (_, n) =>
    metM.slice(n * rows, (n + 1) * rows).reduce((sum, metres) => sum + (Number.isFinite(metres) ? metres : 0), 0),
  );
  const around = sums.map((_, n) =>
    Array.from({ length: 2 * ASIDE + 1 }, (_, k) => sums[(n + k - ASIDE + HEADINGS) % HEADINGS]).reduce((sum, one) => sum + one),
  );
  return around.indexOf(Math.max(...around));
}
