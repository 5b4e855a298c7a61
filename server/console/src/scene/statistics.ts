/** What is drawn, as numbers: ends for the legend, and the hottest place. */

import { Vector3 } from "three";
import { HEAT_STEP_K, HEAT_ZERO_K, STRIDE, WARM } from "../decode/pack.ts";
import type { Field } from "../look.ts";
import type { Cells } from "./cells.ts";
import { SLOPE_MAX_DEG, STEP_MAX_M } from "./ground.ts";
import type { ShownCell } from "./shown_cell.ts";

const SAMPLES = 40_000;

/** 2nd percentile and 99th of what is drawn, in the shader's units; null: nothing has this field. */
export function rangeOf(cells: Cells, field: Field, lowZ: number, highZ: number): [number, number] | null {
  if (field === "probability") return [0.5, 1];
  // Up to what a usual vehicle passes.
  if (field === "difficulty") return [0, 1];
  if (field === "slope") return [0, SLOPE_MAX_DEG];
  if (field === "step") return [0, STEP_MAX_M];
  if (field === "age") {
    let oldest = 1;
    for (const { points, lm } of cells.all.values()) if (points) oldest = Math.max(oldest, cells.ageOf(lm));
    return [0, oldest];
  }
  const found: number[] = [];
  const stride = Math.max(1, Math.floor(cells.drawn / SAMPLES));
  for (const cell of cells.all.values()) {
    const tallM = cells.heightM / 2 ** cell.depth;
    for (let row = 0; row < cell.count; row += stride) {
      const at = row * STRIDE;
      const z = cell.box.min.z + (cell.bytes[at + 2] + 0.5) * tallM;
      if (z < lowZ || z > highZ) continue;
      if (field === "height") found.push(z);
      else if (cell.bytes[at + 7] & WARM) found.push(hottestK(cell, at));
    }
  }
  if (!found.length) return null;
  found.sort((a, b) => a - b);
  const low = found[Math.floor(found.length * 0.02)];
  const high = found[Math.floor((found.length - 1) * 0.99)];
  return high - low > 0.1 ? [low, high] : [low - 0.5, high + 0.5];
}

function hottestK(cell: ShownCell, at: number): number {
  return (cell.bytes[at + 10] + 256 * cell.bytes[at + 11]) * HEAT_STEP_K + HEAT_ZERO_K;
}

export interface HotPlace {
  readonly cell: ShownCell;
  readonly centre: Vector3;
  readonly kelvin: number;
  readonly isVoxel: boolean;
}

/** The hottest node that is drawn; at coarse depths the node that holds the hottest voxel. */
export function hottest(cells: Cells, isShown: (place: Vector3, probability: number) => boolean): HotPlace | null {
  let best: HotPlace | null = null;
  const place = new Vector3();
  for (const cell of cells.all.values()) {
    const edgeM = cells.edgeM / 2 ** cell.depth;
    for (let at = 0; at < cell.bytes.length; at += STRIDE) {
      if (!(cell.bytes[at + 7] & WARM)) continue;
      const kelvin = hottestK(cell, at);
      if (best && kelvin <= best.kelvin) continue;
      place.set(cell.bytes[at], cell.bytes[at + 1], cell.bytes[at + 2]).addScalar(0.5).multiplyScalar(edgeM).add(cell.box.min);
      if (!isShown(place, cell.bytes[at + 3] / 255)) continue;
      best = { cell, centre: place.clone(), kelvin, isVoxel: cell.depth === cells.depthMax };
    }
  }
  return best;
}
