/** How far one sees from a place before something that is shown stands in the way. */

import { Box3, Ray, Vector3 } from "three";
import { STRIDE } from "../decode/pack.ts";
import type { Cells } from "./cells.ts";
import { uniforms } from "./materials.ts";

/** From a place towards another, m, no farther than to it. Whatever the place itself lies in does not count. */
export function freeM(cells: Cells, from: Vector3, to: Vector3): number {
  const { uLow, uHigh, uMinP } = uniforms;
  const shown = new Box3(uLow.value, uHigh.value);
  const ray = new Ray(from.clone(), to.clone().sub(from).normalize());
  const node = new Box3();
  const centre = new Vector3();
  const met = new Vector3();
  let free = from.distanceTo(to);
  for (const { bytes, depth, box } of cells.all.values()) {
    if (!bytes.length || !ray.intersectsBox(box)) continue;
    const size = cells.sizeAt(depth);
    for (let at = 0; at < bytes.length; at += STRIDE) {
      if (bytes[at + 3] / 255 < uMinP.value) continue;
      centre.set(bytes[at] + 0.5, bytes[at + 1] + 0.5, bytes[at + 2] + 0.5).multiply(size).add(box.min);
      if (!shown.containsPoint(centre)) continue;
      node.min.copy(centre).addScaledVector(size, -0.5);
      node.max.copy(centre).addScaledVector(size, 0.5);
      if (!node.containsPoint(from) && ray.intersectBox(node, met)) free = Math.min(free, met.distanceTo(from));
    }
  }
  return free;
}

/** Whether nothing that is shown reaches into a box; m in the map. */
export function isFree(cells: Cells, body: Box3): boolean {
  const { uLow, uHigh, uMinP } = uniforms;
  const shown = new Box3(uLow.value, uHigh.value);
  const node = new Box3();
  const centre = new Vector3();
  for (const { bytes, depth, box } of cells.all.values()) {
    if (!bytes.length || !box.intersectsBox(body)) continue;
    const size = cells.sizeAt(depth);
    for (let at = 0; at < bytes.length; at += STRIDE) {
      if (bytes[at + 3] / 255 < uMinP.value) continue;
      centre.set(bytes[at] + 0.5, bytes[at + 1] + 0.5, bytes[at + 2] + 0.5).multiply(size).add(box.min);
      node.min.copy(centre).addScaledVector(size, -0.5);
      node.max.copy(centre).addScaledVector(size, 0.5);
      if (node.intersectsBox(body) && shown.containsPoint(centre)) return false;
    }
  }
  return true;
}
