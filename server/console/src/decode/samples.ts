/** What leaves hold: probabilities, colours, temperatures. FORMAT.md section 15, and section 14, "Channels".
 *
 * In a view every weight is 1, so the guess of a value is the rounded-down mean of those beside it. */

import { DamagedError, Decoder, evenOdds } from "./arithmetic.ts";
import { halfLog, Mixer, SLOTS, Tails } from "./mixing.ts";
import { beside, LeafIndex, NEARNESS, NONE, STEPS } from "./neighbours.ts";
import type { Leaves } from "./octree.ts";

const TABLE = 2048;
const NEAR = STEPS.length;
const RANK_MAX = 65535;
const VALUE_MAX = 2 ** 30;

/** Of each leaf its place in the palette of probabilities. */
export function readRanks(data: Uint8Array, near: Int32Array, N: number): Int32Array {
  const decoder = new Decoder(data);
  const mixer = new Mixer(3, SLOTS, 3 * TABLE * SLOTS);
  const tails = new Tails();
  const ranks = new Int32Array(N);
  for (let s = 0; s < N; s++) {
    let total = 0;
    let worth = 0;
    let count = 0;
    let firsts = 0;
    let faces = 0;
    for (let i = 0; i < NEAR; i++) {
      const row = near[s * NEAR + i];
      if (row !== NONE) {
        total += NEARNESS[i] * ranks[row];
        worth += NEARNESS[i];
        count++;
        if (ranks[row] === 0) firsts++;
      }
      if (i < 3) faces = 9 * faces + (row === NONE ? 8 : Math.min(ranks[row], 7));
    }
    const mean = count ? Math.min(halfLog(Math.floor((4 * total) / worth)), 40) : 41;
    mixer.contexts[0] = (mean * 4 + Math.min(count, 3)) * SLOTS;
    mixer.contexts[1] = (TABLE + faces) * SLOTS;
    mixer.contexts[2] = (2 * TABLE + firsts * 14 + count) * SLOTS;
    ranks[s] = mixer.number(decoder, 0, tails);
    if (ranks[s] < 0 || ranks[s] > RANK_MAX) throw new DamagedError("a probability is out of range");
  }
  mixer.done();
  decoder.finish();
  return ranks;
}

export interface Samples {
  /** Leaves that have values, rising. */
  readonly leaves: Uint32Array;
  /** (S, columns) */
  readonly values: Int32Array;
}

/** Which leaves have values, after those that have some of the kind `before`, and the values. */
export function readSamples(
  data: Uint8Array, octree: Leaves, index: LeafIndex, depth: number, occupied: Uint8Array, before: Uint8Array,
  columns: number,
): Samples {
  const decoder = new Decoder(data);
  if (columns === 0) {
    decoder.finish();
    return { leaves: new Uint32Array(0), values: new Int32Array(0) };
  }
  const leaves = readPresence(decoder, octree, index, depth, occupied, before);
  const values = readValues(decoder, index.earlierRows(octree.starts, leaves), leaves.length, columns);
  decoder.finish();
  return { leaves, values };
}

function readPresence(
  decoder: Decoder, { starts, sizes }: Leaves, index: LeafIndex, depth: number, occupied: Uint8Array,
  before: Uint8Array,
): Uint32Array {
  const odds = evenOdds(4 * 2 * 8);
  const present = new Uint8Array(starts.length);
  const leaves = new Uint32Array(starts.length);
  let count = 0;
  for (let n = 0; n < starts.length; n++) {
    if (sizes[n] > 1) continue;
    let near = 0;
    for (let i = 0; i < 3; i++) {
      const leaf = index.at(beside(starts[n], i, depth));
      near = 2 * near + (leaf !== NONE ? present[leaf] : 0);
    }
    if (decoder.bit(odds, (occupied[n] * 2 + before[n]) * 8 + near)) {
      present[n] = 1;
      leaves[count++] = n;
    }
  }
  return leaves.slice(0, count);
}

function readValues(decoder: Decoder, near: Int32Array, S: number, columns: number): Int32Array {
  const mixer = new Mixer(3, columns * 4 * SLOTS, columns * 3 * TABLE * SLOTS);
  const tails = Array.from({ length: columns }, () => new Tails());
  const values = new Int32Array(S * columns);
  const rests = new Int32Array(S * columns);
  for (let s = 0; s < S; s++) {
    let before = 0;
    for (let c = 0; c < columns; c++) {
      let total = 0;
      let worth = 0;
      let off = 0;
      let count = 0;
      let low = Infinity;
      let high = 0;
      for (let i = 0; i < NEAR; i++) {
        const row = near[s * NEAR + i];
        if (row === NONE) continue;
        const value = values[row * columns + c];
        total += NEARNESS[i] * value;
        worth += NEARNESS[i];
        off += Math.abs(rests[row * columns + c]);
        if (value < low) low = value;
        if (value > high) high = value;
        count++;
      }
      const error = count ? Math.min(halfLog(Math.floor((4 * off) / count)), 46) : 47;
      const spread = count > 1 ? Math.min(halfLog(4 * (high - low)), 39) : 40;
      mixer.contexts[0] = (3 * c * TABLE + 48 + error) * SLOTS;
      mixer.contexts[1] = ((3 * c + 1) * TABLE + before * 16 + Math.min(error >> 1, 15)) * SLOTS;
      mixer.contexts[2] = ((3 * c + 2) * TABLE + spread * 12 + 1) * SLOTS;
      const rest = mixer.number(decoder, (4 * c + Math.min(count, 3)) * SLOTS, tails[c]);
      const value = (count ? Math.floor(total / worth) : 0) + rest;
      if (value < 0 || value > VALUE_MAX) throw new DamagedError("a value is out of range");
      values[s * columns + c] = value;
      rests[s * columns + c] = rest;
      before = Math.min(halfLog(Math.abs(rest)), 30) * 2 + (rest < 0 ? 1 : 0);
    }
  }
  mixer.done();
  return values;
}
