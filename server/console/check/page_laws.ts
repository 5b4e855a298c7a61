/** Laws of the page's modules that need no browser, for a test: what breaks one is printed; sizes of the pictures that are named, too. */

import { readFileSync } from "node:fs";
import { ApiError, type Api } from "../src/api.ts";
import { classColours, classOf, unsureColour } from "../src/class_colours.ts";
import type { Finding } from "../src/findings.ts";
import { HotSpotList } from "../src/hot_spot_list.ts";
import { fromHash, POINTS_MAX, toHash } from "../src/look.ts";
import type { LiveEvent, LogEntry, MapInfo } from "../src/messages.ts";
import { NewsBook } from "../src/news.ts";
import { sizeOf } from "../src/picture_size.ts";
import { SLACK, StandingPlan } from "../src/scene/detail.ts";
import { HELD_MAX, Timeline } from "../src/timeline.ts";

const wrong: string[] = [];
const law = (what: string, holds: boolean) => void (holds || wrong.push(what));
let state = 7;
/** Mulberry32. */
const random = () => {
  state = (state + 0x6d2b79f5) | 0;
  let t = Math.imul(state ^ (state >>> 15), 1 | state);
  t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
  return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
};

/** An entry of the log; one without a time of capture is a retract of nothing that is known. */
function entry(seq: number, capturedS: number | null): LogEntry {
  const captured = capturedS === null ? null : [capturedS - 1, capturedS];
  const one = { seq, id: `r.${seq}`, kind: "+", captured_s: captured, pushed_s: 100 + seq, place_m: null, cells: captured ? 1 : 0, retracts: captured ? [] : ["x.1"], note: "" };
  return one as unknown as LogEntry;
}

for (let round = 0; round < 50; round++) {
  const times = Array.from({ length: Math.floor(random() * 40) }, () => (random() < 0.2 ? null : 1000 + Math.floor(random() * 60)));
  const timeline = new Timeline(null);
  timeline.add(times.map((timeS, n) => entry(n + 1, timeS)));
  const captured = times.filter((timeS) => timeS !== null);
  for (let timeS = 990; timeS < 1070; timeS += 0.5) {
    const before = captured.filter((one) => one <= timeS);
    const atS = before.length ? Math.max(...before) : timeS;
    law("a time's moment is the last commit before it", timeline.momentAt(timeS).atS === atS && timeline.momentAt(timeS).key === String(atS));
  }
  const distinct = [...new Set(captured)].sort((a, b) => a - b);
  law("each time of capture is one moment", timeline.moments.map(({ atS }) => atS).join() === distinct.join());
  timeline.add([entry(1000, 5000)]);
  law("a new commit is a moment", timeline.moments.at(-1)?.atS === 5000 && timeline.momentAt(6000).atS === 5000);
}

const far = new Timeline(null);
const run = (from: number, to: number) => Array.from({ length: to - from + 1 }, (_, n) => entry(from + n, from + n));
const isWhole = () => far.lastSeq - far.firstSeq + 1 === far.entries.size;
const head = 2 * HELD_MAX;
far.add(run(HELD_MAX + 1, head));
far.add([entry(head + 1, head + 1)]);
law("of too many entries the oldest go first", far.firstSeq === HELD_MAX + 2 && far.lastSeq === head + 1 && isWhole());
far.add(run(HELD_MAX - 999, HELD_MAX + 1), true);
law("reading back forgets the newest", far.firstSeq === HELD_MAX - 999 && isWhole());
far.add(run(head + 2, head + 3));
law("an event leaves no hole before it", isWhole());
while (far.lastSeq < head + 3) far.add(run(far.lastSeq + 1, Math.min(far.lastSeq + 1000, head + 3)));
law("what was forgotten is read again, and events join it", far.lastSeq === head + 3 && isWhole());

