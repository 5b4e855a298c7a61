/** Floors of a map, and whether roofs lie over them: found in columns of what is drawn, some 0.3 m wide.
 *
 *     nodes  -->  columns of coarse nodes  -->  gaps as high as a room: floor below, roof above  -->  heights that many floors share
 */

import { STRIDE } from "../decode/pack.ts";
import type { Cells } from "./cells.ts";
import type { Histogram } from "./spread.ts";

/** Least height of a room, as coarse nodes show it; m. */
const ROOM_M = 1.4;
const COLUMN_M = 0.35;
/** Floors are as far apart as people are tall, and as large as a small room. */
const APART_M = 2;
const LEAST_M2 = 4;
/** Of the largest floor's area, that of another one at least. */
const SHARE = 0.2;
/** Thickest roof, m; and how many times the roofs around one must be outnumbered by what lies open. */
const ROOF_M = 1.3;
const ROOF_SHARE = 4;

export interface Storeys {
  /** Upper faces of the floors, m in the map, rising; none: no height has much of a floor. */
  readonly floorsM: readonly number[];
  /** More of the highest floor has a roof over it than lies open. */
  readonly isRoofed: boolean;
  /** Lowest height of most roofs over the highest floor, m in the map. */
  readonly roofM: number;
}

export const NO_STOREYS: Storeys = { floorsM: [], isRoofed: false, roofM: Infinity };

/** Height over a floor at which a roof is cut off, and the least one; m. */
const CUT_M = 2.2;
const CUT_LEAST_M = 1.2;
const BELOW_ROOF_M = 0.05;

/** Height above which nothing is shown, so that rooms are seen into; null: there is no roof. To millimetres. */
export function cutOf({ floorsM, isRoofed, roofM }: Storeys): number | null {
  const floorM = floorsM[floorsM.length - 1];
  if (floorM === undefined || !isRoofed) return null;
  return Math.round(1000 * Math.min(floorM + CUT_M, Math.max(roofM - BELOW_ROOF_M, floorM + CUT_LEAST_M))) / 1000;
}

/** Floors and roofs of what is drawn; `layers`: voxels of the whole map by height, which tell floors to a voxel. */
export function storeysOf(cells: Cells, layers: Histogram | null): Storeys {
  const grid = Math.min(Math.max(Math.ceil(Math.log2(cells.edgeM / COLUMN_M)), 1), Math.min(cells.depthMax, 6));
  const edgeM = cells.edgeM / 2 ** grid;
  const areas = new Map<number, { covered: number; open: number; roofs: Map<number, number> }>();
  const roofsAt = new Map<number, number>();
  const at = (top: number) => {
    let found = areas.get(top);
    if (!found) areas.set(top, (found = { covered: 0, open: 0, roofs: new Map() }));
    return found;
  };
  const room = Math.ceil(ROOM_M / edgeM);
  for (const column of columns(cells, grid)) {
    let isCovered = false;
    for (let n = 1; n < column.length; n++) {
      if (column[n] - column[n - 1] - 1 < room) continue;
      const floor = at(column[n - 1] + 1);
      floor.covered++;
      floor.roofs.set(column[n], (floor.roofs.get(column[n]) ?? 0) + 1);
      roofsAt.set(column[n], (roofsAt.get(column[n]) ?? 0) + 1);
      isCovered = true;
    }
    if (!isCovered) at(column[column.length - 1] + 1).open++;
  }
  // What lies open just over others' roofs is the roof itself, of a room whose floor was not seen.
  for (const [top, area] of areas) {
    let roofs = 0;
    for (let below = 1; below * edgeM <= ROOF_M; below++) roofs += roofsAt.get(top - below) ?? 0;
    if (roofs * ROOF_SHARE > area.open) area.open = 0;
  }
  const coarsestM = [...cells.all.values()].reduce((most, { points, depth }) => (points ? Math.max(most, cells.edgeM / 2 ** depth) : most), edgeM);
  const tops = floorsAmong(areas, edgeM);
  if (!tops.length) return NO_STOREYS;
  const near = (top: number) => [top - 1, top, top + 1].flatMap((one) => areas.get(one) ?? []);
  const highest = near(tops[tops.length - 1]);
  const covered = highest.reduce((sum, area) => sum + area.covered, 0);
  const open = highest.reduce((sum, area) => sum + area.open, 0);
  const roofs = highest.flatMap((area) => [...area.roofs]).sort((a, b) => b[1] - a[1]);
  return {
    floorsM: tops.map((top) => exactly(top * edgeM, coarsestM, layers)), isRoofed: covered > open,
    roofM: roofs.length ? roofs[0][0] * edgeM : Infinity,
  };
}

/** Heights at which many columns have a floor, each the largest within reach; rising. */
function floorsAmong(areas: ReadonlyMap<number, { covered: number; open: number }>, edgeM: number): number[] {
  const of = (top: number) => (areas.get(top)?.covered ?? 0) + (areas.get(top)?.open ?? 0);
  const sorted = [...areas.keys()].sort((a, b) => of(b) - of(a) || a - b);
  const least = Math.max(LEAST_M2 / edgeM ** 2, SHARE * of(sorted[0]));
  const found: number[] = [];
  for (const top of sorted) {
    if (of(top) >= least && found.every((one) => Math.abs(one - top) * edgeM >= APART_M)) found.push(top);
  }
  return found.sort((a, b) => a - b);
}

/** Upper face of the densest layer of voxels in the coarse node below a height. */
function exactly(topM: number, coarsestM: number, layers: Histogram | null): number {
  if (!layers) return topM - coarsestM / 2;
  const bin = (m: number) => Math.min(Math.max(Math.round((m - layers.begin) / layers.step), 0), layers.counts.length);
  let best = Math.max(bin(topM) - 1, 0);
  for (let n = bin(topM - coarsestM); n < bin(topM); n++) if (layers.counts[n] > layers.counts[best]) best = n;
  return layers.begin + (best + 1) * layers.step;
}

/** Rising heights of occupied coarse nodes, column by column. */
function columns(cells: Cells, grid: number): number[][] {
  const side = 2 ** grid;
  const stacks = new Map<string, number[][]>();
  for (const { cell, bytes, depth } of cells.all.values()) {
    if (!bytes.length) continue;
    const key = `${cell[0]},${cell[1]}`;
    let stack = stacks.get(key);
    if (!stack) stacks.set(key, (stack = Array.from({ length: side * side }, () => [])));
    // A node is a part of a coarse node, or several of them.
    const wide = Math.max(2 ** (grid - depth), 1);
    const shift = 2 ** (depth - grid);
    const seen = new Uint8Array(side ** 3);
    for (let at = 0; at < bytes.length; at += STRIDE) {
      const x = Math.floor(bytes[at] / shift), y = Math.floor(bytes[at + 1] / shift), z = Math.floor(bytes[at + 2] / shift);
      for (let n = 0; n < wide ** 3; n++) {
        const dx = n % wide, dy = Math.floor(n / wide) % wide, dz = Math.floor(n / wide ** 2);
        seen[((y + dy) * side + x + dx) * side + z + dz] = 1;
      }
    }
    for (let n = 0; n < seen.length; n++) if (seen[n]) stack[Math.floor(n / side)].push(cell[2] * side + (n % side));
  }
  return [...stacks.values()].flat().filter((column) => column.length > 0).map((column) => column.sort((a, b) => a - b));
}
