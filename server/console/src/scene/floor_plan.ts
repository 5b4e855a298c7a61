/** Floor plan: one storey from straight above, column by column, and where nothing of it was ever seen.
 *
 *     nodes between a floor and a person's reach over it  -->  columns: floor, thing, wall  -->  what lies within but has none: a gap
 *
 * Free space over a floor is not known here, but a floor is: a column of a storey in which no surface was seen was not looked into. */

import { STRIDE, COLOURED, HEAT_STEP_K, HEAT_ZERO_K, WARM } from "../decode/pack.ts";
import type { Triple } from "../messages.ts";
import type { Cells } from "./cells.ts";
import { uniforms } from "./materials.ts";

/** Kinds of columns; gaps are fog that the storey encloses, and `ABSENT` is of cells that the page has no room for. */
export const FOG = 0, GAP = 1, FLOOR = 2, THING = 3, WALL = 4, ABSENT = 5;
/** A storey's slab: from below its floor to above a door; m over the floor. */
const BELOW_M = 0.3;
const ABOVE_M = 2;
/** What stands higher over the floor than these is a thing, or a wall; m. */
const THING_M = 0.3;
const WALL_M = 1.5;
/** Columns of a plan at most, and their least edge, m. */
const COLUMNS_MAX = 1_000_000;
const EDGE_LEAST_M = 0.05;
/** Around what is seen, columns. */
const MARGIN = 3;

export interface FloorPlan {
  /** Lower left corner, m in the map; edge of a column, m. */
  readonly x: number;
  readonly y: number;
  readonly edgeM: number;
  readonly width: number;
  readonly height: number;
  /** Heights of the slab, m in the map. */
  readonly lowM: number;
  readonly highM: number;
  /** By column, rows from the lowest y on. */
  readonly kinds: Uint8Array;
  /** Colour of the highest coloured node, red, green, blue and 1; and the hottest, K, 0: none. */
  readonly colours: Uint8Array;
  readonly kelvins: Float32Array;
  /** Edge of the coarsest node, m, where some are coarser than voxels; 0: none is. */
  readonly coarseM: number;
  /** Areas, m²: seen, and gaps; null: coarse nodes cover what would be one. */
  readonly seenM2: number;
  readonly gapsM2: number | null;
}

/** Slab of a storey; without floors all heights are one. */
export function slabOf(floorsM: readonly number[], storey: number): [number, number] {
  const floorM = floorsM[storey];
  if (floorM === undefined) return [-Infinity, Infinity];
  return [floorM - BELOW_M, Math.min(floorM + ABOVE_M, (floorsM[storey + 1] ?? Infinity) - BELOW_M)];
}

/** Storey whose floor is the highest that is not above a height; 0 where there is none. */
export function storeyAt(floorsM: readonly number[], z: number): number {
  return Math.max(floorsM.findLastIndex((floorM) => z >= floorM - BELOW_M), 0);
}

/** The plan of one storey of what is drawn; null: nothing of it is. */
export function floorPlanOf(cells: Cells, floorsM: readonly number[], storey: number): FloorPlan | null {
  const [lowM, highM] = slabOf(floorsM, storey);
  const drawn = [...cells.all.values()].filter(({ box }) => box.max.z > lowM && box.min.z < highM);
  const there = drawn.filter(({ bytes }) => bytes.length);
  if (!there.length) return null;
  const numbers = there.map(({ cell }) => cell);
  const span = (axis: 0 | 1) => [Math.min(...numbers.map((one) => one[axis])), Math.max(...numbers.map((one) => one[axis])) + 1];
  const [[left, right], [near, far]] = [span(0), span(1)];
  const side = sideOf(cells, (right - left) * (far - near));
  const plan = {
    x: left * cells.edgeM, y: near * cells.edgeM, edgeM: cells.edgeM / side, width: (right - left) * side, height: (far - near) * side,
  };
  const count = plan.width * plan.height;
  const raster = {
    ...plan, kinds: new Uint8Array(count), colours: new Uint8Array(4 * count), kelvins: new Float32Array(count),
    coloured: new Float32Array(count).fill(-Infinity),
  };
  const floorM = floorsM[storey] ?? null;
  const voxelM = cells.heightM / 2 ** cells.depthMax;
  let coarseM = 0;
  for (const { bytes, depth, box, wanted, isEmpty } of drawn) {
    const [edgeM, tallM] = [cells.edgeM / 2 ** depth, cells.heightM / 2 ** depth];
    if (!bytes.length && wanted === 0 && !isEmpty) fillSquare(raster, box.min.x, box.min.y, cells.edgeM, (at) => (raster.kinds[at] ||= ABSENT));
    if (bytes.length && depth < cells.depthMax) coarseM = Math.max(coarseM, edgeM);
    for (let at = 0; at < bytes.length; at += STRIDE) {
      const z = box.min.z + (bytes[at + 2] + 0.5) * tallM;
      if (!isWithin(z, tallM, voxelM, [lowM, highM]) || bytes[at + 3] / 255 < uniforms.uMinP.value) continue;
      const kind = kindOf(z, tallM, voxelM, floorM);
      const kelvin = bytes[at + 7] & WARM ? (bytes[at + 10] + 256 * bytes[at + 11]) * HEAT_STEP_K + HEAT_ZERO_K : 0;
      fillSquare(raster, box.min.x + bytes[at] * edgeM, box.min.y + bytes[at + 1] * edgeM, edgeM, (to) => {
        if (raster.kinds[to] === ABSENT || raster.kinds[to] < kind) raster.kinds[to] = kind;
        if (kelvin > raster.kelvins[to]) raster.kelvins[to] = kelvin;
        if (!(bytes[at + 7] & COLOURED) || z < raster.coloured[to]) return;
        raster.coloured[to] = z;
        raster.colours.set([bytes[at + 4], bytes[at + 5], bytes[at + 6], 1], 4 * to);
      });
    }
  }
  return cropped({ ...raster, lowM, highM, coarseM });
}

