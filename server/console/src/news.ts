/** News: what changed since the page was opened, as lines that lead to the place.
 *
 *     live events, and findings that were not there before  -->  one line a happening, the newest first
 *
 * Many commits of one robot are one line that counts. */

import { DISMISSED, SEEN, type Finding } from "./findings.ts";
import { robotOf } from "./log_book.ts";
import { authorOf, placeOf } from "./mark_book.ts";
import type { LiveEvent, LogEntry, MarkEntry, RobotSign, Triple } from "./messages.ts";
import { serverNowS } from "./server_time.ts";
import { counted } from "./units.ts";

/** Lines that are kept. */
const KEPT = 50;
/** What one robot maps within this time of its last commit is one line, s. */
const TOGETHER_S = 60;
/** A hottest voxel moves as more is measured: so near to a known one, a hot spot is no other, m. */
const SAME_M = 0.5;

/** Words of a robot's own note that say that it needs help. */
export const HELP = /\b(stuck|help|fault|error|lost|blocked|emergency|failed|fallen)\b/i;

export interface NewsItem {
  readonly timeS: number;
  readonly text: string;
  /** Finding that it is about, and place, m in the map; null: none. */
  readonly find: string | null;
  readonly place: Triple | null;
}

/** A robot's line that still counts. */
interface Mapping {
  readonly item: NewsItem;
  readonly commits: number;
  readonly cells: number;
}

export class NewsBook {
  items: readonly NewsItem[] = [];
  private readonly mapping = new Map<string, Mapping>();
  /** Robots that are known, and what each said last. */
  private readonly notes = new Map<string, string>();
  /** Hot spots that are known; null: none was listed yet. */
  private hot: Triple[] | null = null;

  hear(event: LiveEvent): void {
    if (event.type === "hello") for (const { branch, status } of event.robots) this.notes.set(branch, status?.note ?? "");
    else if (event.type === "log") for (const entry of event.entries) this.entered(entry);
    else if (event.type === "marks" && event.marks !== "many") for (const entry of event.marks) this.marked(entry);
    else if (event.type === "robot") this.signed(event.robot);
  }

  /** Findings as they are now; `isWhole`: all hot spots of the map above the threshold are among them. */
  look(findings: readonly Finding[], isWhole: boolean): void {
    if (!isWhole) this.hot = null; // the first list is no news, nor is one of another threshold
    if (!isWhole) return;
    const spots = findings.filter(({ spot }) => spot);
    const known = this.hot;
    this.hot = spots.map(({ place }) => place);
    if (!known) return;
    for (const { id, place, celsius, state } of spots) {
      const isKnown = known.some((one) => Math.hypot(...one.map((value, n) => value - place[n])) < SAME_M);
      if (state === "new" && !isKnown) this.add(`New hot spot, ${celsius!.toFixed(1)} °C`, place, id);
    }
  }

  private entered({ kind, id, cells, place_m }: LogEntry): void {
    if (!cells) return; // marks, and retracts, whose effects have entries of their own
    const robot = robotOf(id);
    if (kind === "-") return void this.add(`A commit of ${robot} was taken out`, place_m);
    const before = this.mapping.get(robot);
    const isOn = before && serverNowS() - before.item.timeS < TOGETHER_S;
    const [commits, all] = isOn ? [before.commits + 1, before.cells + cells] : [1, cells];
    if (isOn) this.items = this.items.filter((item) => item !== before.item);
    const words = commits === 1 ? `${robot} mapped ${counted(all, "cell", "cells")}` : `${robot} mapped: ${commits} commits, ${all} cells`;
    this.mapping.set(robot, { item: this.add(words, place_m), commits, cells: all });
  }

  private marked(entry: MarkEntry): void {
    const { mark, key, amends } = entry;
    const author = authorOf(entry);
    const said = mark.kind === SEEN ? `${author} has seen the hot spot of ${mark.name}` : mark.kind === DISMISSED ? `${author} dismissed the hot spot of ${mark.name}`
      : amends?.length ? `${author} changed “${mark.name}”` : `${author} marked “${mark.name}”`;
    const isWord = mark.kind === SEEN || mark.kind === DISMISSED;
    this.add(said, placeOf(entry), isWord ? null : `mark ${key}`);
  }

  private signed({ branch, gone, status }: RobotSign): void {
    const note = status?.note ?? "";
    const before = this.notes.get(branch);
    const place = status?.pose?.t_map_rig ?? null;
    if (gone) this.notes.delete(branch);
    else this.notes.set(branch, note);
    if (gone) this.add(`${branch} left the team`, null);
    else if (before === undefined) this.add(`${branch} joined`, place);
    if (!gone && HELP.test(note) && note !== before) this.add(`${branch}: ${note}`, place);
  }

  private add(text: string, place: Triple | null, find: string | null = null): NewsItem {
    const item = { timeS: serverNowS(), text, find, place };
    this.items = [item, ...this.items].slice(0, KEPT);
    return item;
  }
}
