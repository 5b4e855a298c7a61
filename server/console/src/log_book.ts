/** Log of the map as far as the page knows it: whose commits changed what, when that was measured, and from where.
 *
 * The newest entries come first and are enough for most maps; older ones are read as far back as a shown cell needs
 * them, within a bound. What is known for sure is the run without a gap that ends at the newest entry: a page of the
 * log may end early, a link may break, and entries may be left out of an event, so there may be gaps before it. */

import type { Api } from "./api.ts";
import type { LogEntry, Triple } from "./messages.ts";

/** Entries of one request: as many as the server gives. */
const PAGE = 1000;
/** Entries that are kept: some 4 MB. */
export const KEPT = 20_000;

/** Robot, or `operator`, of a commit's id or a mark's key. */
export const robotOf = (id: string): string => id.split(".")[0];

/** Place of a robot, m in the map, and the time, by its own clock. */
export interface Place {
  readonly timeS: number;
  readonly at: Triple;
}

interface Known {
  readonly seq: number;
  readonly id: string;
  /** The entry took evidence out. */
  readonly isOut: boolean;
  readonly timeS: number | null;
  readonly at: Triple | null;
}

export class LogBook {
  onChange: () => void = () => {};
  /** Older entries are on their way. */
  isReading = false;
  /** By number. */
  private readonly known = new Map<number, Known>();
  /** Rising in number; only of entries that state a time. */
  private timed: { seq: number; timeS: number }[] = [];
  /** Time of the newest measurement, s; 0: none states one. */
  newestS = 0;
  /** Oldest entry of the run without a gap that ends at the newest one; 0: none is known. */
  private firstSeq = 0;
  private newestSeq = 0;
  private readonly api: Api;
  private readonly map: string;

  constructor(api: Api, map: string) {
    this.api = api;
    this.map = map;
  }

  /** The newest `count` entries of a log that is `head` long, and what came meanwhile. */
  async newest(head: number, count: number): Promise<LogEntry[]> {
    const found: LogEntry[] = [];
    for (let after = Math.max(head - Math.min(count, KEPT), 0); ; after = found[found.length - 1].seq) {
      const entries = await this.page(after);
      found.push(...entries);
      // A page ends early where its entries name very many commits.
      if (!entries.length || (entries.length < PAGE && entries[entries.length - 1].seq >= head)) return found;
    }
  }

  /** Read on towards the log's beginning, until all entries from `seq` on are known, or as many as are kept. */
  async reachBack(seq: number): Promise<void> {
    if (this.isReading) return;
    this.isReading = true;
    try {
      do {
        const before = this.firstSeq;
        if (before <= 1 || this.newestSeq - before + PAGE >= KEPT) return;
        // Forward to where the run begins, however few entries a page has.
        for (let after = Math.max(before - 1 - PAGE, 0); after < before - 1; ) {
          const entries = await this.page(after);
          if (!entries.length) return; // this log ends before what was known of it: the server was restored
          after = entries[entries.length - 1].seq;
        }
        if (this.firstSeq >= before) return;
      } while (this.firstSeq > seq);
    } finally {
      this.isReading = false;
      this.onChange();
    }
  }

  /** Forget all: the log may be another one. */
  forget(): void {
    this.known.clear();
    this.add([]);
  }

  add(entries: readonly LogEntry[]): void {
    for (const { seq, id, kind, captured_s, place_m } of entries) {
      this.known.set(seq, { seq, id, isOut: kind === "-", timeS: captured_s && captured_s[1], at: place_m });
    }
    const sorted = [...this.known.values()].sort((a, b) => a.seq - b.seq);
    for (const { seq } of sorted.splice(0, sorted.length - KEPT)) this.known.delete(seq);
    this.newestSeq = sorted[sorted.length - 1]?.seq ?? 0;
    const gap = sorted.findLastIndex(({ seq }, n) => n > 0 && sorted[n - 1].seq !== seq - 1);
    this.firstSeq = sorted[Math.max(gap, 0)]?.seq ?? 0;
    this.timed = sorted.flatMap(({ seq, timeS }) => (timeS ? [{ seq, timeS }] : []));
    this.newestS = this.timed.reduce((most, { timeS }) => Math.max(most, timeS), 0);
    this.onChange();
  }

  /** Robot whose commit a log entry folded; null: it took one out, or is older than those that are known here. */
  robotAt(seq: number): string | null {
    const entry = this.known.get(seq);
    return entry && !this.isOut(seq) ? robotOf(entry.id) : null;
  }

  /** From where a commit was measured last, m in the map; null: not known here. */
  placeOf(id: string): Triple | null {
    for (const known of this.known.values()) if (known.id === id && known.at) return known.at;
    return null;
  }

  /** Whether an entry took evidence out. */
  isOut(seq: number): boolean {
    return this.known.get(seq)?.isOut === true;
  }

  /** Seconds between what an entry brought and the newest measurement; null: no entry states a time.
   *
   * One that states none, as a retract, counts as the one before it; one from before those that are known, as the oldest. */
  ageS(seq: number): number | null {
    if (!this.timed.length) return null;
    let [at, end] = [0, this.timed.length];
    while (end - at > 1) {
      const middle = (at + end) >> 1;
      if (this.timed[middle].seq > seq) end = middle;
      else at = middle;
    }
    return this.newestS - this.timed[at].timeS;
  }

  /** Whether an entry is from before the run without a gap, and so may be older than is told. */
  isBefore(seq: number): boolean {
    return seq < this.firstSeq;
  }

  /** From where each robot measured what is still in the map, in the order of time; the newest `most` places. */
  places(most: number): Map<string, Place[]> {
    const out = new Set([...this.known.values()].flatMap(({ id, isOut }) => (isOut ? [id] : [])));
    const found = new Map<string, Place[]>();
    for (const { id, at, timeS } of this.known.values()) {
      if (!at || timeS === null || out.has(id)) continue;
      const robot = robotOf(id);
      if (!found.has(robot)) found.set(robot, []);
      found.get(robot)!.push({ timeS, at });
    }
    for (const [robot, places] of found) found.set(robot, places.sort((a, b) => a.timeS - b.timeS).slice(-most));
    return found;
  }

  private async page(after: number): Promise<LogEntry[]> {
    const entries = await this.api.json<LogEntry[]>(`maps/${this.map}/log?after=${after}&limit=${PAGE}`);
    this.add(entries);
    return entries;
  }
}

/** Unit for ages up to so many seconds, and how many seconds it has. */
export function ageUnit(mostS: number): { unit: string; size: number } {
  if (mostS >= 2 * 86_400) return { unit: "days", size: 86_400 };
  if (mostS >= 2 * 3600) return { unit: "hours", size: 3600 };
  return mostS >= 120 ? { unit: "minutes", size: 60 } : { unit: "seconds", size: 1 };
}
