/** Values of the whole map, as the server counts them: the ends of the colour bar are the same for all who look, from all sides. */

import { ApiError, type Api } from "../api.ts";
import type { Field } from "../look.ts";

export interface Histogram {
  readonly unit: string;
  readonly least: number;
  readonly most: number;
  readonly begin: number;
  readonly step: number;
  readonly counts: readonly number[];
}

/** Answer to GET .../main/spread: PROTOCOL.md section 4.20. */
interface SpreadAnswer {
  readonly complete: boolean;
  readonly height: Histogram | null;
  readonly temperature: Histogram | null;
}

/** Between two requests of a map that changes all the time, ms; after one that counted only a part; after one that was refused. */
const PAUSE_MS = 2000;
const GO_ON_MS = 200;
const AGAIN_MS = 5000;
const LOW = 0.02;
const HIGH = 0.99;
/** Narrower ranges are widened. */
const NARROW = 0.1;

export class Spread {
  onChange: () => void = () => {};
  private answer: SpreadAnswer | null = null;
  private readonly api: Api;
  private readonly map: string;
  private askedHead = -1;
  private isAsking = false;
  private nextMs = 0;

  constructor(api: Api, map: string) {
    this.api = api;
    this.map = map;
  }

  /** Whether what is known is, or will soon be, of another state of the map than `head`. */
  isBehind(head: number): boolean {
    return this.isAsking || (this.askedHead !== head && Number.isFinite(this.nextMs));
  }

  /** A few times a second: ask again where the map has changed since. */
  tick(head: number): void {
    if (this.isAsking || this.askedHead === head || performance.now() < this.nextMs) return;
    void this.ask(head);
  }

  of(field: Field): Histogram | null {
    return field === "height" || field === "temperature" ? (this.answer?.[field] ?? null) : null;
  }

  /** 2nd percentile and 99th of all occupied voxels; null: none has this field, or the server did not say yet. */
  range(field: Field): [number, number] | null {
    const found = this.of(field);
    if (!found) return null;
    // Where an end lies in the bin of the lowest or the highest value, nothing is beyond it.
    const [lowBin, highBin] = [binOf(found, LOW), binOf(found, HIGH)];
    const middle = (bin: number) => found.begin + (bin + 0.5) * found.step;
    const low = lowBin === 0 ? found.least : middle(lowBin);
    const high = highBin === found.counts.length - 1 ? found.most : middle(highBin);
    return high - low > NARROW ? [low, high] : [low - 0.5, high + 0.5];
  }

  private async ask(head: number): Promise<void> {
    this.isAsking = true;
    this.nextMs = performance.now() + PAUSE_MS;
    try {
      this.answer = await this.api.json<SpreadAnswer>(`maps/${this.map}/main/spread`);
      this.askedHead = this.answer.complete ? head : -1;
      if (!this.answer.complete) this.nextMs = performance.now() + GO_ON_MS;
    } catch (error) {
      // Without an answer the ends follow what is drawn. What a server does not know it will not know later.
      const isGone = error instanceof ApiError && error.status >= 400 && error.status < 500;
      this.nextMs = isGone ? Infinity : performance.now() + AGAIN_MS;
    } finally {
      this.isAsking = false;
      this.onChange();
    }
  }
}

/** The bin that holds the value below which a share of all lies. */
function binOf({ counts }: Histogram, share: number): number {
  const total = counts.reduce((sum, count) => sum + count, 0);
  const rank = Math.floor((share > 0.5 ? total - 1 : total) * share);
  let below = 0;
  return counts.findIndex((count) => (below += count) > rank);
}
