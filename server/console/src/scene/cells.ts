/** Cells of the map as they are shown: states of the server, nodes on the graphics card, and fetches that are still to come. */

import { Box3, Group, Vector3, type Camera, type PerspectiveCamera, type Points, type ShaderMaterial } from "three";
import { ApiError, NONE_READY, type Api, type CellAnswer, type ReadyViews } from "../api.ts";
import type { CellEntry, MapInfo, Triple } from "../messages.ts";
import type { Moment } from "../timeline.ts";
import { Decoders } from "./decoders.ts";
import { COARSE, plan, StandingPlan } from "./detail.ts";
import { squares, uniforms } from "./materials.ts";
import { PastViews } from "./past_views.ts";
import { NEVER_MS, samplePoints, ShownCell } from "./shown_cell.ts";

/** Browsers open six connections to a server over plain http; one stays for what is clicked. */
const FETCHES = 5;
const RETRY_MS = 3000;
const FRESH_MS = 1500;

export class Cells {
  readonly group = new Group();
  readonly all = new Map<string, ShownCell>();
  readonly byNumber: ShownCell[] = [];
  /** Edge of a cell, and its height, m: that of a level's cells is less. */
  readonly edgeM: number;
  readonly heightM: number;
  readonly depthMax: number;
  /** The map is a level: a surface of flat voxels. */
  readonly isLevel: boolean;
  /** Number of the last change of what is drawn. */
  shows = 0;
  /** Colour of the robot behind a log entry, 0 to 1; null: not known. */
  colourOf: (lm: number) => Triple | null = () => null;
  /** Age of what a log entry changed, and its unit: s, or log entries where no commit states a time. */
  ageOf: (lm: number) => number = (lm) => this.head - lm;
  /** Largest `lm` heard of: how far the map is. */
  head = 0;
  budget = 2_000_000;
  material: ShaderMaterial = squares;
  /** Time at which the whole map was there first, if only coarsely; ms since the page began. */
  firstPictureMs: number | null = null;
  error: string | null = null;
  /** Other nodes are there, or others are wanted; `isWhole` says that no more are on their way to what was shown or asked for first. */
  onChange: (isWhole: boolean) => void = () => {};
  onRefused: () => void = () => {};
  /** Numbers of cells that are gone. */
  private readonly free: number[] = [];
  private running = 0;
  private readonly decoders: Decoders;
  private readonly api: Api;
  private readonly map: string;
  private planned = false;
  private readonly standing = new StandingPlan();
  private ready = NONE_READY;
  /** Moment that is shown, or on its way; null: now. */
  private moment: Moment | null = null;
  /** Turns to other moments so far: an answer that was asked for before the last of them is of another moment. */
  private turns = 0;
  private readonly past = new PastViews();
  /** Reason for which some cells are unknown at the moment that is shown, in the server's words. */
  unknown: string | null = null;

  constructor(api: Api, info: MapInfo) {
    this.api = api;
    this.map = info.name;
    this.depthMax = info.geometry.depth;
    const { voxel_edge_um, height_step_um } = info.geometry;
    this.isLevel = height_step_um !== undefined;
    this.edgeM = (voxel_edge_um * 2 ** this.depthMax) / 1e6;
    this.heightM = ((height_step_um ?? voxel_edge_um) * 2 ** this.depthMax) / 1e6;
    this.decoders = new Decoders(this.isLevel);
  }

  /** Take over the whole index: what differs from what is shown is taken from `ready` or fetched, what is gone goes. */
  takeIndex(entries: readonly CellEntry[], ready: ReadyViews): void {
    this.ready = ready;
    this.standing.release();
    const there = new Set<string>();
    // Entries of another log may have the same numbers.
    this.past.forget();
    for (const { cell, digest, lm, voxels } of entries) {
      this.head = Math.max(this.head, lm);
      if (!voxels) continue;
      const shown = this.at(cell);
      there.add(shown.key);
      if (shown.digest !== digest) shown.dirty = true;
      shown.digest = digest;
      shown.lm = lm;
    }
    for (const shown of [...this.all.values()]) if (!there.has(shown.key)) this.remove(shown);
    this.planned = false;
    this.onChange(false);
  }

