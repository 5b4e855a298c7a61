/** The map's cells as they are shown: what the server has, what lies on the graphics card, what is still to be fetched. */

import {
  Box3, BufferGeometry, Group, InterleavedBuffer, InterleavedBufferAttribute, Points, Sphere, Vector3,
  type Camera, type PerspectiveCamera, type ShaderMaterial,
} from "three";
import { ApiError, type Api } from "../api.ts";
import { STRIDE } from "../decode/pack.ts";
import type { CellEntry, MapInfo, Triple } from "../messages.ts";
import { Decoders } from "./decoders.ts";
import { plan } from "./detail.ts";
import { squares, uniforms } from "./materials.ts";

const FETCHES = 4;
const RETRY_MS = 3000;
/** failedMs of a cell that never failed. */
const NEVER_MS = -1e9;
const FRESH_MS = 1500;

export class ShownCell {
  readonly key: string;
  readonly cell: Triple;
  readonly box: Box3;
  digest = "";
  /** Log entry that last changed it. */
  lm = 0;
  counts: (number | undefined)[] = [];
  points: Points | null = null;
  bytes: Uint8Array = new Uint8Array(0);
  depth = 0;
  wanted = 0;
  etag: string | null = null;
  dirty = true;
  busy = false;
  failedMs = NEVER_MS;
  freshMs = 0;
  readonly number: number;

  constructor(cell: Triple, edgeM: number, number: number) {
    this.cell = cell;
    this.key = cell.join(",");
    this.number = number;
    const low = new Vector3(...cell).multiplyScalar(edgeM);
    this.box = new Box3(low, low.clone().addScalar(edgeM));
  }

  get count(): number {
    return this.bytes.length / STRIDE;
  }

  /** Nothing in it is occupied, at whatever depth. */
  get isEmpty(): boolean {
    return this.etag !== null && this.count === 0 && this.counts.includes(0);
  }
}

export class Cells {
  readonly group = new Group();
  readonly all = new Map<string, ShownCell>();
  readonly byNumber: ShownCell[] = [];
  readonly edgeM: number;
  readonly depthMax: number;
  /** Colour of the robot behind a log entry, 0 to 1; null: not known. */
  colourOf: (lm: number) => Triple | null = () => null;
  /** Largest `lm` heard of: how far the map is. */
  head = 0;
  budget = 2_000_000;
  material: ShaderMaterial = squares;
  /** When the whole map was there for the first time, if only coarsely; ms since the page began. */
  firstPictureMs: number | null = null;
  error: string | null = null;
  onChange: () => void = () => {};
  onRefused: () => void = () => {};
  private running = 0;
  private readonly decoders = new Decoders();
  private readonly api: Api;
  private readonly map: string;
  private planned = false;

  constructor(api: Api, info: MapInfo) {
    this.api = api;
    this.map = info.name;
    this.depthMax = info.geometry.depth;
    this.edgeM = (info.geometry.voxel_edge_um * 2 ** this.depthMax) / 1e6;
  }

  /** Take over the whole index: what differs from what is shown is fetched, what is gone goes. */
  takeIndex(entries: readonly CellEntry[]): void {
    const there = new Set<string>();
    for (const { cell, digest, lm, voxels } of entries) {
      this.head = Math.max(this.head, lm);
      if (!voxels) continue;
      const shown = this.at(cell);
      there.add(shown.key);
      if (shown.digest !== digest) {
        shown.dirty = true;
        shown.counts = [];
      }
      shown.digest = digest;
      shown.lm = lm;
    }
    for (const shown of [...this.all.values()]) if (!there.has(shown.key)) this.remove(shown);
    this.planned = false;
    this.onChange();
  }

  /** A cell changed: what is shown of it is fetched again. */
  changed(cell: Triple, lm: number): void {
    const shown = this.at(cell);
    shown.lm = lm;
    shown.counts = [];
    shown.digest = "";
    shown.dirty = true;
    this.head = Math.max(this.head, lm);
    this.planned = false;
  }

  get drawn(): number {
    let sum = 0;
    for (const shown of this.all.values()) sum += shown.count;
    return sum;
  }

  /** Cells of which what is shown is not what is wanted. */
  get waiting(): number {
    let sum = 0;
    for (const shown of this.all.values()) if (shown.dirty || (shown.depth !== shown.wanted && !shown.isEmpty)) sum++;
    return sum;
  }

  get bounds(): Box3 {
    const box = new Box3();
    for (const shown of this.all.values()) if (shown.count || shown.dirty) box.union(shown.box);
    return box;
  }

  /** The box of what is drawn, node by node: closer than that of the cells. */
  get tightBounds(): Box3 {
    const box = new Box3();
    for (const { points } of this.all.values()) if (points) box.union(points.userData.box as Box3);
    return box.isEmpty() ? this.bounds : box;
  }

  /** Choose depths for where the eye is, and fetch what is missing. */
  update(camera: PerspectiveCamera, heightPx: number, frustum: { intersectsBox(box: Box3): boolean }): void {
    const cells = [...this.all.values()];
    const pxPerRad = heightPx / (2 * Math.tan((camera.fov * Math.PI) / 360));
    const candidates = cells.map((cell) => {
      const distance = Math.max(cell.box.distanceToPoint(camera.position), 0.3);
      const sizePx = frustum.intersectsBox(cell.box) ? (this.edgeM / distance) * pxPerRad : 0;
      return { counts: cell.counts, depthMax: this.depthMax, sizePx, shown: cell.depth };
    });
    const depths = plan(candidates, this.budget);
    cells.forEach((cell, n) => {
      cell.wanted = depths[n];
      if (cell.wanted === 0 && cell.points) this.drop(cell);
    });
    const largest = cells.map((_, n) => n).sort((a, b) => candidates[b].sizePx - candidates[a].sizePx);
    this.queue = largest.map((n) => cells[n]);
    this.planned = true;
    this.fetchMore();
  }

