/** Plans of made maps, fed back as what is shown: node plan_rounds.ts SEED COUNT; one line of JSON a map. */

import { expected, plan, SLACK, type Candidate } from "../src/scene/detail.ts";

const ROUNDS = 4;
const [seed, maps] = process.argv.slice(2).map(Number);
let state = seed;
/** Mulberry32. */
const random = () => {
  state = (state + 0x6d2b79f5) | 0;
  let t = Math.imul(state ^ (state >>> 15), 1 | state);
  t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
  return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
};
const pick = (most: number) => Math.floor(random() * most);

/** A cell with some depths counted, rightly or not: what a server says need not grow with the depth. */
function cell(depthMax: number): Candidate {
  const counts: (number | undefined)[] = [];
  for (let depth = 1; depth <= depthMax; depth++) if (random() < 0.4) counts[depth] = pick(Math.min(8 ** depth, 20_000));
  return { counts, depthMax, sizePx: random() < 0.3 ? 0 : 2000 * random() ** 3, distanceM: 0.3 + 300 * random(), shown: pick(depthMax + 1) };
}

for (let map = 0; map < maps; map++) {
  const depthMax = 1 + pick(8);
  let cells = Array.from({ length: pick(400) }, () => cell(depthMax));
  const budget = 10 ** (1 + 5 * random());
  const sum = (depths: number[]) => depths.reduce((total, depth, n) => total + (depth ? expected(cells[n], depth) : 0), 0);
  const rounds: number[][] = [];
  for (let round = 0; round < ROUNDS; round++) {
    rounds.push(plan(cells, budget));
    cells = cells.map((one, n) => ({ ...one, shown: rounds[round][n] }));
  }
  const settled = rounds.findIndex((depths, n) => n > 0 && depths.join() === rounds[n - 1].join());
  const last = rounds[ROUNDS - 1];
  const coarsest = cells.reduce((total, one) => total + expected(one, 1), 0);
  console.log(JSON.stringify({
    settled, share: sum(last) / (budget * SLACK), left: last.filter((depth) => depth === 0).length, fits: coarsest <= budget,
    range: last.every((depth) => Number.isInteger(depth) && depth >= 0 && depth <= depthMax),
  }));
}
