/** Views as what the graphics card draws: 12 bytes a node, nothing to be computed again for another colouring.
 *
 *     u8 x, y, z in nodes of the cell | u8 probability in 1/255 | u8 red, green, blue | u8 flags | u16 mean, hottest
 *
 * Flags: bit 0 it has a colour, bit 1 a temperature, bits 2 to 7 its faces towards -x, +x, -y, +y, -z, +z lie open: that
 * is enough to light it. Temperatures are in steps of 0.02 K from 150 K on: 1460 K at most. What has none says so in its flags.
 *
 * A level's nodes have instead of the colour what scene/ground.ts finds of their neighbours (bit 0: it did), and instead of the
 * temperature the height of the surface over the node's lower face in mm, plus 1 (0: none, it is an obstacle), and a fall. */

import type { View } from "./view.ts";

export const STRIDE = 12;
export const COLOURED = 1;
export const WARM = 2;
export const HEAT_STEP_K = 0.02;
export const HEAT_ZERO_K = 150;
/** Units of the bytes in which a level's node has difficulty, slope and step; and the byte of an unknown slope. */
export const DIFFICULTY_STEP = 0.01;
export const SLOPE_STEP_DEG = 0.25;
export const RISE_STEP_M = 0.004;
export const NO_SLOPE = 255;

/** 16 places along one axis from the lowest, fourth, ... bits of a Morton number. */
function squeezed(place: number): number {
  let x = place & 0x09249249;
  x = (x ^ (x >> 2)) & 0x030c30c3;
  x = (x ^ (x >> 4)) & 0x0300f00f;
  x = (x ^ (x >> 8)) & 0x030000ff;
  return (x ^ (x >> 16)) & 0x3ff;
}

export function packed(view: View, isLevel = false): Uint8Array {
  const bytes = new Uint8Array(view.nodes.length * STRIDE);
  const words = new Uint16Array(bytes.buffer);
  for (let v = 0; v < view.nodes.length; v++) {
    const at = v * STRIDE;
    bytes[at] = squeezed(view.nodes[v]);
    bytes[at + 1] = squeezed(view.nodes[v] >> 1);
    bytes[at + 2] = squeezed(view.nodes[v] >> 2);
    const chance = view.chances[v];
    bytes[at + 3] = view.inLogOdds ? Math.round(255 / (1 + Math.exp((32768 - chance) * 0.001))) : chance;
  }
  addOpenFaces(bytes, view.depth);
  const [red, green, blue] = view.rgbTops;
  for (let c = 0; c < view.coloured.length; c++) {
    const at = view.coloured[c] * STRIDE;
    bytes[at + 4] = Math.round((view.rgb[3 * c] * 255) / red);
    bytes[at + 5] = Math.round((view.rgb[3 * c + 1] * 255) / green);
    bytes[at + 6] = Math.round((view.rgb[3 * c + 2] * 255) / blue);
    bytes[at + 7] |= COLOURED;
  }
  for (let w = 0; w < view.warm.length; w++) {
    const row = view.warm[w];
    if (isLevel) {
      words[row * (STRIDE / 2) + 4] = Math.min(Math.round(view.heats[w * view.heatColumns] * view.heatStepK * 1000) + 1, 65535);
      continue;
    }
    bytes[row * STRIDE + 7] |= WARM;
    const mean = view.heats[w * view.heatColumns];
    const hottest = view.heats[w * view.heatColumns + view.heatColumns - 1];
    words[row * (STRIDE / 2) + 4] = steps(mean * view.heatStepK);
    words[row * (STRIDE / 2) + 5] = steps(hottest * view.heatStepK);
  }
  return bytes;
}

function steps(kelvin: number): number {
  return Math.min(Math.max(Math.round((kelvin - HEAT_ZERO_K) / HEAT_STEP_K), 0), 65535);
}

/** Which of each node's six neighbours is not there; beyond the cell's border none is known, so the face counts as shut. */
function addOpenFaces(bytes: Uint8Array, depth: number): void {
  const side = 2 ** depth;
  const there = new Uint8Array(Math.ceil(side ** 3 / 8));
  const has = (n: number) => (there[n >> 3] >> (n & 7)) & 1;
  for (let at = 0; at < bytes.length; at += STRIDE) {
    const n = (bytes[at + 2] * side + bytes[at + 1]) * side + bytes[at];
    there[n >> 3] |= 1 << (n & 7);
  }
  for (let at = 0; at < bytes.length; at += STRIDE) {
    let flags = 0;
    for (let axis = 0, step = 1; axis < 3; axis++, step *= side) {
      const place = bytes[at + axis];
      const n = (bytes[at + 2] * side + bytes[at + 1]) * side + bytes[at];
      if (place > 0 && !has(n - step)) flags |= 4 << (2 * axis);
      if (place < side - 1 && !has(n + step)) flags |= 8 << (2 * axis);
    }
    bytes[at + 7] = flags;
  }
}