  /** Take over whose evidence is still in each cell, where some was taken out. */
  takeHeld(entries: readonly CellEntry[]): void {
    for (const { cell, lm, held_lm } of entries) {
      const shown = this.all.get(cell.join(","));
      if (shown) shown.held = { lm, seq: held_lm ?? lm };
    }
    this.onChange(false);
  }

  /** A cell changed: what is shown of it is fetched again. */
  changed(cell: Triple, lm: number): void {
    const shown = this.at(cell);
    shown.lm = lm;
    shown.digest = "";
    shown.dirty = true;
    this.head = Math.max(this.head, lm);
    this.standing.release();
    this.planned = false;
  }

  /** Show the map as it was at a moment; null: as it is. What was shown before is kept, so the way back is short. */
  showMoment(moment: Moment | null): void {
    if (moment?.key === this.moment?.key) return;
    if (this.planned && !this.waiting) this.standing.keep();
    if (!this.moment) {
      for (const cell of this.all.values()) {
        // Of a busy cell that changed the old bytes are still shown: under the name of its new state they would come back as now.
        if (!cell.dirty && !cell.busy && cell.etag !== null) this.past.put(...this.nameOf(cell, cell.depth), cell.source);
      }
    }
    this.moment = moment;
    this.turns++;
    this.unknown = null;
    for (const cell of this.all.values()) {
      const depth = cell.depth || cell.wanted;
      const bytes = this.past.get(...this.nameOf(cell, depth));
      cell.failedMs = NEVER_MS;
      cell.isUnknown = false;
      cell.dirty = !bytes;
      if (!bytes) continue;
      cell.momentKey = this.momentKey;
      cell.etag = "";
      if (bytes === cell.source) continue;
      this.show(cell, bytes, depth);
      cell.counted(depth);
    }
    this.planned = false;
    this.onChange(true);
  }

  /** Fetch all cells as they are at a moment that is not shown yet, one by one, and keep them; null: now. Ends early when the moment that is shown changes.
   *
   * A cell that the server does not know at that moment is left out. Throws `ApiError` where the server cannot be asked for more. */
  async lookAhead(moment: Moment | null): Promise<void> {
    const { turns } = this;
    for (const cell of [...this.all.values()]) {
      const depth = cell.depth || cell.wanted;
      const name: [string, string] = [`${cell.key}/${depth}`, `${cell.lm}/${moment?.key ?? ""}`];
      if (!depth || this.past.has(...name)) continue;
      try {
        const { data } = await this.api.view(this.map, cell.key, depth, { etag: null, atS: moment?.atS ?? null });
        if (data) this.past.put(...name, await this.decoders.decode(data));
      } catch (error) {
        if (!isNoCell(error) && !(isUnknownThen(error) && error.kind === "not_known")) throw error;
      }
      if (turns !== this.turns) return;
    }
  }

  /** Key of the moment that is shown; empty: now. */
  get momentKey(): string {
    return this.moment?.key ?? "";
  }

  /** Name of a cell's nodes at a depth and at the moment that is shown. */
  private nameOf(cell: ShownCell, depth: number): [string, string] {
    return [`${cell.key}/${depth}`, `${cell.lm}/${this.momentKey}`];
  }

  get drawn(): number {
    let sum = 0;
    for (const shown of this.all.values()) sum += shown.count;
    return sum;
  }

  /** Cells of which what is shown is not what is wanted. */
  get waiting(): number {
    let sum = 0;
    for (const shown of this.all.values()) if (shown.busy || (shown.wanted > 0 && (shown.dirty || shown.isOff))) sum++;
    return sum;
  }

  /** Cells that have no room in the picture, though something may be in them. */
  get leftOut(): number {
    let sum = 0;
    for (const shown of this.all.values()) if (shown.wanted === 0 && !shown.isEmpty) sum++;
    return this.planned ? sum : 0;
  }

  get bounds(): Box3 {
    const box = new Box3();
    for (const shown of this.all.values()) if (shown.count || shown.dirty) box.union(shown.box);
    return box;
  }

