/** Findings: what operators look after, hot spots and marks, in one order with one number each.
 *
 * What people said of a hot spot is a mark of theirs around it, so that all screens, robots and servers have it:
 *
 *     hot_spot_seen, hot_spot_dismissed    looked at; no finding. Its name is the temperature that it was said of.
 *     hot_spot, or any other kind          the spot is that mark from then on
 *
 * A word counts while the spot's hottest voxel lies in the mark's box, and until it is `HOTTER_K` warmer than it was
 * said of: a lamp that was dismissed and burns is new. */

import { robotOf } from "./log_book.ts";
import { authorOf, boxOf, placeOf } from "./mark_book.ts";
import type { HotSpot, MarkEntry, MarkText, Triple } from "./messages.ts";
import { clock } from "./units.ts";

export const SEEN = "hot_spot_seen";
export const DISMISSED = "hot_spot_dismissed";
export const HOT_SPOT = "hot_spot";
/** Warmer by so much than what people said of it, a spot is new; K. */
export const HOTTER_K = 10;
/** A hottest voxel moves as more is measured: a mark's box counts so much beyond its faces; m. */
const SLACK_M = 0.25;

export type State = "new" | "seen" | "dismissed" | "mark";

export interface Finding {
  /** Id that stays the same as long as the thing does. */
  readonly id: string;
  readonly number: number;
  readonly state: State;
  readonly title: string;
  readonly place: Triple;
  /** Lowest and highest corner, m. */
  readonly box: [Triple, Triple];
  readonly celsius: number | null;
  readonly spot: HotSpot | null;
  /** The mark that it is, or in which people said of the spot what its state tells. */
  readonly entry: MarkEntry | null;
}

type Unnumbered = Omit<Finding, "number">;

/** New hot spots, marks, spots that were seen, spots that were dismissed; each group's first is its hottest or newest. */
export function findingsOf(spots: readonly HotSpot[], marks: readonly MarkEntry[]): Finding[] {
  const taken = new Set<string>();
  const ofHeat = marks.filter(({ mark }) => mark.kind === HOT_SPOT || isWord(mark.kind));
  const ofSpots = spots.map((spot): Unnumbered => {
    const around = ofHeat.filter((entry) => holds(entry, spot.point_m));
    const marked = around.find(({ key, mark }) => mark.kind === HOT_SPOT && !taken.has(key));
    const word = around.find(({ mark }) => isWord(mark.kind));
    const isOld = word && spot.celsius > celsiusOf(word) + HOTTER_K;
    const entry = marked ?? (isOld ? undefined : word);
    if (marked) taken.add(marked.key);
    const state: State = marked ? "mark" : !entry ? "new" : entry.mark.kind === SEEN ? "seen" : "dismissed";
    return {
      id: marked ? `mark ${marked.key}` : `spot ${spot.voxel.join(",")}`, state, entry: entry ?? null, spot,
      title: marked?.mark.name ?? "Hot spot", place: spot.point_m, box: [spot.low_m, spot.high_m], celsius: spot.celsius,
    };
  });
  const ofMarks = marks.filter(({ key, mark }) => !isWord(mark.kind) && !taken.has(key)).map((entry): Unnumbered => ({
    id: `mark ${entry.key}`, state: "mark", entry, spot: null, title: entry.mark.name, place: placeOf(entry), box: boxOf(entry),
    celsius: null,
  }));
  const all = [...ofSpots, ...ofMarks];
  const order: State[] = ["new", "mark", "seen", "dismissed"];
  return order.flatMap((state) => all.filter((one) => one.state === state)).map((one, n) => ({ ...one, number: n + 1 }));
}

/** A person's word about a spot, as a mark around it. */
export function wordOf(spot: HotSpot, kind: typeof SEEN | typeof DISMISSED): MarkText {
  return { kind, name: `${spot.celsius.toFixed(1)} °C`, ...boxText(spot) };
}

/** All that people said of a spot: two may have spoken at the same moment. */
export function wordsAround(spot: HotSpot, marks: readonly MarkEntry[]): MarkEntry[] {
  return marks.filter((entry) => isWord(entry.mark.kind) && holds(entry, spot.point_m));
}

/** First text of a new mark of a spot. */
export function markOfSpot(spot: HotSpot): MarkText {
  return { kind: HOT_SPOT, name: `Hot spot, ${spot.celsius.toFixed(1)} °C`, ...boxText(spot) };
}

/** Place over the floor, size, who and when: one line. */
export function factsOf({ spot, entry, state }: Finding): string {
  const parts: string[] = [];
  if (spot) {
    if (spot.over_floor_m !== null) parts.push(`${spot.over_floor_m.toFixed(1)} m over the floor`);
    parts.push(`${spot.voxels} voxel${spot.voxels === 1 ? "" : "s"}`);
    if (!spot.confirmed) parts.push("perhaps a ghost");
    if (spot.commit) parts.push(`by ${robotOf(spot.commit)}`);
    const timeS = spot.captured_s?.[1] ?? spot.measured_s;
    if (timeS !== undefined) parts.push(clock(timeS));
  }
  if (entry) {
    const said = state === "mark" ? entry.mark.kind.replaceAll("_", " ") : state;
    parts.push(`${said} by ${authorOf(entry)}, ${clock(entry.mark.time_ms / 1000)}`);
  }
  return parts.join(" · ");
}

function boxText({ low_m, high_m }: HotSpot): Pick<MarkText, "place_m" | "extent_m"> {
  return {
    place_m: low_m.map((low, n) => (low + high_m[n]) / 2) as Triple, extent_m: low_m.map((low, n) => high_m[n] - low) as Triple,
  };
}

function isWord(kind: string): boolean {
  return kind === SEEN || kind === DISMISSED;
}

function holds(entry: MarkEntry, point: Triple): boolean {
  const [low, high] = boxOf(entry);
  return point.every((each, n) => each >= low[n] - SLACK_M && each <= high[n] + SLACK_M);
}

/** Temperature that a word was said of; without a number, of any. */
function celsiusOf({ mark }: MarkEntry): number {
  const found = /^(-?\d+(?:\.\d+)?) °C$/.exec(mark.name);
  return found ? Number(found[1]) : Infinity;
}
