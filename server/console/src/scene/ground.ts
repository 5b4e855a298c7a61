/** Ground of a level: how steep, stepped and hard to cross each surface is, from the columns around it.
 *
 *     surfaces by column, of a cell and the cells around it  -->  the nearest in height of each of eight neighbours
 *         -->  plane through them: slope, roughness;  largest step;  obstacle over it  -->  difficulty, as `cairn map query ... elevation` has it
 *
 * It is written into the bytes that a cell draws (`ShownCell.bytes`), not into those that other moments share. Neighbours shown at another depth are unknown. */

import type { InterleavedBufferAttribute } from "three";
import { COLOURED, DIFFICULTY_STEP, NO_SLOPE, RISE_STEP_M, SLOPE_STEP_DEG, STRIDE } from "../decode/pack.ts";
import type { Cells } from "./cells.ts";
import type { ShownCell } from "./shown_cell.ts";

/** Limits of a usual vehicle, and the height of what hinders it: `Vehicle` and `CLEARANCE_M` of cairn_map/queries/level/elevation.py. */
export const SLOPE_MAX_DEG = 30;
export const STEP_MAX_M = 0.25;
const ROUGHNESS_MAX_M = 0.08;
const CLEARANCE_M = 1.5;
/** Columns of nine with a surface through which a plane is laid, at least. */
const PLANE_MIN = 5;
/** Surfaces are drawn down to the lowest one around, but not as deep as this, m: below is another surface, or a hole. */
const FALL_MAX_M = 0.6;
/** Time of one tick, after which the next one goes on, ms. All that a page without a graphics card shows takes 0.2 s. */
const WRITE_MS = 30;
const NEIGHBOURS = Array.from({ length: 27 }, (_, n) => [(n % 3) - 1, (Math.floor(n / 3) % 3) - 1, Math.floor(n / 9) - 1] as const);

/** Surfaces of one cell by column: the first row of each, -1 for none, and the row after it. */
interface Columns {
  readonly first: Int32Array;
  readonly next: Int32Array;
  /** Height of each row's surface, m in the map; NaN: it is an obstacle. */
  readonly heights: Float64Array;
  /** Upper end of each row, m in the map. */
  readonly tops: Float64Array;
}

export interface GroundReading {
  /** Height of the surface, m in the map; null: an obstacle. */
  readonly heightM: number | null;
  readonly difficulty: number | null;
  readonly slopeDeg: number | null;
  readonly stepM: number | null;
}

export class Ground {
  /** Something was written: a frame is to be drawn. */
  onChange: () => void = () => {};
  /** Number of times that something was written so far. */
  writes = 0;
  private seen = -1;
  private readonly columns = new WeakMap<Uint8Array, Columns>();
  /** Bytes of a cell and the cells around it from which its ground was last found. */
  private readonly madeOf = new WeakMap<ShownCell, readonly (Uint8Array | null)[]>();
  private readonly cells: Cells;

  constructor(cells: Cells) {
    this.cells = cells;
  }

  /** Find the ground of cells that changed, or next to which one did: a part of them, a few times a second. */
  tick(): void {
    this.writeUntil(performance.now() + WRITE_MS);
  }

  /** Find the ground of all of them now. */
  finish(): void {
    this.writeUntil(Infinity);
  }

  /** `endMs`: as of performance.now(). */
  private writeUntil(endMs: number): void {
    if (!this.cells.isLevel || this.seen === this.cells.shows) return;
    this.seen = this.cells.shows;
    let isOther = false;
    for (const cell of this.cells.all.values()) {
      if (!cell.points) continue;
      const around = NEIGHBOURS.map(([i, j, k]) => {
        const near = this.cells.all.get([cell.cell[0] + i, cell.cell[1] + j, cell.cell[2] + k].join());
        return near?.points && near.depth === cell.depth ? near.bytes : null;
      });
      const before = this.madeOf.get(cell);
      if (before && around.every((bytes, n) => bytes === before[n])) continue;
      if (performance.now() > endMs) {
        this.seen = -1;
        break;
      }
      this.madeOf.set(cell, around);
      this.write(cell, around);
      isOther = true;
    }
    if (!isOther) return;
    this.writes++;
    this.onChange();
  }

