/** Bits under several contexts at once, and numbers made of them: FORMAT.md section 14, "Mixing" and "Number". */

import { DamagedError, Decoder, EVEN, evenOdds, learn } from "./arithmetic.ts";

const KNOTS = [
  1, 2, 3, 6, 10, 16, 27, 45, 73, 120, 194, 310, 488, 747, 1101, 1546, 2047, 2549, 2994, 3348, 3607, 3785, 3901, 3975,
  4022, 4050, 4068, 4079, 4085, 4089, 4092, 4093, 4094,
];
const STRETCH_MAX = 2047;
/** By stretch + 2048. */
const SQUASH = Int32Array.from({ length: 4096 }, (_, n) => {
  const x = n - 2048;
  const i = (x >> 7) + 16;
  const f = x & 127;
  return (KNOTS[i] * (128 - f) + KNOTS[Math.min(i + 1, 32)] * f + 64) >> 7;
});
/** By probability in 1/4096: the least stretch that gives at least so much. */
const STRETCH = new Int32Array(4096);
for (let q = 0, x = -STRETCH_MAX; q < 4096; q++) {
  while (x < STRETCH_MAX && SQUASH[x + 2048] < q) x++;
  STRETCH[q] = x;
}

export const SLOTS = 16;
const TAILS = 64 * 8;
/** No number of a view is longer; the format allows 62. */
const LENGTH_MAX = 40;

/** Contexts of mixers that are done, by how many they are: to have new ones of the system takes longer than a small view. */
const KEPT = new Map<number, Uint32Array>();

/** Contexts of several opinions, and how loud each of them is. */
export class Mixer {
  readonly contexts: Int32Array;
  private readonly odds: Uint32Array;
  private readonly weights: Float64Array;
  private readonly opinions: number;

  constructor(opinions: number, rows: number, contexts: number) {
    this.opinions = opinions;
    this.contexts = new Int32Array(opinions);
    this.odds = KEPT.get(contexts)?.fill(EVEN) ?? evenOdds(contexts);
    KEPT.delete(contexts);
    this.weights = new Float64Array(rows * opinions).fill(Math.floor((65536 * 3) / (2 * opinions)));
  }

  /** What a later one may take over; this one is not used any more. */
  done(): void {
    KEPT.set(this.odds.length, this.odds);
  }

  bit(decoder: Decoder, slot: number, row: number): number {
    const { contexts, odds, weights, opinions } = this;
    const first = row * opinions;
    let total = 0;
    for (let i = 0; i < opinions; i++) total += STRETCH[odds[contexts[i] + slot] >>> 20] * weights[first + i];
    const mixed = Math.min(Math.max(Math.floor(total / 65536), -STRETCH_MAX), STRETCH_MAX);
    const chance = SQUASH[mixed + 2048];
    const bit = decoder.split(chance << 4);
    const error = ((bit << 12) - chance) * 16;
    for (let i = 0; i < opinions; i++) {
      const context = contexts[i] + slot;
      weights[first + i] += (STRETCH[odds[context] >>> 20] * error + 32768) >> 16;
      learn(odds, context, bit);
    }
    return bit;
  }

  /** A number under SLOTS contexts of every opinion, SLOTS rows of weights from `row` on, and tails. */
  number(decoder: Decoder, row: number, tails: Tails): number {
    if (this.bit(decoder, 0, row)) return 0;
    const negative = this.bit(decoder, 1, row + 1);
    let length = 0;
    for (;;) {
      const slot = 2 + Math.min(length, SLOTS - 3);
      if (!this.bit(decoder, slot, row + slot)) break;
      if (++length > LENGTH_MAX) throw new DamagedError("a number is out of range");
    }
    let found = 1;
    for (let n = 0; n < length; n++) {
      found = 2 * found + decoder.bit(tails.odds, 8 * length + (n < 3 ? found : 0));
    }
    return negative ? -found : found;
  }
}

/** Contexts of the bits below a number's first. */
export class Tails {
  readonly odds = evenOdds(TAILS);
}

/** Buckets that grow by half: 0, 1, 2, 3, 4 (4-5), 5 (6-7), 6 (8-11), ... */
export function halfLog(x: number): number {
  let n = 0;
  while (x >= 4) {
    x = Math.floor(x / 2);
    n += 2;
  }
  return n + x;
}
