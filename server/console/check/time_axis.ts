/** Random logs on the time axis, for a test: what breaks a law of `ui/time` is printed, and what was folded. */

import type { Commit } from "../src/timeline.ts";
import { APART_PX, clustersOf, densityOf } from "../src/ui/time/clusters.ts";
import { TimeScale } from "../src/ui/time/time_scale.ts";

const [first, count] = process.argv.slice(2).map(Number) as [number, number];
const WIDTH_PX = 900;

for (let seed = first; seed < first + count; seed++) {
  let state = seed;
  /** Mulberry32. */
  const random = () => {
    state = (state + 0x6d2b79f5) | 0;
    let t = Math.imul(state ^ (state >>> 15), 1 | state);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
  const length = 1 + Math.floor(random() * 400);
  // Pauses of all sizes, some of them none.
  const times: number[] = [];
  for (let timeS = 1.7e9; times.length < length; timeS += random() < 0.1 ? 0 : random() ** 3 * 10 ** (1 + 5 * (random() < 0.03 ? 1 : random() * 0.4))) times.push(timeS);
  const scale = new TimeScale(times);
  const places = times.map((timeS) => scale.place(timeS));
  const spanS = times[length - 1]! - times[0]!;
  const wrong: string[] = [];
  if (places.some((place) => !(place >= 0 && place <= 1 + 1e-9))) wrong.push("a place off the axis");
  if (places.some((place, n) => n > 0 && place < places[n - 1]! - 1e-12)) wrong.push("places that go back in time");
  if (times.some((timeS, n) => n > 0 && timeS > times[n - 1]! && places[n]! <= places[n - 1]!)) wrong.push("two times at one place");
  if (times.some((timeS, n) => Math.abs(scale.time(places[n]!) - timeS) > 1e-6 * Math.max(spanS, 1))) wrong.push("a place of another time");
  if (scale.folds.some(({ begin, end }) => places.some((place) => place > begin + 1e-9 && place < end - 1e-9))) wrong.push("a commit in a fold");
  if (scale.ticks(0, 1, 8).some((timeS) => timeS < times[0]! || timeS > times[length - 1]!)) wrong.push("a tick where nothing is");
  const commits = times.map((timeS, n) => ({ id: String(n), robot: `r${n % 3}`, timeS })) as unknown as Commit[];
  const xOf = ({ timeS }: Commit) => scale.place(timeS) * WIDTH_PX;
  const clusters = clustersOf(commits, xOf);
  const reached = new Set(clusters.flatMap(({ commits: inside }) => inside.map(({ id }) => id)));
  if (reached.size !== length || clusters.reduce((sum, { commits: inside }) => sum + inside.length, 0) !== length) wrong.push("a commit that no mark reaches, or two");
  for (const robot of ["r0", "r1", "r2"]) {
    const firsts = clusters.filter((cluster) => cluster.robot === robot).map(({ commits: inside }) => xOf(inside[0]!));
    if (firsts.some((x, n) => n > 0 && x - firsts[n - 1]! < APART_PX - 1e-9)) wrong.push("marks on each other");
  }
  const dense = densityOf(commits, (commit) => Math.min(scale.place(commit.timeS), 1 - 1e-9), 100).reduce((a, b) => a + b, 0);
  if (dense !== length) wrong.push("commits that are not counted");
  console.log(JSON.stringify({ seed, length, wrong, folds: scale.folds.length, marks: clusters.length, foldedS: scale.folds.reduce((a, { lengthS }) => a + lengthS, 0), spanS }));
}