  /** Ground at a node, as its bytes have it. */
  reading({ bytes, box, depth }: ShownCell, row: number): GroundReading {
    const at = row * STRIDE;
    const millimetres = bytes[at + 8]! + 256 * bytes[at + 9]!;
    const isKnown = millimetres > 0 && (bytes[at + 7]! & COLOURED) !== 0;
    const lowM = box.min.z + (bytes[at + 2]! * this.cells.heightM) / 2 ** depth;
    return {
      heightM: millimetres ? lowM + (millimetres - 1) / 1000 : null,
      difficulty: isKnown ? bytes[at + 4]! * DIFFICULTY_STEP : null,
      slopeDeg: isKnown && bytes[at + 5] !== NO_SLOPE ? bytes[at + 5]! * SLOPE_STEP_DEG : null,
      stepM: isKnown ? bytes[at + 6]! * RISE_STEP_M : null,
    };
  }

  private write(cell: ShownCell, around: readonly (Uint8Array | null)[]): void {
    const { bytes, depth } = cell;
    const tables = around.map((each, n) => each && this.columnsOf(each, depth, (cell.cell[2] + NEIGHBOURS[n]![2]) * this.cells.heightM));
    const heights = tables[13]!.heights;
    const words = new Uint16Array(bytes.buffer, bytes.byteOffset);
    const isVoxels = depth === this.cells.depthMax;
    const edgeM = this.cells.edgeM / 2 ** depth;
    for (let row = 0; row < heights.length; row++) {
      const at = row * STRIDE;
      bytes[at + 7]! &= ~COLOURED;
      if (Number.isNaN(heights[row])) continue;
      const { slopeDeg, roughnessM, stepM, fallM } = around9(tables, bytes[at]!, bytes[at + 1]!, 2 ** depth, heights[row]!, edgeM);
      words[row * (STRIDE / 2) + 5] = Math.round(1000 * fallM);
      const slope = slopeDeg === null ? NO_SLOPE : Math.min(Math.round(slopeDeg / SLOPE_STEP_DEG), NO_SLOPE - 1);
      // Over wider columns a step says nothing of what a wheel meets.
      if (!isVoxels) continue;
      const obstacleM = obstacleOver(tables, bytes[at]!, bytes[at + 1]!, 2 ** depth, heights[row]!);
      const difficulty = Math.max((slopeDeg ?? 0) / SLOPE_MAX_DEG, roughnessM / ROUGHNESS_MAX_M, Math.max(stepM, obstacleM) / STEP_MAX_M);
      bytes[at + 4] = Math.min(Math.round(difficulty / DIFFICULTY_STEP), 255);
      bytes[at + 5] = slope;
      bytes[at + 6] = Math.min(Math.round(stepM / RISE_STEP_M), 255);
      bytes[at + 7]! |= COLOURED;
    }
    const colour = cell.points!.geometry.getAttribute("colour") as InterleavedBufferAttribute;
    colour.data.needsUpdate = true;
  }

  private columnsOf(bytes: Uint8Array, depth: number, lowM: number): Columns {
    let found = this.columns.get(bytes);
    if (found) return found;
    const side = 2 ** depth;
    const tallM = this.cells.heightM / side;
    const count = bytes.length / STRIDE;
    const words = new Uint16Array(bytes.buffer, bytes.byteOffset);
    found = { first: new Int32Array(side * side).fill(-1), next: new Int32Array(count), heights: new Float64Array(count), tops: new Float64Array(count) };
    for (let row = 0; row < count; row++) {
      const at = row * STRIDE;
      const column = bytes[at + 1]! * side + bytes[at]!;
      const millimetres = words[row * (STRIDE / 2) + 4]!;
      const z = lowM + bytes[at + 2]! * tallM;
      found.heights[row] = millimetres ? z + (millimetres - 1) / 1000 : NaN;
      found.tops[row] = millimetres ? found.heights[row]! : z + tallM;
      found.next[row] = found.first[column]!;
      found.first[column] = row;
    }
    this.columns.set(bytes, found);
    return found;
  }
}