for (const text of ["1e20", "-1e20", "1e12", "NaN", "Infinity", "", " ", "1,2"]) {
  const { look } = fromHash(`#map=a&at=${text}&since=${text}`);
  law(`#at=${text} is no time`, look.atS === null && look.sinceS === null);
}
law("a time of this century is one", fromHash("#map=a&at=1760000040.5").look.atS === 1760000040.5);

const points = (count: number) => Array.from({ length: count }, (_, n) => [n, -n / 8, 0.125] as [number, number, number]);
for (const count of [0, 1, 3, POINTS_MAX]) {
  const { look } = fromHash("#map=a");
  look.points = points(count);
  law("an address has all points of a measure", JSON.stringify(fromHash(toHash("a", look, null)).look.points) === JSON.stringify(points(count)));
}
for (const text of ["1,2", "1,,2", "1,2,x", "1,2,NaN", "1,2,1e999", points(POINTS_MAX + 1).flat().join()]) law(`points=${text} are none`, fromHash(`#map=a&points=${text}`).look.points.length === 0);

const standing = new StandingPlan();
const room = 1000;
const isKept = (view: string, drawn = 0) => !standing.isDue(view, drawn, room);
law("without a plan depths are chosen", !isKept("a"));
standing.note(true);
law("at now depths follow what comes", !isKept("a"));
standing.keep();
law("depths that were chosen for now are kept at other moments while the eye rests", isKept("a", SLACK * room) && !isKept("b"));
law("depths at which more is drawn than there is room for are not kept", isKept("a") && !isKept("a", SLACK * room + 1));
standing.note(false);
standing.keep();
law("depths that were chosen for a past moment are kept at no other", !isKept("a"));
standing.note(true);
standing.keep();
standing.release();
law("depths are chosen again where cells changed", !isKept("a"));

