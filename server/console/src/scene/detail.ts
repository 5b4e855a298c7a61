/** Octree depths at which cells are shown: coarse everywhere first, finer where the eye is, within a budget.
 *
 *     one node a side  -->  all of the map coarsely  -->  the largest nodes of the picture finer  -->  what is finer already stays
 *
 * Only where not even the coarsest picture of all cells has room, the farthest are left out. What is shown now counts in the
 * last step alone, and that one cannot undo itself: a plan made again of its own answer is the same, so a map at rest asks
 * for nothing. Surfaces have some 4.4 times as many nodes a depth further. Where a cell's nodes were counted at one depth,
 * other depths are guessed from it. */

export const GROWTH = 4.4;
/** Size of a node below which no eye sees finer ones, px. */
const NODE_PX = 1.6;
/** A picture may hold so much more before cells are made coarser again, so that it does not flicker between two depths. */
export const SLACK = 1.15;
/** Depths above the voxels at which everything is shown first. */
export const COARSE = 3;
const COARSEST = 1;

export interface Candidate {
  /** Nodes counted by depth; undefined: not yet. */
  readonly counts: readonly (number | undefined)[];
  readonly depthMax: number;
  /** Size of the cell in the picture at distance of its nearest point, px; 0: outside of the picture. */
  readonly sizePx: number;
  /** Distance of its nearest point from the eye, m: of those outside of the picture the near ones come first. */
  readonly distanceM: number;
  /** Depth that is shown now; 0: nothing. */
  readonly shown: number;
}

/** Nodes of a cell at a depth, counted or guessed. */
export function expected(cell: Candidate, depth: number): number {
  const most = 8 ** depth;
  for (let off = 0; off <= cell.depthMax; off++) {
    const below = cell.counts[depth - off];
    if (below !== undefined) return off === 0 ? below : Math.min(below * GROWTH ** off, most);
    const above = cell.counts[depth + off];
    if (above !== undefined) return Math.min(Math.max(above / GROWTH ** off, Math.min(above, 1)), most);
  }
  return Math.min(60 * GROWTH ** (depth - 3), most);
}

/** Plan of depths that is kept at other moments: one that was made of the map as it is now, while the eye rests and what it draws has room.
 *
 * With a plan for each moment, some cells would be wanted at depths that they were not seen at before. A plan that was made of the
 * past is not kept: a cell that was empty costs nothing at its voxels, and may be full at another moment. */
export class StandingPlan {
  /** View of the last plan, and the one for which depths stay as they are; empty: none. */
  private view = "";
  private keptView = "";
  private isOfNow = false;

  /** Take over the eye's view; true: depths are to be chosen, as it is another one or more is drawn than there is room for. */
  isDue(view: string, drawn: number, budget: number): boolean {
    this.view = view;
    return view !== this.keptView || drawn > budget * SLACK;
  }

  /** Take note that depths were chosen; `isOfNow`: for the map as it is now. */
  note(isOfNow: boolean): void {
    this.keptView = "";
    this.isOfNow = isOfNow;
  }

  /** Keep the depths at another moment, if they were chosen for now. */
  keep(): void {
    if (this.isOfNow) this.keptView = this.view;
  }

  /** Let depths be chosen again: cells changed. */
  release(): void {
    this.keptView = "";
  }
}

/** A depth for each cell; 0: not shown, because not even its coarsest picture has room. */
export function plan(cells: readonly Candidate[], budget: number): number[] {
  const nearest = cells.map((_, n) => n).sort((a, b) => cells[b].sizePx - cells[a].sizePx || cells[a].distanceM - cells[b].distanceM);
  const depths = cells.map(() => 0);
  let total = 0;
  for (const n of nearest) {
    const more = expected(cells[n], COARSEST);
    if (total + more > budget) break; // all that is farther is left out, too
    depths[n] = COARSEST;
    total += more;
  }
  const grow = (n: number, depth: number, room: number): void => {
    const more = expected(cells[n], depth + 1) - expected(cells[n], depth);
    // A cell that has no room at one depth has none at the next.
    if (depths[n] !== depth || total + more > room) return;
    depths[n]++;
    total += more;
  };
  const there = nearest.filter((n) => depths[n] > 0);
  const first = (n: number) => Math.max(cells[n].depthMax - COARSE, COARSEST);
  const deepest = there.reduce((most, n) => Math.max(most, first(n)), 0);
  for (let depth = COARSEST; depth < deepest; depth++) for (const n of there) if (depth < first(n)) grow(n, depth, budget);
  // The largest nodes of the picture first.
  const steps = there.filter((n) => cells[n].sizePx > 0 && depths[n] >= first(n)).flatMap((n) =>
    Array.from({ length: cells[n].depthMax - depths[n] }, (_, k) => ({ n, depth: depths[n] + k, nodePx: cells[n].sizePx / 2 ** (depths[n] + k) })),
  );
  for (const { n, depth, nodePx } of steps.sort((a, b) => b.nodePx - a.nodePx)) {
    if (nodePx <= NODE_PX) break;
    grow(n, depth, budget);
  }
  // What is finer already stays so where it has room, whole or not at all.
  for (const n of there) {
    const more = expected(cells[n], cells[n].shown) - expected(cells[n], depths[n]);
    if (cells[n].shown <= depths[n] || total + more > budget * SLACK) continue;
    depths[n] = cells[n].shown;
    total += more;
  }
  return depths;
}
