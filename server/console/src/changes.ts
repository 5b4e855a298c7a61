/** What changed in a map between two moments: the server's answer, and the things that its voxels make together. */

import type { Triple } from "./messages.ts";

export const WAYS = ["appeared", "gone", "warmer", "colder", "moved"] as const;
export type Way = (typeof WAYS)[number];

interface CellVoxels {
  cell: Triple;
  centres_m: Triple[];
}

/** Answer to GET .../main/changes: PROTOCOL.md section 4.14. */
export type Changes = { cursor: string; since_s: number; until_s: number | null; counts: Record<Way, number> } & Record<Way, CellVoxels[]>;

/** Voxels that changed in one way and touch by faces, edges or corners. */
export interface ChangedThing {
  readonly way: Way;
  readonly voxels: number;
  readonly lowM: Triple;
  readonly highM: Triple;
  /** Centre of the voxel in the middle of them. */
  readonly placeM: Triple;
}

export function centresOf(changes: Changes, way: Way): Triple[] {
  return changes[way].flatMap(({ centres_m }) => centres_m);
}

/** The largest first; `size`: of a voxel, m. */
export function thingsOf(changes: Changes, size: Triple): ChangedThing[] {
  return WAYS.flatMap((way) => pieces(centresOf(changes, way), size).map((centres) => thing(way, centres, size))).sort((a, b) => b.voxels - a.voxels);
}

function thing(way: Way, centres: readonly Triple[], size: Triple): ChangedThing {
  const end = (pick: (...values: number[]) => number, sign: number) =>
    [0, 1, 2].map((axis) => centres.reduce((best, centre) => pick(best, centre[axis]!), -sign * Infinity) + (sign * size[axis]!) / 2) as Triple;
  const [lowM, highM] = [end(Math.min, -1), end(Math.max, 1)];
  const middle = lowM.map((low, axis) => (low + highM[axis]!) / 2);
  const awayM = (centre: Triple) => Math.hypot(...centre.map((value, axis) => value - middle[axis]!));
  const placeM = centres.reduce((best, centre) => (awayM(centre) < awayM(best) ? centre : best));
  return { way, voxels: centres.length, lowM, highM, placeM };
}

/** Connected pieces of voxels. */
function pieces(centres: readonly Triple[], size: Triple): Triple[][] {
  const numberOf = (centre: readonly number[], step = [0, 0, 0]) => centre.map((value, axis) => Math.floor(value / size[axis]!) + step[axis]!).join();
  const left = new Map(centres.map((centre) => [numberOf(centre), centre]));
  const steps = Array.from({ length: 27 }, (_, n) => [(n % 3) - 1, (Math.floor(n / 3) % 3) - 1, Math.floor(n / 9) - 1]);
  const found: Triple[][] = [];
  for (const [number, centre] of left) {
    left.delete(number);
    const piece = [centre];
    // The piece grows while it is walked through.
    for (const each of piece) {
      for (const step of steps) {
        const near = numberOf(each, step);
        const next = left.get(near);
        if (!next) continue;
        left.delete(near);
        piece.push(next);
      }
    }
    found.push(piece);
  }
  return found;
}
