/** Adaptive binary arithmetic decoding: FORMAT.md section 14, "Coder" and "Context". */

export class DamagedError extends Error {}

/** Odds of a context that nothing is known of: chance in the upper 22 bits, times seen in the lower 10. */
export const EVEN = 0x80000000;
const SEEN_MAX = 255;
const STEPS = Int32Array.from({ length: SEEN_MAX + 1 }, (_, n) => Math.floor((1 << 17) / (2 * n + 3)));

export function evenOdds(contexts: number): Uint32Array {
  return new Uint32Array(contexts).fill(EVEN);
}

/** Move a context's chance towards the bit that came. */
export function learn(odds: Uint32Array, context: number, bit: number): void {
  const odd = odds[context];
  const seen = odd & 1023;
  let chance = odd >>> 10;
  // Products have up to 38 bits: divided as doubles, which is exact, instead of shifted as 32 bits.
  if (bit) chance += ((0x3fffff - chance) * STEPS[seen]) / 65536 | 0;
  else chance -= (chance * STEPS[seen]) / 65536 | 0;
  odds[context] = (chance << 10) | (seen < SEEN_MAX ? seen + 1 : SEEN_MAX);
}

/** Reads bits under chances; behind the end it reads zeros, and `finish` tells. */
export class Decoder {
  private low = 0;
  private high = 0xffffffff;
  private code = 0;
  private at = 0;
  private readonly data: Uint8Array;

  constructor(data: Uint8Array) {
    this.data = data;
    for (; this.at < 4; this.at++) this.code = (this.code * 256 + (data[this.at] ?? 0)) >>> 0;
  }

  /** A bit that is 1 with chance c / 2^16. */
  split(c: number): number {
    let { low, high } = this;
    const range = (high - low) >>> 0;
    const middle = (low + (range >>> 16) * c + (((range & 0xffff) * c) >>> 16)) >>> 0;
    const bit = this.code <= middle ? 1 : 0;
    if (bit) high = middle;
    else low = (middle + 1) >>> 0;
    while (((low ^ high) & 0xff000000) === 0) {
      this.code = ((this.code << 8) | (this.at < this.data.length ? this.data[this.at] : 0)) >>> 0;
      this.at++;
      low = (low << 8) >>> 0;
      high = ((high << 8) | 255) >>> 0;
    }
    this.low = low;
    this.high = high;
    return bit;
  }

  /** A bit under one context, which learns it. */
  bit(odds: Uint32Array, context: number): number {
    const bit = this.split(Math.max(odds[context] >>> 16, 1));
    learn(odds, context, bit);
    return bit;
  }

  /** Throws unless exactly the bytes that an encoder writes were read. */
  finish(): void {
    const left = this.at - this.data.length;
    if (left < 0 || left > 3) throw new DamagedError("a modelled stream is cut off or left over");
  }
}