  private queue: ShownCell[] = [];

  /** Whether `update` is worth calling though the eye did not move. */
  get needsPlan(): boolean {
    return !this.planned;
  }

  /** First what is not shown at all, then what changed, then what is too coarse; the largest in the picture first. */
  private fetchMore(): void {
    const nowMs = performance.now();
    const may = this.queue.filter((cell) => !cell.busy && cell.wanted > 0 && nowMs - cell.failedMs >= RETRY_MS);
    const coarse = (cell: ShownCell) => cell.depth !== cell.wanted && !cell.isEmpty;
    for (const cell of [
      ...may.filter(({ etag }) => etag === null),
      ...may.filter(({ etag, dirty }) => etag !== null && dirty),
      ...may.filter((cell) => cell.etag !== null && !cell.dirty && coarse(cell)),
    ]) {
      if (this.running >= FETCHES) return;
      void this.fetch(cell);
    }
  }

  private async fetch(cell: ShownCell): Promise<void> {
    this.running++;
    cell.busy = true;
    cell.dirty = false;
    // The first picture is coarse, whatever will be wanted.
    const depth = cell.etag === null ? Math.min(cell.wanted, Math.max(this.depthMax - 3, 1)) : cell.wanted;
    try {
      const changes = depth === cell.depth;
      const { data, etag } = await this.api.view(this.map, cell.key, depth, changes ? cell.etag : null);
      if (data) {
        const bytes = await this.decoders.decode(data);
        if (this.all.get(cell.key) === cell) {
          if (changes && cell.etag) cell.freshMs = performance.now() + FRESH_MS;
          this.show(cell, bytes, depth);
        }
      }
      cell.etag = etag;
      cell.counts[depth] = cell.count;
      cell.failedMs = NEVER_MS;
      this.error = null;
      if (this.firstPictureMs === null && ![...this.all.values()].some(({ etag }) => etag === null)) {
        this.firstPictureMs = performance.now();
      }
    } catch (error) {
      this.failed(cell, error);
    } finally {
      this.running--;
      cell.busy = false;
      this.planned = false;
      this.onChange();
      this.fetchMore();
    }
  }

  private failed(cell: ShownCell, error: unknown): void {
    cell.dirty = true;
    cell.failedMs = performance.now();
    window.setTimeout(() => this.onChange(), RETRY_MS);
    if (error instanceof ApiError && error.wantsToken) this.onRefused();
    else if (error instanceof ApiError && error.kind === "no_cell") this.remove(cell);
    else this.error = `cell ${cell.key}: ${error instanceof Error ? error.message : String(error)}`;
  }

  /** One voxel, hidden by a probability of 0: what the graphics card is made ready with. */
  sample(): Points {
    const points = new Points(geometryOf(new Uint8Array(STRIDE)), this.material);
    points.frustumCulled = false;
    points.scale.setScalar(0);
    return points;
  }

  private show(cell: ShownCell, bytes: Uint8Array, depth: number): void {
    this.drop(cell);
    cell.bytes = bytes;
    cell.depth = depth;
    if (!bytes.length) return;
    cell.points = this.pointsOf(cell, geometryOf(bytes), depth);
    this.group.add(cell.points);
  }

  private pointsOf(cell: ShownCell, geometry: BufferGeometry, depth: number): Points {
    const side = 2 ** depth;
    geometry.boundingSphere = new Sphere(new Vector3(side / 2, side / 2, side / 2), side);
    const points = new Points(geometry, this.material);
    points.position.copy(cell.box.min);
    points.scale.setScalar(this.edgeM / side);
    points.userData.box = nodesBox(cell.bytes, points);
    points.matrixAutoUpdate = false;
    points.updateMatrix();
    points.onBeforeRender = (_renderer, _scene, _camera: Camera, _geometry, material) => {
      uniforms.uAge.value = this.head - cell.lm;
      uniforms.uRobot.value.set(...(this.colourOf(cell.lm) ?? ([-1, -1, -1] as Triple)));
      uniforms.uObject.value = cell.number;
      uniforms.uFresh.value = Math.max(0, (cell.freshMs - performance.now()) / FRESH_MS) * 0.55;
      (material as ShaderMaterial).uniformsNeedUpdate = true;
    };
    return points;
  }

  /** Whether something is still pulsing because it changed. */
  get isFresh(): boolean {
    const nowMs = performance.now();
    for (const { freshMs } of this.all.values()) if (freshMs > nowMs) return true;
    return false;
  }

  setMaterial(material: ShaderMaterial): void {
    this.material = material;
    for (const { points } of this.all.values()) if (points) points.material = material;
  }

  dispose(): void {
    for (const shown of [...this.all.values()]) this.remove(shown);
  }

  private at(cell: Triple): ShownCell {
    const key = cell.join(",");
    let shown = this.all.get(key);
    if (!shown) {
      shown = new ShownCell(cell, this.edgeM, this.byNumber.length);
      this.byNumber.push(shown);
      this.all.set(key, shown);
    }
    return shown;
  }

  private drop(cell: ShownCell): void {
    if (cell.points) {
      this.group.remove(cell.points);
      cell.points.geometry.dispose();
    }
    cell.points = null;
    cell.bytes = new Uint8Array(0);
    cell.depth = 0;
  }

  private remove(cell: ShownCell): void {
    this.drop(cell);
    this.all.delete(cell.key);
  }
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
