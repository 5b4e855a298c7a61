/** What one cell looks like, from the bytes of `application/vnd.cairn.view`: FORMAT.md section 15.
 *
 * The mirror of `decode_view` in cairn_map/codec/view_code.py; a test compares both on real cells. */

import { DamagedError } from "./arithmetic.ts";
import { LeafIndex } from "./neighbours.ts";
import { readOctree } from "./octree.ts";
import { readRanks, readSamples } from "./samples.ts";

const HEAD_BYTES = 50;
const COLOUR_TOPS = [[], [31, 63, 31], [255, 255, 255]];
/** More would be no cell that a page can hold. */
const NODES_MAX = 1 << 24;

export interface View {
  readonly cell: readonly [number, number, number];
  readonly cellDepth: number;
  readonly depth: number;
  readonly voxelEdgeUm: number;
  /** Morton numbers of the V nodes at `depth`, rising. */
  readonly nodes: Uint32Array;
  /** (V,) codes: probabilities in 1/255, or log-odds in 0.001 plus 2^15 if `inLogOdds`. */
  readonly chances: Uint16Array;
  readonly inLogOdds: boolean;
  /** Rows of `nodes` with a colour, and (C, 3) numbers from 0 to the largest. */
  readonly coloured: Uint32Array;
  readonly rgb: Int32Array;
  readonly rgbTops: readonly number[];
  /** Rows of `nodes` with a temperature, and means in steps; with `heatColumns` 2 the hottest voxel beside each. */
  readonly warm: Uint32Array;
  readonly heats: Int32Array;
  readonly heatColumns: number;
  readonly heatStepK: number;
}

export function decodeView(data: Uint8Array): View {
  const head = readHead(data);
  const { depth, N, V } = head;
  const [masks, paletteBytes, rankBytes, colourBytes, heatBytes] = groupsOf(data);
  const octree = readOctree(masks, head.childMasks, head.leafMasks, N, depth);
  if (octree.sizes.reduce((sum, size) => sum + size, 0) !== V) {
    throw new DamagedError("the octree has another number of nodes than the head names");
  }
  const index = new LeafIndex(octree.starts, octree.sizes, depth);
  const all = Uint32Array.from({ length: N }, (_, n) => n);
  const ranks = readRanks(rankBytes, index.earlierRows(octree.starts, all), N);
  const palette = readPalette(paletteBytes);
  const found = new Uint16Array(N);
  const occupied = new Uint8Array(N);
  const half = head.inLogOdds ? 32768 : 127;
  for (let n = 0; n < N; n++) {
    if (ranks[n] >= palette.length) throw new DamagedError("a probability is not in the palette");
    found[n] = palette[ranks[n]];
    occupied[n] = found[n] > half ? 1 : 0;
  }
  const rgbTops = COLOUR_TOPS[head.colours];
  const heatColumns = head.heatStepK === 0 ? 0 : depth === head.cellDepth ? 1 : 2;
  const colours = readSamples(colourBytes, octree, index, depth, occupied, new Uint8Array(N), rgbTops.length);
  const before = new Uint8Array(N);
  for (const leaf of colours.leaves) before[leaf] = 1;
  const heats = readSamples(heatBytes, octree, index, depth, occupied, before, heatColumns);
  const nodes = new Uint32Array(V);
  const chances = new Uint16Array(V);
  const rowOf = new Uint32Array(N);
  for (let n = 0, v = 0; n < N; n++) {
    rowOf[n] = v;
    for (let step = 0; step < octree.sizes[n]; step++, v++) {
      nodes[v] = octree.starts[n] + step;
      chances[v] = found[n];
    }
  }
  return {
    ...head, nodes, chances, rgbTops, heatColumns,
    coloured: colours.leaves.map((leaf) => rowOf[leaf]), rgb: colours.values,
    warm: heats.leaves.map((leaf) => rowOf[leaf]), heats: heats.values,
  };
}

function readHead(data: Uint8Array) {
  if (data.length < HEAD_BYTES || String.fromCharCode(...data.subarray(0, 4)) !== "CRNV") {
    throw new DamagedError("not a view of a cell");
  }
  const read = new DataView(data.buffer, data.byteOffset, data.byteLength);
  if (data[4] !== 1) throw new DamagedError(`this page knows views of version 1, got ${data[4]}: reload it`);
  const head = {
    cellDepth: data[5],
    depth: data[6],
    inLogOdds: data[8] === 1,
    colours: data[9],
    heatStepK: read.getFloat64(10, true),
    voxelEdgeUm: read.getUint32(18, true),
    cell: [read.getInt32(22, true), read.getInt32(26, true), read.getInt32(30, true)] as [number, number, number],
    N: read.getUint32(34, true),
    V: read.getUint32(38, true),
    childMasks: read.getUint32(42, true),
    leafMasks: read.getUint32(46, true),
  };
  const { depth, N, V, childMasks, leafMasks } = head;
  const known = data[7] <= 1 && data[8] <= 1 && head.colours <= 2 && 1 <= depth && depth <= head.cellDepth;
  if (!known || head.cellDepth > 8 || V > NODES_MAX) throw new DamagedError("a view's head is out of range");
  if (N > V || V > 8 ** depth || childMasks > depth * N || leafMasks > childMasks) {
    throw new DamagedError("the head's numbers of leaves, nodes and masks contradict each other");
  }
  return head;
}

function groupsOf(data: Uint8Array): Uint8Array[] {
  const read = new DataView(data.buffer, data.byteOffset, data.byteLength);
  const groups: Uint8Array[] = [];
  let at = HEAD_BYTES;
  while (groups.length < 5 && at + 4 <= data.length) {
    const size = read.getUint32(at, true);
    groups.push(data.subarray(at + 4, at + 4 + size));
    at += 4 + size;
  }
  if (groups.length < 5 || at !== data.length) throw new DamagedError("the view is cut off, or something follows it");
  return groups;
}

function readPalette(data: Uint8Array): Uint16Array {
  const palette = new Uint16Array(data.length >> 1);
  for (let n = 0; n < palette.length; n++) palette[n] = data[2 * n] | (data[2 * n + 1] << 8);
  if (data.length % 2) throw new DamagedError("half a probability");
  return palette;
}
