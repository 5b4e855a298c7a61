/** When what log entries brought was measured, as their commits state it: by this a cell's age is told. */

import type { LogEntry } from "./messages.ts";

export class LogTimes {
  /** Rising in number; only of entries that state a time. */
  private known: { seq: number; timeS: number }[] = [];
  private newestS = 0;
  /** Oldest entry that is known, with a time or without. */
  private firstSeq = 0;

  take(entries: Iterable<LogEntry>): void {
    const sorted = [...entries].sort((a, b) => a.seq - b.seq);
    this.firstSeq = sorted[0]?.seq ?? 0;
    this.known = sorted.flatMap(({ seq, captured_s }) => (captured_s ? [{ seq, timeS: captured_s[1] }] : []));
    this.newestS = this.known.reduce((most, { timeS }) => Math.max(most, timeS), 0);
  }

  /** Seconds between what an entry brought and the newest measurement; null: no entry states a time.
   *
   * One that states none, as a retract, counts as the one before it; one from before those that are known, as the oldest. */
  ageS(seq: number): number | null {
    if (!this.known.length) return null;
    let [at, end] = [0, this.known.length];
    while (end - at > 1) {
      const middle = (at + end) >> 1;
      if (this.known[middle].seq > seq) end = middle;
      else at = middle;
    }
    return this.newestS - this.known[at].timeS;
  }

  /** Whether an entry is older than all that are known, and so may be older than is told. */
  isBefore(seq: number): boolean {
    return seq < this.firstSeq;
  }
}

/** Unit for ages up to so many seconds, and how many seconds it has. */
export function ageUnit(mostS: number): { unit: string; size: number } {
  if (mostS >= 2 * 86_400) return { unit: "days", size: 86_400 };
  if (mostS >= 2 * 3600) return { unit: "hours", size: 3600 };
  return mostS >= 120 ? { unit: "minutes", size: 60 } : { unit: "seconds", size: 1 };
}
