/** A cell's octree from its modelled masks: FORMAT.md sections 4 and 14, "Masks". */

import { DamagedError, Decoder } from "./arithmetic.ts";
import { Mixer } from "./mixing.ts";
import { beside, EDGES, FACES, NONE, stepped } from "./neighbours.ts";

const ABSENT = 0;
const INNER = 1;
const LEAF = 2;
const SIBLING = 3;
const FACE_TABLE = 27 * 64;
const EDGE_TABLE = 81 * 27;
const FAMILY_TABLE = 256 * 27 * 8;
const GROUPS = 4;

export interface Leaves {
  /** First place and number of places of each leaf, in Morton order. */
  readonly starts: Uint32Array;
  readonly sizes: Uint32Array;
}

/** The leaves that `childCount` and `leafCount` masks describe. */
export function readOctree(data: Uint8Array, childCount: number, leafCount: number, N: number, depth: number): Leaves {
  const decoder = new Decoder(data);
  const starts = new Uint32Array(N);
  const sizes = new Uint32Array(N);
  const mixer = new Mixer(3, 2 * GROUPS, GROUPS * 2 * (FACE_TABLE + EDGE_TABLE + FAMILY_TABLE));
  const states = new Uint8Array((8 ** (depth + 1) - 1) / 7);
  states[0] = INNER;
  const keys = new Uint32Array(childCount + 1);
  let first = 0;
  let last = Math.min(1, childCount);
  let masks = 0;
  let leafMasks = 0;
  let leaves = 0;
  let offset = 0;
  for (let d = 0; d < depth; d++) {
    const isLast = d === depth - 1;
    const group = Math.min(depth - 1 - d, GROUPS - 1);
    const shift = 3 * (depth - 1 - d);
    const below = offset + 8 ** d;
    let found = last;
    for (let n = first; n < last; n++) {
      if (masks >= childCount || (!isLast && leafMasks >= leafCount)) throw new DamagedError("masks are missing");
      masks++;
      if (!isLast) leafMasks++;
      const key = keys[n];
      const upper = [0, 1, 2].map((axis) => stateOf(states, offset, stepped(key, axis, 1, d), d));
      let children = 0;
      for (let c = 0; c < 8; c++) {
        const child = 8 * key + c;
        contextsInto(mixer.contexts, states, below, child, d + 1, upper, children, group);
        if (!mixer.bit(decoder, 0, 2 * group)) continue;
        const leaf = isLast ? 1 : mixer.bit(decoder, 1, 2 * group + 1);
        children |= 1 << c;
        states[below + child] = leaf ? LEAF : INNER;
        if (leaf) {
          if (leaves >= N) throw new DamagedError("more leaves than the head names");
          starts[leaves] = child << shift;
          sizes[leaves++] = 1 << shift;
        } else {
          if (found >= keys.length) throw new DamagedError("masks are missing");
          keys[found++] = child;
        }
      }
      if (children === 0) throw new DamagedError("an empty mask");
    }
    first = last;
    last = found;
    offset = below;
  }
  mixer.done();
  decoder.finish();
  if (leaves !== N || masks !== childCount || leafMasks !== leafCount) {
    throw new DamagedError("the octree has other numbers of masks or leaves than the head names");
  }
  return inOrder({ starts, sizes });
}

/** Leaves come depth by depth; what follows wants them in Morton order. */
function inOrder({ starts, sizes }: Leaves): Leaves {
  let sorted = true;
  for (let n = 1; n < starts.length && sorted; n++) sorted = starts[n] > starts[n - 1];
  if (sorted) return { starts, sizes };
  // A size is a power of eight, to 8^8, and a place has at most 24 bits: one double holds both.
  const keys = Float64Array.from(starts, (start, n) => start * 16 + Math.log2(sizes[n]) / 3);
  keys.sort();
  return {
    starts: Uint32Array.from(keys, (key) => Math.floor(key / 16)),
    sizes: Uint32Array.from(keys, (key) => 1 << (3 * (key % 16))),
  };
}

function contextsInto(
  contexts: Int32Array, states: Uint8Array, offset: number, child: number, depth: number, upper: number[],
  before: number, group: number,
): void {
  let faces = 0;
  let edges = 0;
  for (const i of FACES) faces = 3 * faces + stateOf(states, offset, beside(child, i, depth), depth);
  for (const i of EDGES) edges = 3 * edges + stateOf(states, offset, beside(child, i, depth), depth);
  let near = faces;
  let above = 0;
  for (let axis = 0; axis < 3; axis++) {
    near = 4 * near + ((child >> axis) & 1 ? upper[axis] : SIBLING);
    above = 3 * above + upper[axis];
  }
  contexts[0] = 2 * (near * GROUPS + group);
  contexts[1] = 2 * (GROUPS * FACE_TABLE + (edges * 27 + faces) * GROUPS + group);
  const family = (above * 256 + before) * 8 + (child & 7);
  contexts[2] = 2 * (GROUPS * (FACE_TABLE + EDGE_TABLE) + family * GROUPS + group);
}

/** State of a node, whose depth's states begin at `offset`; LEAF in a larger leaf, ABSENT beyond the cell. */
function stateOf(states: Uint8Array, offset: number, key: number, depth: number): number {
  if (key === NONE) return ABSENT;
  let state = states[offset + key];
  while (state === ABSENT && depth > 0) {
    depth--;
    offset -= 8 ** depth;
    key >>= 3;
    state = states[offset + key];
    if (state !== ABSENT) return state === LEAF ? LEAF : ABSENT;
  }
  return state;
}
