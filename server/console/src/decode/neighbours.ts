/** Which leaf of an octree lies beside another: FORMAT.md section 14, "Neighbours". */

export const NONE = -1;
const AXIS = 0x09249249;
export const STEPS = [
  [-1, 0, 0], [0, -1, 0], [0, 0, -1],
  [-1, -1, 0], [-1, 0, -1], [0, -1, -1],
  [1, -1, 0], [1, 0, -1], [-1, 1, 0], [0, 1, -1], [-1, 0, 1], [0, -1, 1],
  [-1, -1, -1],
] as const;
/** What a neighbour counts: faces, edges, the corner. */
export const NEARNESS = Int32Array.of(4, 4, 4, 2, 2, 2, 2, 2, 2, 2, 2, 2, 1);
/** Those of STEPS that always come before: faces, lower edges, the corner. */
export const FACES = [0, 1, 2];
export const EDGES = [3, 4, 5, 12];

/** The place one step along an axis; NONE outside the cell or from NONE. */
export function stepped(place: number, axis: number, step: number, depth: number): number {
  if (step === 0 || place < 0) return place;
  const mask = (AXIS << axis) & ((1 << (3 * depth)) - 1);
  const own = place & mask;
  const rest = place & ~mask;
  if (step < 0) return own === 0 ? NONE : ((own - 1) & mask) | rest;
  return own === mask ? NONE : (((own | ~mask) + 1) & mask) | rest;
}

export function beside(place: number, step: number, depth: number): number {
  const [x, y, z] = STEPS[step];
  return stepped(stepped(stepped(place, 0, x, depth), 1, y, depth), 2, z, depth);
}

/** From places to leaves: a table for each brick of 8^3. */
export class LeafIndex {
  private readonly brickOf: Int32Array;
  private readonly leafOf: Int32Array;
  private readonly depth: number;

  constructor(starts: Uint32Array, sizes: Uint32Array, depth: number) {
    this.depth = depth;
    this.brickOf = new Int32Array(8 ** Math.max(depth - 3, 0)).fill(NONE);
    let tables = 0;
    for (let n = 0; n < starts.length; n++) {
      const brick = starts[n] >>> 9;
      if (sizes[n] >= 512) this.brickOf.fill(-2 - n, brick, brick + (sizes[n] >>> 9));
      else if (this.brickOf[brick] === NONE) this.brickOf[brick] = tables++;
    }
    this.leafOf = new Int32Array(tables * 512).fill(NONE);
    for (let n = 0; n < starts.length; n++) {
      if (sizes[n] >= 512) continue;
      const place = this.brickOf[starts[n] >>> 9] * 512 + (starts[n] & 511);
      this.leafOf.fill(n, place, place + sizes[n]);
    }
  }

  at(place: number): number {
    if (place < 0) return NONE;
    const table = this.brickOf[place >>> 9];
    if (table >= 0) return this.leafOf[table * 512 + (place & 511)];
    return table <= -2 ? -2 - table : NONE;
  }

  /** (S, 13) for each of the listed leaves the rows of those beside it that come before, in the order of STEPS. */
  earlierRows(starts: Uint32Array, leaves: Uint32Array): Int32Array {
    const rows = new Int32Array(leaves.length * STEPS.length).fill(NONE);
    const rowOf = new Int32Array(starts.length).fill(NONE);
    for (let s = 0; s < leaves.length; s++) {
      const place = starts[leaves[s]];
      for (let i = 0; i < STEPS.length; i++) {
        const leaf = this.at(beside(place, i, this.depth));
        if (leaf !== NONE) rows[s * STEPS.length + i] = rowOf[leaf];
      }
      rowOf[leaves[s]] = s;
    }
    return rows;
  }
}
