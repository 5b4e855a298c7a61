/** Which octree depth each cell is shown at: coarse everywhere first, finer where the eye is, within a budget.
 *
 * Surfaces have some 4.4 times as many nodes a depth further. Where a cell's nodes were counted at one depth, other
 * depths are guessed from it. */

export const GROWTH = 4.4;
/** Finer than this nobody sees, px. */
const NODE_PX = 1.6;
/** A picture may hold so much more before cells are made coarser again, so that it does not flicker between two depths. */
const SLACK = 1.15;
/** Depths above the voxels at which everything is shown first. */
export const COARSE = 3;

export interface Candidate {
  /** Nodes counted by depth; undefined: not yet. */
  readonly counts: readonly (number | undefined)[];
  readonly depthMax: number;
  /** Size of the cell in the picture at distance of its nearest point, px; 0: outside of the picture. */
  readonly sizePx: number;
  /** Depth that is shown now; 0: nothing. */
  readonly shown: number;
}

/** Nodes of a cell at a depth, counted or guessed. */
export function expected(cell: Candidate, depth: number): number {
  for (let off = 0; off <= cell.depthMax; off++) {
    const below = cell.counts[depth - off];
    if (below !== undefined) return below * GROWTH ** off;
    const above = cell.counts[depth + off];
    if (above !== undefined) return above / GROWTH ** off;
  }
  return 60 * GROWTH ** (depth - 3);
}

/** A depth for each cell; 0: not shown, because not even its coarsest picture has room. */
export function plan(cells: readonly Candidate[], budget: number): number[] {
  const room = cells.reduce((sum, cell) => sum + expected(cell, cell.shown), 0) > budget * SLACK ? budget : budget * SLACK;
  const nearest = cells.map((_, n) => n).sort((a, b) => cells[b].sizePx - cells[a].sizePx);
  const depths = cells.map(() => 0);
  let total = 0;
  for (const n of nearest) {
    const depth = Math.max(cells[n].depthMax - COARSE, 1);
    const more = expected(cells[n], depth);
    if (total + more > room) continue;
    depths[n] = depth;
    total += more;
  }
  // The largest nodes of the picture first. A cell that has no room at one depth has none at the next.
  const steps = nearest.filter((n) => depths[n] > 0 && cells[n].sizePx > 0).flatMap((n) =>
    Array.from({ length: cells[n].depthMax - depths[n] }, (_, k) => ({ n, depth: depths[n] + k, nodePx: cells[n].sizePx / 2 ** (depths[n] + k) })),
  );
  for (const { n, depth, nodePx } of steps.sort((a, b) => b.nodePx - a.nodePx)) {
    if (nodePx <= NODE_PX) break;
    const more = expected(cells[n], depth + 1) - expected(cells[n], depth);
    if (depths[n] !== depth || total + more > room) continue;
    depths[n]++;
    total += more;
  }
  return depths;
}