/** Height of the nearest surface of a column, which may lie in a cell around: x and y from -1 to the side. */
function surfaceAt(tables: readonly (Columns | null)[], x: number, y: number, side: number, nearM: number): number {
  const [i, j] = [x < 0 ? 0 : x >= side ? 2 : 1, y < 0 ? 0 : y >= side ? 2 : 1];
  const column = ((y + side) % side) * side + ((x + side) % side);
  let best = NaN;
  for (let k = 0; k < 3; k++) {
    const table = tables[9 * k + 3 * j + i];
    if (!table) continue;
    for (let row = table.first[column]!; row >= 0; row = table.next[row]!) {
      const height = table.heights[row]!;
      if (!Number.isNaN(height) && !(Math.abs(height - nearM) >= Math.abs(best - nearM))) best = height;
    }
  }
  return best;
}

/** Height of the highest thing over a surface in its column, within the clearance, m over that; 0: nothing is. */
function obstacleOver(tables: readonly (Columns | null)[], x: number, y: number, side: number, heightM: number): number {
  let highest = 0;
  for (let k = 0; k < 3; k++) {
    const table = tables[9 * k + 4];
    if (!table) continue;
    for (let row = table.first[y * side + x]!; row >= 0; row = table.next[row]!) {
      const overM = table.tops[row]! - heightM;
      if (overM <= CLEARANCE_M) highest = Math.max(highest, overM);
    }
  }
  return highest;
}

/** Slope and roughness of the plane through a surface and those around it (least squares about their means), largest step, and fall, m. */
function around9(
  tables: readonly (Columns | null)[], x: number, y: number, side: number, heightM: number, edgeM: number,
): { slopeDeg: number | null; roughnessM: number; stepM: number; fallM: number } {
  let [n, sx, sy, sz, sxx, sxy, syy, sxz, syz, szz, stepM, fallM] = [1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
  for (let dy = -1; dy <= 1; dy++) {
    for (let dx = -1; dx <= 1; dx++) {
      if (!dx && !dy) continue;
      const z = surfaceAt(tables, x + dx, y + dy, side, heightM) - heightM;
      if (Number.isNaN(z)) continue;
      n++;
      sx += dx, sy += dy, sz += z;
      sxx += dx * dx, sxy += dx * dy, syy += dy * dy;
      sxz += dx * z, syz += dy * z, szz += z * z;
      stepM = Math.max(stepM, Math.abs(z));
      if (-z <= FALL_MAX_M) fallM = Math.max(fallM, -z);
    }
  }
  const [cxx, cxy, cyy] = [sxx - (sx * sx) / n, sxy - (sx * sy) / n, syy - (sy * sy) / n];
  const [cxz, cyz, czz] = [sxz - (sx * sz) / n, syz - (sy * sz) / n, szz - (sz * sz) / n];
  const area = cxx * cyy - cxy * cxy;
  if (n < PLANE_MIN || area < 1e-9) return { slopeDeg: null, roughnessM: 0, stepM, fallM };
  const [a, b] = [(cxz * cyy - cyz * cxy) / area, (cyz * cxx - cxz * cxy) / area];
  const roughnessM = Math.sqrt(Math.max(czz - a * cxz - b * cyz, 0) / n);
  return { slopeDeg: (Math.atan(Math.hypot(a, b) / edgeM) * 180) / Math.PI, roughnessM, stepM, fallM };
}
