/** One cell as it is shown: what the page has of it, and the points that the graphics card draws. */

import { Box3, BufferGeometry, InterleavedBuffer, InterleavedBufferAttribute, Points, Sphere, Vector3, type ShaderMaterial } from "three";
import { STRIDE } from "../decode/pack.ts";
import type { Triple } from "../messages.ts";

/** failedMs of a cell that never failed. */
export const NEVER_MS = -1e9;
const NO_NODES = new Uint8Array(0);

export class ShownCell {
  readonly key: string;
  readonly cell: Triple;
  readonly box: Box3;
  digest = "";
  /** Log entry that last changed it. */
  lm = 0;
  /** Newest entry whose evidence was still in it when `lm` had changed it; null: it was not asked for. */
  held: { lm: number; seq: number } | null = null;
  /** Nodes counted by depth; undefined: not yet. */
  counts: (number | undefined)[] = [];
  points: Points | null = null;
  /** Nodes as they came, which other moments may share, and as they are drawn: of a level a copy, which scene/ground.ts writes into. */
  source: Uint8Array = NO_NODES;
  bytes: Uint8Array = NO_NODES;
  /** Depth that is shown, and the one that is to be; 0: nothing. */
  depth = 0;
  wanted = 0;
  etag: string | null = null;
  /** The nodes that are drawn are not those that the server has. */
  dirty = true;
  busy = false;
  failedMs = NEVER_MS;
  /** Moment that is shown; empty: now. */
  momentKey = "";
  /** Its state at that moment is not known any more. */
  isUnknown = false;
  /** Until when it pulses, because it changed. */
  freshMs = 0;
  readonly number: number;
  private readonly sizeM: Vector3;
  private readonly isLevel: boolean;

  constructor(cell: Triple, { edgeM, heightM, isLevel }: { edgeM: number; heightM: number; isLevel: boolean }, number: number) {
    this.cell = cell;
    this.key = cell.join(",");
    this.sizeM = new Vector3(edgeM, edgeM, heightM);
    this.isLevel = isLevel;
    this.number = number;
    const low = new Vector3(...cell).multiply(this.sizeM);
    this.box = new Box3(low, low.clone().add(this.sizeM));
  }

  /** Log entry of the newest evidence in it, as far as that is known. */
  get heldLm(): number {
    return this.held?.lm === this.lm ? this.held.seq : this.lm;
  }

  get count(): number {
    return this.bytes.length / STRIDE;
  }

  /** No node in it is occupied, at whatever depth. */
  get isEmpty(): boolean {
    return this.etag !== null && this.count === 0 && this.counts.includes(0);
  }

  /** It is drawn coarser or finer than wanted. */
  get isOff(): boolean {
    return this.depth !== this.wanted && !this.isEmpty && !this.isUnknown;
  }

  /** Take the number of nodes that are drawn as that of a depth; where it changed, other depths are guessed to have changed alike. */
  counted(depth: number): void {
    const before = this.counts[depth];
    if (before === 0 || (before && !this.count)) this.counts = [];
    else if (before) this.counts = this.counts.map((count) => count && (count * this.count) / before);
    this.counts[depth] = this.count;
  }

  /** Take other nodes; their points, which the caller adds to the picture, or null if there are none. */
  take(source: Uint8Array, depth: number, material: ShaderMaterial): Points | null {
    this.drop();
    this.source = source;
    this.depth = depth;
    if (!source.length) return null;
    const bytes = this.isLevel ? source.slice() : source;
    this.bytes = bytes;
    const side = 2 ** depth;
    const geometry = geometryOf(bytes);
    geometry.boundingSphere = new Sphere(new Vector3(side / 2, side / 2, side / 2), side);
    const points = new Points(geometry, material);
    points.position.copy(this.box.min);
    points.scale.copy(this.sizeM).divideScalar(side);
    points.userData.box = nodesBox(bytes, points);
    points.matrixAutoUpdate = false;
    points.updateMatrix();
    this.points = points;
    return points;
  }

  /** Forget its nodes, here and on the graphics card. */
  drop(): void {
    this.points?.removeFromParent();
    this.points?.geometry.dispose();
    this.points = null;
    this.source = this.bytes = NO_NODES;
    this.depth = 0;
  }
}

/** One voxel, scaled to nothing: what the graphics card is made ready with. */
export function samplePoints(material: ShaderMaterial): Points {
  const points = new Points(geometryOf(new Uint8Array(STRIDE)), material);
  points.frustumCulled = false;
  points.scale.setScalar(0);
  return points;
}

function geometryOf(bytes: Uint8Array): BufferGeometry {
  const geometry = new BufferGeometry();
  const as8 = new InterleavedBuffer(bytes, STRIDE);
  geometry.setAttribute("place", new InterleavedBufferAttribute(as8, 4, 0));
  geometry.setAttribute("colour", new InterleavedBufferAttribute(as8, 4, 4, true));
  geometry.setAttribute("heat", new InterleavedBufferAttribute(as8, 4, 8));
  geometry.setDrawRange(0, bytes.length / STRIDE);
  return geometry;
}

function nodesBox(bytes: Uint8Array, points: Points): Box3 {
  const low = new Vector3(255, 255, 255);
  const high = new Vector3(0, 0, 0);
  for (let at = 0; at < bytes.length; at += STRIDE) {
    for (let axis = 0; axis < 3; axis++) {
      const place = bytes[at + axis];
      if (place < low.getComponent(axis)) low.setComponent(axis, place);
      if (place >= high.getComponent(axis)) high.setComponent(axis, place + 1);
    }
  }
  return new Box3(low.multiply(points.scale).add(points.position), high.multiply(points.scale).add(points.position));
}
