/** Heights as people tell them: over the floor, storey by storey, with a roof that would hide the rooms cut off. */

import type { Look } from "./look.ts";
import type { Cells } from "./scene/cells.ts";
import type { Spread } from "./scene/spread.ts";
import { cutOf, NO_STOREYS, storeysOf } from "./scene/storeys.ts";

/** Of two looks for floors, ms; the ceiling is not moved for less, m. */
const FLOORS_MS = 2000;
const MOVED_M = 0.02;
/** A storey begins so far below its floor: some voxels lie deeper than most. */
const BELOW_M = 0.3;

export class Heights {
  storeys = NO_STOREYS;
  /** The ceiling is cut elsewhere. */
  onCut: () => void = () => {};
  /** Floors were looked for again. */
  onFloors: () => void = () => {};
  private readonly look: Look;
  private readonly cells: Cells;
  private readonly spread: Spread;
  /** What the floors were found in, and when to look again, as of performance.now(). */
  private foundIn = "";
  private nextMs = 0;
  /** The newest entry of which all that is wanted was there once. */
  private wholeHead = -1;

  constructor(look: Look, cells: Cells, spread: Spread) {
    this.look = look;
    this.cells = cells;
    this.spread = spread;
  }

  /** Upper face of the lowest floor, m in the map; null: none is known. */
  get floorM(): number | null {
    return this.storeys.floorsM[0] ?? null;
  }

  /** Look again, whatever was found. */
  forget(): void {
    this.foundIn = "";
    this.nextMs = 0;
  }

  /** A few times a second: floors of what is drawn, where that changed. */
  tick(): void {
    const { drawn, head, firstPictureMs } = this.cells;
    const isEarly = firstPictureMs === null;
    // Once more when all of an entry is there, and not again for each finer node: coarse ones may hide a storey.
    if (!isEarly && !this.cells.isFetching && !this.cells.waiting && !this.cells.needsPlan) this.wholeHead = head;
    const state = isEarly ? `${drawn} nodes` : `entry ${head}, ${this.wholeHead === head ? "whole" : "a part"}`;
    if (state === this.foundIn || (!isEarly && performance.now() < this.nextMs)) return;
    this.foundIn = state;
    // What is there early may lack a storey: the first look at all of it does not wait.
    this.nextMs = isEarly ? 0 : performance.now() + FLOORS_MS;
    this.storeys = storeysOf(this.cells, this.spread.of("height"));
    this.onFloors();
    this.cutByItself();
  }

  /** Show the ceiling, or cut it off as the page does by itself. */
  toggleCeiling(): void {
    const { look } = this;
    look.isCeilingChosen = look.ceilingM !== null;
    look.ceilingM = look.isCeilingChosen ? null : cutOf(this.storeys);
    this.onCut();
  }

  /** One storey alone, from the lowest; -1: all. */
  showStorey(storey: number): void {
    const { look } = this;
    const floorM = this.storeys.floorsM[storey];
    look.isCeilingChosen = floorM !== undefined;
    look.floorM = floorM === undefined ? null : floorM - BELOW_M;
    look.ceilingM = cutOf(floorM === undefined ? this.storeys : { floorsM: [floorM], isRoofed: true, roofM: Infinity });
    this.onCut();
  }

  private cutByItself(): void {
    const { look } = this;
    const cutM = cutOf(this.storeys);
    if (look.isCeilingChosen || cutM === look.ceilingM) return;
    if (cutM !== null && look.ceilingM !== null && Math.abs(cutM - look.ceilingM) < MOVED_M) return;
    look.ceilingM = cutM;
    this.onCut();
  }
}
