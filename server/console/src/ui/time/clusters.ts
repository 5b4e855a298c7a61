/** Commits that would lie on each other on the axis, as one mark with their number. */

import type { Commit } from "../../timeline.ts";

export interface Cluster {
  readonly robot: string;
  /** Px from the axis's begin: the middle of its commits. */
  readonly x: number;
  readonly commits: readonly Commit[];
}

/** Marks of each robot are so far from each other at least, px. */
export const APART_PX = 15;

/** `commits` rising in time, `xOf` rising with it. */
export function clustersOf(commits: readonly Commit[], xOf: (commit: Commit) => number): Cluster[] {
  const open = new Map<string, { firstX: number; lastX: number; commits: Commit[] }>();
  const found: Cluster[] = [];
  const close = (robot: string) => {
    const { firstX, lastX, commits: inside } = open.get(robot)!;
    found.push({ robot, x: (firstX + lastX) / 2, commits: inside });
  };
  for (const commit of commits) {
    const x = xOf(commit);
    const before = open.get(commit.robot);
    if (before && x - before.firstX < APART_PX) {
      before.commits.push(commit);
      before.lastX = x;
      continue;
    }
    if (before) close(commit.robot);
    open.set(commit.robot, { firstX: x, lastX: x, commits: [commit] });
  }
  for (const robot of open.keys()) close(robot);
  return found.sort((a, b) => a.x - b.x || (a.robot < b.robot ? -1 : 1));
}

/** Commits by place: how many lie in each of `bins` equal parts of the axis. */
export function densityOf(commits: readonly Commit[], placeOf: (commit: Commit) => number, bins: number): Uint32Array {
  const counts = new Uint32Array(bins);
  for (const commit of commits) {
    const at = Math.floor(placeOf(commit) * bins);
    if (at >= 0 && at < bins) counts[at] = counts[at]! + 1;
  }
  return counts;
}