const news = new NewsBook();
const hear = (event: object) => news.hear(event as LiveEvent);
const texts = () => news.items.map(({ text }) => text).join("; ");
const sign = (branch: string, note: string, gone = false) => ({ branch, gone, status: { note, pose: null } });
hear({ type: "hello", robots: [sign("r", "maps")] });
hear({ type: "robot", robot: sign("r", "still maps") });
law("who is there already, and goes on, is no news", texts() === "");
hear({ type: "robot", robot: sign("r", "stuck at stairs") });
hear({ type: "robot", robot: sign("r", "stuck at stairs") });
hear({ type: "robot", robot: sign("q", "") });
hear({ type: "robot", robot: sign("q", "", true) });
law("who joins, leaves or needs help is news, once", texts() === "q left the team; q joined; r: stuck at stairs");
const enter = (entries: object[], leftOut = 0) => hear({ type: "log", entries, left_out: leftOut });
enter([{ ...entry(1, 1), cells: 3 }, { ...entry(2, null) }]);
law("a commit is one line, and what has no cells none", texts().startsWith("r mapped 3 cells; q left"));
enter([{ ...entry(3, 3), cells: 2 }]);
law("commits of a robot in a row are one line, and may have cells in common", texts().startsWith("r mapped: 2 commits, at most 5 cells; q left"));
enter([{ ...entry(4, 3), kind: "-" }]);
law("what is taken out is news", texts().startsWith("A commit of r was taken out; r mapped"));
const lines = news.items.length;
enter(Array.from({ length: 49 }, (_, n) => ({ ...entry(5 + n, 3), kind: "-", place_m: n ? null : [1, 2, 3] })));
law("what is taken out at a time is one line", texts().startsWith("50 commits of r were taken out; r mapped") && news.items.length === lines);
law("a line leads to the last place that is known", news.items[0]?.place?.join() === "1,2,3");
enter([{ ...entry(60, 3), kind: "-", id: "q.1" }, { ...entry(61, 3), id: "q.2" }], 7);
law("a line says whose commits it counts, and that there are more", texts().startsWith("q mapped: at least 1 commit; At least 51 commits of 2 robots taken out; r mapped"));
/** Findings of hot spots at these places along x; the first is the hottest, 40 °C. */
const hot = (...places: number[]) => places.map((x, n) => {
  const celsius = 40 - n;
  return { id: `spot ${x}`, state: "new", spot: { celsius, confirmed: true }, celsius, place: [x, 0, 0] } as unknown as Finding;
});
const list = (overC: number, total = 0, isComplete = true) => ({ isComplete, total, overC });
let before = news.items.length;
/** Number of new lines. */
const newLines = () => -before + (before = news.items.length);
news.look(hot(1), list(30));
news.look(hot(1.3), list(30));
law("a hot spot that was there, or moved a little, is no news", newLines() === 0);
news.look(hot(1.3, 5), list(30));
law("another one is, with its place", newLines() === 1 && news.items[0]?.text === "New hot spot, 39.0 °C" && news.items[0]?.find === "spot 5");
news.look([], list(30, 0, false));
news.look(hot(1.3, 5), list(30));
law("a list that broke off makes no old hot spot news", newLines() === 0);
news.look(hot(1.3), list(30, 1, false));
news.look(hot(1.3, 5, 7), list(30));
law("a new hot spot is news also after a list that broke off", newLines() === 1 && news.items[0]?.find === "spot 7");
news.look(hot(1.3, 5, 7, 9), list(25, 4, false));
news.look(hot(1.3, 5, 7, 9), list(25));
law("a list of another threshold is no news", newLines() === 0);
news.look(hot(1.3, 5, 7, 11), list(25, 5));
law("after all were listed another one is new, also where the list has the first alone", newLines() === 1 && news.items[0]?.text === "New hot spot, 37.0 °C");
news.look(hot(1.3, 5, 7, 9), list(25, 5));
news.look(hot(1.7, 5, 7, 11), list(25, 5));
news.look(hot(2.1, 5, 7, 11), list(25, 5));
law("a hot spot that comes back into the first, or moves on little by little, is no news", newLines() === 0);
news.look(hot(2.1, 5, 11, 13), list(25, 5));
law("one that moved up because another one went is no news", newLines() === 0);
news.look(hot(17, 2.1, 5, 11), list(25, 6));
law("one that comes before the last of the first is news", newLines() === 1 && news.items[0]?.text === "Hot spot now among the first 4, 40.0 °C");

/** Completeness of the list after each answer of a server; another threshold is asked for at once. */
async function completeAfter(...answers: (boolean | ApiError)[]): Promise<boolean[]> {
  const left = [...answers];
  const json = async () => {
    const complete = left.shift()!;
    if (complete instanceof ApiError) throw complete;
    return { complete, spots: [], total: 0 };
  };
  const info = { name: "m", geometry: { channels: [{ kind: "temperature" }] } } as unknown as MapInfo;
  const spots = new HotSpotList({ json } as unknown as Api, info, 30);
  const found: boolean[] = [];
  for (const n of answers.keys()) {
    const isHeard = new Promise<void>((resolve) => (spots.onChange = resolve));
    spots.setThreshold(31 + n);
    spots.tick();
    await isHeard;
    found.push(spots.isComplete);
  }
  return found;
}
const refused = new ApiError(400, "too_costly", "");
law("no list is complete that broke off or was refused", (await completeAfter(true, false, true, refused, true)).join() === "true,false,true,false,true");
for (let n = 0; n < 100; n++) hear({ type: "robot", robot: sign(`s${n}`, "") });
law("news are bounded", news.items.length === 50);

const classes = classColours(64);
law("a class is told by its colour, and by its paler one", classes.every((colour, n) => classOf(colour, 64)?.number === n && classOf(unsureColour(colour), 64)?.number === n));

console.log(JSON.stringify({ classes, pale: classes.map(unsureColour), wrong: [...new Set(wrong)], sizes: process.argv.slice(2).map((path) => sizeOf(new Uint8Array(readFileSync(path)))) }));
