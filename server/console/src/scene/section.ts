/** Sections through the map: heights along a line, and the volume of what stands over a plane, of what is shown.
 *
 *     nodes near the line  -->  the highest in each step along it  -->  a profile
 *     nodes over a polygon -->  the highest in each column of it   -->  a volume over the polygon's plane
 */

import { Vector3 } from "three";
import { STRIDE } from "../decode/pack.ts";
import type { Cells } from "./cells.ts";
import { uniforms } from "./materials.ts";

/** Columns of a volume at most, along a side. */
const COLUMNS_MAX = 400;

export interface Profile {
  /** Length of a step along the line, level, m. */
  readonly stepM: number;
  /** Highest surface in each step, m in the map; NaN: nothing is shown there. */
  readonly tops: Float64Array;
}

/** Surfaces under and over a level line from one point to another; a step is as long as a voxel, or more where coarser nodes are shown. */
export function profileOf(cells: Cells, from: Vector3, to: Vector3): Profile | null {
  const way = to.clone().sub(from).setZ(0);
  const lengthM = way.length();
  const stepM = cells.edgeM / 2 ** cells.depthMax;
  if (lengthM < stepM) return null;
  way.divideScalar(lengthM);
  const tops = new Float64Array(Math.ceil(lengthM / stepM)).fill(NaN);
  visitShown(cells, (x, y, top, edgeM) => {
    const [dx, dy] = [x - from.x, y - from.y];
    // The line crosses the node's square if it comes nearer to the middle than half of its width across the line.
    if (Math.abs(dx * way.y - dy * way.x) > (edgeM / 2) * (Math.abs(way.x) + Math.abs(way.y))) return;
    const along = dx * way.x + dy * way.y;
    const half = edgeM / 2;
    for (let n = Math.max(Math.floor((along - half) / stepM), 0); n <= Math.min(Math.floor((along + half - 1e-9) / stepM), tops.length - 1); n++) {
      if (!(tops[n] >= top)) tops[n] = top;
    }
  });
  return { stepM, tops };
}

/** Volume between the plane through a polygon's corners and the highest surfaces over it, m³, and how much of the polygon has any, 0 to 1. */
export function volumeOver(cells: Cells, corners: readonly Vector3[]): { volumeM3: number; covered: number } | null {
  const plane = planeOf(corners);
  if (!plane) return null;
  const xs = corners.map(({ x }) => x), ys = corners.map(({ y }) => y);
  const [left, low] = [Math.min(...xs), Math.min(...ys)];
  const wideM = Math.max(Math.max(...xs) - left, Math.max(...ys) - low);
  const edgeM = Math.max(cells.edgeM / 2 ** cells.depthMax, wideM / COLUMNS_MAX);
  // Columns are those of the map's own grid, so that a voxel is in one of them.
  const [i0, j0] = [Math.floor(left / edgeM), Math.floor(low / edgeM)];
  const side = Math.ceil(wideM / edgeM) + 2;
  const tops = new Float64Array(side * side).fill(NaN);
  visitShown(cells, (x, y, nodeTop, nodeM) => {
    const half = nodeM / 2;
    const first = (centre: number, begin: number) => Math.max(Math.floor((centre - half) / edgeM + 1e-6) - begin, 0);
    const last = (centre: number, begin: number) => Math.min(Math.ceil((centre + half) / edgeM - 1e-6) - begin, side) - 1;
    for (let j = first(y, j0); j <= last(y, j0); j++) {
      for (let i = first(x, i0); i <= last(x, i0); i++) if (!(tops[j * side + i] >= nodeTop)) tops[j * side + i] = nodeTop;
    }
  });
  let [volumeM3, inside, known] = [0, 0, 0];
  for (let j = 0; j < side; j++) {
    for (let i = 0; i < side; i++) {
      const [x, y] = [(i0 + i + 0.5) * edgeM, (j0 + j + 0.5) * edgeM];
      if (!isInside(x, y, corners)) continue;
      inside++;
      const top = tops[j * side + i];
      if (Number.isNaN(top)) continue;
      known++;
      volumeM3 += Math.max(top - plane(x, y), 0) * edgeM ** 2;
    }
  }
  return inside ? { volumeM3, covered: known / inside } : null;
}

/** Middles and tops of all nodes that are shown, and their edges, m. */
function visitShown(cells: Cells, take: (x: number, y: number, top: number, edgeM: number) => void): void {
  const { uLow, uHigh, uMinP } = uniforms;
  const [low, high] = [uLow.value, uHigh.value];
  for (const { bytes, depth, box } of cells.all.values()) {
    const [edgeM, tallM] = [cells.edgeM / 2 ** depth, cells.heightM / 2 ** depth];
    for (let at = 0; at < bytes.length; at += STRIDE) {
      const x = box.min.x + (bytes[at] + 0.5) * edgeM, y = box.min.y + (bytes[at + 1] + 0.5) * edgeM, z = box.min.z + (bytes[at + 2] + 0.5) * tallM;
      if (x < low.x || y < low.y || z < low.z || x > high.x || y > high.y || z > high.z || bytes[at + 3] / 255 < uMinP.value) continue;
      take(x, y, z + tallM / 2, edgeM);
    }
  }
}

/** Height of the plane through corners (Newell's normal through their middle) over x and y; null: it stands upright. */
function planeOf(corners: readonly Vector3[]): ((x: number, y: number) => number) | null {
  const normal = new Vector3();
  const middle = new Vector3();
  corners.forEach((corner, n) => {
    normal.add(corner.clone().sub(corners[0]).cross(corners[(n + 1) % corners.length].clone().sub(corners[0])));
    middle.addScaledVector(corner, 1 / corners.length);
  });
  // Within 60 degrees of upright a plane is a wall's.
  if (Math.abs(normal.z) < 0.5 * normal.length() || normal.lengthSq() === 0) return null;
  return (x, y) => middle.z - (normal.x * (x - middle.x) + normal.y * (y - middle.y)) / normal.z;
}

/** Whether a vertical line meets the polygon from above: even and odd crossings. */
function isInside(x: number, y: number, corners: readonly Vector3[]): boolean {
  let inside = false;
  corners.forEach((a, n) => {
    const b = corners[(n + 1) % corners.length];
    if (a.y > y !== b.y > y && x < ((b.x - a.x) * (y - a.y)) / (b.y - a.y) + a.x) inside = !inside;
  });
  return inside;
}
