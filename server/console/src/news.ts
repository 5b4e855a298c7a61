/** News: what changed since the page was opened, as lines that lead to the place.
 *
 *     live events, and findings that were not there before  -->  one line a happening, the newest first
 *
 * Many commits of one robot are one line that counts, and so is all that is taken out at a time. */

import { DISMISSED, SEEN, type Finding } from "./findings.ts";
import { robotOf } from "./log_book.ts";
import { authorOf, placeOf } from "./mark_book.ts";
import type { LiveEvent, LogEntry, MarkEntry, RobotSign, Triple } from "./messages.ts";
import { serverNowS } from "./server_time.ts";
import { counted } from "./units.ts";

/** Lines that are kept. */
const KEPT = 50;
/** A commit joins the line of the one before it for so long, s. */
const TOGETHER_S = 60;
/** A hottest voxel moves as more is measured: so near to a known one, a hot spot is no other, m. */
const SAME_M = 0.5;
/** Places of hot spots that are remembered at most. */
const PLACES_MAX = 1000;

/** Words of a robot's own note that say that it needs help. */
export const HELP = /\b(stuck|help|fault|error|lost|blocked|emergency|failed|fallen)\b/i;

export interface NewsItem {
  readonly timeS: number;
  readonly text: string;
  /** Finding that it is about, and place, m in the map; null: none. */
  readonly find: string | null;
  readonly place: Triple | null;
}

/** List of a map's hot spots, of which findings are made. */
export interface SpotList {
  /** The server looked through all of the map for what is warmer than `overC`. */
  readonly isComplete: boolean;
  /** Spots in the map, of which the first are listed: confirmed ones before others, the hottest of each first. */
  readonly total: number;
  readonly overC: number;
}

/** Line that counts commits, as long as more come. */
interface Streak {
  readonly item: NewsItem;
  readonly commits: number;
  /** Sum of the cells of each commit; several may be in one cell. */
  readonly cells: number;
  readonly robots: ReadonlySet<string>;
  /** Events left some commits out. */
  readonly isLeast: boolean;
}

/** Hot spots that are no news. */
interface KnownSpots {
  readonly places: readonly Triple[];
  /** Last one of a list that did not have all; null: the list had all. */
  readonly last: Finding | null;
}

export class NewsBook {
  items: readonly NewsItem[] = [];
  /** Lines that still count, by robot; that of all that is taken out has an empty name. */
  private readonly streaks = new Map<string, Streak>();
  /** Robots that are known, and what each said last. */
  private readonly notes = new Map<string, string>();
  /** Hot spots in complete lists of this threshold; null: none came yet. */
  private hot: KnownSpots | null = null;
  private overC = NaN;

  hear(event: LiveEvent): void {
    if (event.type === "hello") for (const { branch, status } of event.robots) this.notes.set(branch, status?.note ?? "");
    else if (event.type === "log") for (const entry of event.entries) this.entered(entry, event.left_out > 0);
    else if (event.type === "marks" && event.marks !== "many") for (const entry of event.marks) this.marked(entry);
    else if (event.type === "robot") this.signed(event.robot);
  }

  /** Take findings as they are now, and the list that their hot spots are of. */
  look(findings: readonly Finding[], { isComplete, total, overC }: SpotList): void {
    if (overC !== this.overC) this.hot = null; // the first list is no news, nor is one of another threshold
    this.overC = overC;
    if (!isComplete) return;
    const spots = findings.filter(({ spot }) => spot);
    const known = this.hot;
    const isAt = (places: readonly Triple[], at: Triple) => places.some((one) => Math.hypot(...one.map((value, n) => value - at[n])) < SAME_M);
    const places = spots.map(({ place }) => place);
    const hasAll = spots.length >= total || spots.length === 0;
    this.hot = {
      // Some that are known may be in the map still, after the last one that is listed.
      places: hasAll ? places : [...places, ...(known?.places ?? []).filter((at) => !isAt(places, at))].slice(0, PLACES_MAX),
      last: hasAll ? null : spots.reduce((last, one) => (isBefore(last, one) ? one : last)),
    };
    if (!known) return;
    for (const one of spots) {
      if (one.state !== "new" || isAt(known.places, one.place)) continue;
      // A spot that moved up because another one went was in the map before.
      if (known.last && !isBefore(one, known.last)) continue;
      const words = known.last ? `Hot spot now among the first ${spots.length}` : "New hot spot";
      this.add(`${words}, ${one.celsius!.toFixed(1)} °C`, one.place, one.id);
    }
  }

  /** `isShort`: the event left out others. */
  private entered({ kind, id, cells, place_m }: LogEntry, isShort: boolean): void {
    if (!cells) return; // marks, and retracts, whose effects have entries of their own
    const isOut = kind === "-";
    const key = isOut ? "" : robotOf(id);
    const last = this.streaks.get(key);
    const before = last && serverNowS() - last.item.timeS < TOGETHER_S ? last : undefined;
    if (before) this.items = this.items.filter((item) => item !== before.item);
    const streak = {
      commits: 1 + (before?.commits ?? 0), cells: cells + (before?.cells ?? 0), robots: new Set([...(before?.robots ?? []), robotOf(id)]),
      isLeast: isShort || before?.isLeast === true,
    };
    const item = this.add(isOut ? outWords(streak) : mappedWords(streak), place_m ?? before?.item.place ?? null);
    this.streaks.set(key, { ...streak, item });
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

/** True where a spot stands before another one in the server's list. */
function isBefore(one: Finding, other: Finding): boolean {
  const [a, b] = [one.spot!, other.spot!];
  return a.confirmed === b.confirmed ? a.celsius > b.celsius : a.confirmed;
}

function mappedWords({ commits, cells, robots, isLeast }: Omit<Streak, "item">): string {
  const [robot] = robots;
  if (isLeast) return `${robot} mapped: at least ${counted(commits, "commit", "commits")}`;
  return commits === 1 ? `${robot} mapped ${counted(cells, "cell", "cells")}` : `${robot} mapped: ${commits} commits, at most ${cells} cells`;
}

function outWords({ commits, robots, isLeast }: Omit<Streak, "item">): string {
  const whose = robots.size === 1 ? [...robots][0] : `${robots.size} robots`;
  if (isLeast) return `At least ${counted(commits, "commit", "commits")} of ${whose} taken out`;
  return commits === 1 ? `A commit of ${whose} was taken out` : `${commits} commits of ${whose} were taken out`;
}