  /** Boxes of what is drawn of each cell, node by node: closer than those of the cells. */
  get tightBoxes(): Box3[] {
    const boxes = [...this.all.values()].flatMap(({ points }) => (points ? [points.userData.box as Box3] : []));
    return boxes.length ? boxes : [this.bounds];
  }

  get tightBounds(): Box3 {
    return this.tightBoxes.reduce((all, box) => all.union(box), new Box3());
  }

  /** Choose depths for where the eye is, and fetch what is missing. */
  update(camera: PerspectiveCamera, heightPx: number, frustum: { intersectsBox(box: Box3): boolean }): void {
    const view = JSON.stringify([camera.matrixWorld.elements, camera.projectionMatrix.elements, heightPx, this.budget]);
    if (this.standing.isDue(view, this.drawn, this.budget)) this.choose(camera, heightPx, frustum);
    this.planned = true;
    this.fetchMore();
  }

  private choose(camera: PerspectiveCamera, heightPx: number, frustum: { intersectsBox(box: Box3): boolean }): void {
    this.standing.note(this.moment === null);
    const cells = [...this.all.values()];
    const pxPerRad = heightPx / (2 * Math.tan((camera.fov * Math.PI) / 360));
    const candidates = cells.map((cell) => {
      const distanceM = Math.max(cell.box.distanceToPoint(camera.position), 0.3);
      const sizePx = frustum.intersectsBox(cell.box) ? (this.edgeM / distanceM) * pxPerRad : 0;
      return { counts: cell.counts, depthMax: this.depthMax, sizePx, distanceM, shown: cell.depth };
    });
    const depths = plan(candidates, this.budget);
    cells.forEach((cell, n) => {
      cell.wanted = depths[n];
      if (cell.wanted === 0 && cell.points) cell.drop();
    });
    const largest = cells.map((_, n) => n).sort((a, b) => candidates[b].sizePx - candidates[a].sizePx);
    this.queue = largest.map((n) => cells[n]);
  }

  private queue: ShownCell[] = [];

  get isFetching(): boolean {
    return this.running > 0;
  }

  /** `update` has something to do, though the eye did not move. */
  get needsPlan(): boolean {
    return !this.planned;
  }

  /** First what is not shown at all, then what changed, then what is too coarse; the largest in the picture first. */
  private fetchMore(): void {
    const nowMs = performance.now();
    const may = this.queue.filter((cell) => !cell.busy && cell.wanted > 0 && nowMs - cell.failedMs >= RETRY_MS);
    for (const cell of [
      ...may.filter(({ etag }) => etag === null),
      ...may.filter(({ etag, dirty }) => etag !== null && dirty),
      ...may.filter((cell) => cell.etag !== null && !cell.dirty && cell.isOff),
    ]) {
      if (this.running >= FETCHES) return;
      void this.fetch(cell);
    }
  }

  private async fetch(cell: ShownCell): Promise<void> {
    let isWhole = false;
    this.running++;
    cell.busy = true;
    cell.dirty = false;
    // The first picture is coarse, whatever will be wanted.
    const depth = cell.etag === null ? Math.min(cell.wanted, Math.max(this.depthMax - COARSE, 1)) : cell.wanted;
    const { moment, turns } = this;
    const name = this.nameOf(cell, depth);
    try {
      const changes = depth === cell.depth && cell.momentKey === this.momentKey;
      const ready = cell.etag === null && !moment ? this.takeReady(cell, depth) : null;
      const { data, etag } = ready ?? (await this.api.view(this.map, cell.key, depth, { etag: changes ? cell.etag || null : null, atS: moment?.atS ?? null }));
      if (data) {
        const decoded = await this.decoders.decode(data);
        const bytes = moment ? this.past.put(...name, decoded) : decoded;
        if (turns === this.turns && this.all.get(cell.key) === cell) {
          if (changes && cell.etag) cell.freshMs = performance.now() + FRESH_MS;
          this.show(cell, bytes, depth);
        }
      }
      if (turns !== this.turns) {
        cell.dirty = true; // another moment is shown by now, so also "not modified" says nothing of what is shown
        return;
      }
      cell.momentKey = moment?.key ?? "";
      cell.isUnknown = false;
      cell.etag = etag;
      cell.counted(depth);
      cell.failedMs = NEVER_MS;
      this.error = null;
      if (this.firstPictureMs === null && ![...this.all.values()].some(({ etag, wanted }) => etag === null && wanted > 0)) {
        this.firstPictureMs = performance.now();
        isWhole = true;
      }
    } catch (error) {
      if (turns === this.turns) this.failed(cell, error);
      else cell.dirty = true;
    } finally {
      this.running--;
      cell.busy = false;
      this.planned = false;
      this.fetchMore();
      this.onChange(isWhole || !this.isFetching);
    }
  }