/** A voxel lies in a slab with its centre, a coarser node with any part of its height `edgeM`: what it stands for may be there. */
export function isWithin(z: number, edgeM: number, voxelM: number, [lowM, highM]: readonly [number, number]): boolean {
  const reachM = (edgeM - voxelM) / 2;
  return z + reachM >= lowM && z - reachM <= highM;
}

/** Kind of the column that a node is in, by its centre's height and its edge, m; a coarse node that holds the floor's voxels is floor. */
export function kindOf(z: number, edgeM: number, voxelM: number, floorM: number | null): number {
  if (floorM === null) return THING;
  // Heights of its lowest voxel's centre, and of its top, over the floor; floors are flat to half a voxel.
  const [lowestM, topM] = [z - (edgeM - voxelM) / 2 - floorM, z + edgeM / 2 - floorM];
  if (z - floorM < THING_M || (edgeM > voxelM && lowestM < voxelM / 2)) return FLOOR;
  return topM >= WALL_M ? WALL : THING;
}

/** Columns along a cell: as fine as voxels, as far as there is room. */
function sideOf(cells: Cells, count: number): number {
  let side = 2 ** cells.depthMax;
  while (side > 1 && (count * side * side > COLUMNS_MAX || cells.edgeM / side < EDGE_LEAST_M)) side /= 2;
  return side;
}

function fillSquare(
  { x, y, edgeM, width, height }: { x: number; y: number; edgeM: number; width: number; height: number },
  fromX: number, fromY: number, wideM: number, take: (at: number) => void,
): void {
  const [i, j] = [Math.floor((fromX - x) / edgeM + 1e-6), Math.floor((fromY - y) / edgeM + 1e-6)];
  const wide = Math.max(Math.round(wideM / edgeM), 1);
  for (let b = j; b < Math.min(j + wide, height); b++) for (let a = i; a < Math.min(i + wide, width); a++) take(b * width + a);
}

/** Without what lies around all that was seen, with gaps told from fog, and areas. */
function cropped(raster: Omit<FloorPlan, "seenM2" | "gapsM2">): FloorPlan | null {
  const { kinds, width, height, edgeM } = raster;
  let [left, right, low, high] = [width, -1, height, -1];
  for (let at = 0; at < kinds.length; at++) {
    if (!kinds[at]) continue;
    const [a, b] = [at % width, Math.floor(at / width)];
    [left, right, low, high] = [Math.min(left, a), Math.max(right, a), Math.min(low, b), Math.max(high, b)];
  }
  if (right < 0) return null;
  [left, low] = [left - MARGIN, low - MARGIN];
  const [wide, tall] = [right + MARGIN + 1 - left, high + MARGIN + 1 - low];
  const found = { kinds: new Uint8Array(wide * tall), colours: new Uint8Array(4 * wide * tall), kelvins: new Float32Array(wide * tall) };
  for (let b = 0; b < tall; b++) {
    for (let a = 0; a < wide; a++) {
      if (a + left < 0 || a + left >= width || b + low < 0 || b + low >= height) continue;
      const [from, to] = [(b + low) * width + a + left, b * wide + a];
      found.kinds[to] = kinds[from];
      found.kelvins[to] = raster.kelvins[from];
      found.colours.set(raster.colours.subarray(4 * from, 4 * from + 4), 4 * to);
    }
  }
  findGaps(found.kinds, wide, tall);
  const area = (is: (kind: number) => boolean) => found.kinds.reduce((sum, kind) => sum + (is(kind) ? 1 : 0), 0) * edgeM ** 2;
  return {
    ...raster, ...found, x: raster.x + left * edgeM, y: raster.y + low * edgeM, width: wide, height: tall,
    seenM2: area((kind) => kind >= FLOOR && kind <= WALL), gapsM2: raster.coarseM ? null : area((kind) => kind === GAP),
  };
}

/** Fog that cannot be reached from the border without crossing what was seen becomes a gap. */
function findGaps(kinds: Uint8Array, width: number, height: number): void {
  const open = new Uint8Array(kinds.length);
  const stack = [0]; // the margin is fog all round
  open[0] = 1;
  while (stack.length) {
    const at = stack.pop()!;
    const a = at % width;
    for (const to of [a > 0 ? at - 1 : -1, a < width - 1 ? at + 1 : -1, at - width, at + width]) {
      if (to < 0 || to >= width * height || open[to] || kinds[to] !== FOG) continue;
      open[to] = 1;
      stack.push(to);
    }
  }
  for (let at = 0; at < kinds.length; at++) if (kinds[at] === FOG && !open[at]) kinds[at] = GAP;
}

/** A place of the map within a plan, columns from its lower left corner. */
export function columnAt({ x, y, edgeM }: FloorPlan, [mapX, mapY]: Triple | [number, number]): [number, number] {
  return [(mapX - x) / edgeM, (mapY - y) / edgeM];
}
