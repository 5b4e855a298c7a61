/** The commits of a map in the order of time: when each was measured, whose it is, and whether it was taken out again.
 *
 *     log entries  -->  one commit an id, at the time of its last scan  -->  moments that the map can be shown at
 *
 * A commit that states no time, as a retract, stands where the server received it. */

import { robotOf } from "./log_book.ts";
import type { LogEntry } from "./messages.ts";

/** Entries that are kept here: some 15 MB. */
export const HELD_MAX = 20_000;

/** When, by whom and why evidence was taken out; null: not known here. */
export interface TakenOut {
  readonly seq: number;
  readonly whenS: number | null;
  /** Commit that says so: its author, and for an administrator the line of the audit log. */
  readonly by: string | null;
  /** Token of the operator who asked for it, or of the relay that brought it; null: a robot's own commit. */
  readonly token: string | null;
  readonly note: string;
}

export interface Commit {
  readonly id: string;
  readonly robot: string;
  readonly timeS: number;
  readonly entry: LogEntry;
  readonly out: TakenOut | null;
  /** It says that others are taken out. */
  readonly isRetract: boolean;
}

/** A state of the map by time of capture: all times with one key show the same. */
export interface Moment {
  readonly atS: number;
  readonly key: string;
}

export class Timeline {
  readonly entries = new Map<number, LogEntry>();
  /** Length of the map's epochs, s; null: each commit has a time of its own. */
  private readonly epochS: number | null;
  /** Entries at the log's end were forgotten for older ones. */
  private isCut = false;
  private made: readonly Commit[] | null = null;
  /** Times of capture of commits that are no retract, s, rising, and the moments: made of `made`. */
  private madeTimesS: Float64Array | null = null;
  private madeMoments: readonly Moment[] | null = null;

  constructor(epochS: number | null) {
    this.epochS = epochS;
  }

  /** `keepsOld`: where there are too many, those of the other end are forgotten.
   *
   * Once the newest were forgotten, only what adjoins is taken: an event would leave a hole before it, which no button reads. */
  add(entries: readonly LogEntry[], keepsOld = false): void {
    let last = this.isCut ? this.lastSeq : Infinity;
    for (const entry of entries) {
      if (entry.seq > last + 1) break;
      last = Math.max(last, entry.seq);
      this.entries.set(entry.seq, entry);
    }
    if (this.entries.size > HELD_MAX) {
      const seqs = [...this.entries.keys()].sort((a, b) => (keepsOld ? b - a : a - b));
      for (const seq of seqs.slice(0, seqs.length - HELD_MAX)) this.entries.delete(seq);
      this.isCut ||= keepsOld;
    }
    this.changed();
  }

  forget(): void {
    this.entries.clear();
    this.isCut = false;
    this.changed();
  }

  private changed(): void {
    this.made = this.madeTimesS = this.madeMoments = null;
  }

  get firstSeq(): number {
    let least = Infinity;
    for (const seq of this.entries.keys()) least = Math.min(least, seq);
    return least === Infinity ? 0 : least;
  }

  get lastSeq(): number {
    let most = 0;
    for (const seq of this.entries.keys()) most = Math.max(most, seq);
    return most;
  }

  /** Rising in time. */
  get commits(): readonly Commit[] {
    this.made ??= commitsOf([...this.entries.values()].sort((a, b) => a.seq - b.seq));
    return this.made;
  }

  /** When, by whom and why a commit was taken out; null: it is in the map. */
  takenOut(id: string): TakenOut | null {
    return this.commits.find((commit) => commit.id === id)?.out ?? null;
  }

  /** Moments at which the map changed, rising: what was taken out is in none. */
  get moments(): readonly Moment[] {
    return (this.madeMoments ??= this.findMoments());
  }

  private findMoments(): readonly Moment[] {
    const found: Moment[] = [];
    for (const { entry, out, isRetract } of this.commits) {
      if (out || isRetract || !entry.captured_s) continue;
      const moment = this.momentAt(entry.captured_s[1]);
      if (found[found.length - 1]?.key !== moment.key) found.push(moment);
    }
    return found;
  }

  /** The state of the map at a time. */
  momentAt(timeS: number): Moment {
    if (this.epochS) return { atS: timeS, key: String(Math.floor(timeS / this.epochS)) };
    // Between two commits nothing changes, so these times are one moment.
    const timesS = this.timesS;
    let [at, end] = [0, timesS.length];
    while (at < end) {
      const middle = (at + end) >> 1;
      if (timesS[middle]! <= timeS) at = middle + 1;
      else end = middle;
    }
    const lastS = at ? timesS[at - 1]! : timeS;
    return { atS: lastS, key: String(lastS) };
  }

  private get timesS(): Float64Array {
    this.madeTimesS ??= Float64Array.from(this.commits.flatMap(({ entry, isRetract }) => (!isRetract && entry.captured_s ? [entry.captured_s[1]] : []))).sort();
    return this.madeTimesS;
  }
}

function commitsOf(entries: readonly LogEntry[]): Commit[] {
  const retracts = new Map<string, LogEntry>();
  const outs = new Map<string, LogEntry>();
  const first = new Map<string, LogEntry>();
  for (const entry of entries) {
    if (entry.kind === "-") outs.set(entry.id, entry);
    if (!first.has(entry.id)) first.set(entry.id, entry);
    if (entry.kind === "+") for (const target of entry.retracts) if (!retracts.has(target)) retracts.set(target, entry);
  }
  const commits = [...first.values()].map((entry) => {
    const gone = outs.get(entry.id);
    return {
      id: entry.id, robot: robotOf(entry.id), entry, timeS: entry.captured_s?.[1] ?? entry.pushed_s ?? 0,
      out: gone ? takenOutBy(gone.seq, retracts.get(entry.id)) : null,
      isRetract: entry.retracts.length > 0 && entry.cells === 0,
    };
  });
  // What states no time at all stands where the log has it: at the time of the entry before.
  let beforeS = commits.find(({ timeS }) => timeS > 0)?.timeS ?? 0;
  const placed = commits.map((commit) => {
    beforeS = commit.timeS || beforeS;
    return commit.timeS ? commit : { ...commit, timeS: beforeS };
  });
  return placed.sort((a, b) => a.timeS - b.timeS || a.entry.seq - b.entry.seq);
}

function takenOutBy(seq: number, by: LogEntry | undefined): TakenOut {
  return { seq, whenS: by?.pushed_s ?? null, by: by?.id ?? null, token: by?.via ?? null, note: by?.note ?? "" };
}

/** Name of the author of a retract: a robot, or the token of the operator for whom the server made it. */
export function whoTookOut({ by, token }: TakenOut): string {
  const robot = by === null ? "" : robotOf(by);
  return token !== null && robot === "operator" ? `${token} (${robot})` : robot;
}