  /** A view that came with others, once; if it is older than the index, the cell is fetched, too. */
  private takeReady(cell: ShownCell, depth: number): CellAnswer | null {
    const found = depth === this.ready.depth ? this.ready.cells.get(cell.key) : undefined;
    if (!found) return null;
    this.ready.cells.delete(cell.key);
    cell.dirty = !found.etag.startsWith(`"${cell.digest}.`);
    return found;
  }

  private failed(cell: ShownCell, error: unknown): void {
    cell.dirty = true;
    cell.failedMs = performance.now();
    window.setTimeout(() => this.onChange(false), RETRY_MS);
    if (error instanceof ApiError && error.wantsToken) this.onRefused();
    else if (isNoCell(error)) this.remove(cell);
    else if (this.moment && isUnknownThen(error)) this.lacks(cell, error.message);
    else this.error = `cell ${cell.key}: ${error instanceof Error ? error.message : String(error)}`;
  }

  /** Leave out a cell that is unknown at the moment that is shown: it is not asked for again. */
  private lacks(cell: ShownCell, why: string): void {
    cell.drop();
    cell.dirty = false;
    cell.isUnknown = true;
    cell.etag = "";
    cell.momentKey = this.momentKey;
    this.unknown = why;
  }

  /** Cells of which the moment that is shown is not known. */
  get lacking(): number {
    let sum = 0;
    for (const { isUnknown } of this.all.values()) if (isUnknown) sum++;
    return sum;
  }

  /** One voxel scaled to nothing, with which the graphics card is made ready. */
  sample(): Points {
    return samplePoints(this.material);
  }

  /** Size of a node at a depth, m. */
  sizeAt(depth: number): Vector3 {
    return new Vector3(this.edgeM, this.edgeM, this.heightM).divideScalar(2 ** depth);
  }

  private show(cell: ShownCell, bytes: Uint8Array, depth: number): void {
    this.shows++;
    const points = cell.take(bytes, depth, this.material);
    if (!points) return;
    points.onBeforeRender = (_renderer, _scene, _camera: Camera, _geometry, material) => {
      uniforms.uAge.value = this.ageOf(cell.lm);
      uniforms.uRobot.value.set(...(this.colourOf(cell.heldLm) ?? ([-1, -1, -1] as Triple)));
      uniforms.uObject.value = cell.number;
      uniforms.uFresh.value = Math.max(0, (cell.freshMs - performance.now()) / FRESH_MS) * 0.55;
      (material as ShaderMaterial).uniformsNeedUpdate = true;
    };
    this.group.add(points);
  }

  /** A cell still pulses because it changed. */
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
    this.decoders.close();
  }

  private at(cell: Triple): ShownCell {
    const key = cell.join(",");
    let shown = this.all.get(key);
    if (!shown) {
      shown = new ShownCell(cell, this, this.free.pop() ?? this.byNumber.length);
      this.byNumber[shown.number] = shown;
      this.all.set(key, shown);
    }
    return shown;
  }

  private remove(cell: ShownCell): void {
    this.standing.release();
    cell.drop();
    if (this.all.delete(cell.key)) this.free.push(cell.number);
  }
}

function isNoCell(error: unknown): boolean {
  return error instanceof ApiError && error.kind === "no_cell";
}

/** True where the server does not know a cell at a past moment, or not within its bounds. */
function isUnknownThen(error: unknown): error is ApiError {
  return error instanceof ApiError && (error.kind === "not_known" || error.kind === "too_costly");
}
