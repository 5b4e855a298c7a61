/** Two moments compared: what the server says is new, gone, warmer or colder, as colours in the map and as a list. */

import { Vector3 } from "three";
import { ApiError, type Api } from "./api.ts";
import { centresOf, thingsOf, WAYS, type ChangedThing, type Changes, type Way } from "./changes.ts";
import type { Look } from "./look.ts";
import { voxelSizeOf } from "./map_layers.ts";
import type { MapInfo } from "./messages.ts";
import type { Cells } from "./scene/cells.ts";
import { ChangedVoxels } from "./scene/changed_voxels.ts";
import type { Stage } from "./scene/stage.ts";
import { isShown, visibleFrom } from "./scene/viewpoint.ts";
import { ChangesPanel, COLOURS } from "./ui/time/changes_panel.ts";

/** Handles rest so long before the server is asked: it looks through every cell that has news. */
const REST_MS = 300;
/** From one question to the next while robots map, or the server is busy. */
const AGAIN_MS = 3000;

export class Comparison {
  readonly panel = new ChangesPanel();
  readonly voxels: ChangedVoxels;
  things: readonly ChangedThing[] = [];
  onFly: (to: ReturnType<typeof visibleFrom>) => void = () => {};
  private changes: Changes | null = null;
  private readonly hidden = new Set<Way>(["moved"]);
  /** Moments that are compared; empty: nothing is. */
  private handles = "";
  /** Largest `lm` that was heard of when the server was asked last. */
  private head = -1;
  /** Number of the last question: the answer to another one is old. */
  private turn = 0;
  /** A question is to be asked, or its answer is on its way. */
  private isPending = false;
  /** The list is of other moments, or there is none. */
  private isOld = true;
  private timer = 0;
  private drawn = "";
  private readonly api: Api;
  private readonly info: MapInfo;
  private readonly look: Look;
  private readonly stage: Stage;
  private readonly cells: Cells;

  constructor(api: Api, info: MapInfo, look: Look, stage: Stage, cells: Cells) {
    this.api = api;
    this.info = info;
    this.look = look;
    this.stage = stage;
    this.cells = cells;
    this.voxels = new ChangedVoxels(voxelSizeOf(info.geometry));
    this.stage.add(this.voxels.group);
    this.panel.onFly = (thing) => this.onFly(visibleFrom(this.cells, placeToSee(thing), this.stage.camera.position));
    this.panel.onWay = (way) => {
      if (!this.hidden.delete(way)) this.hidden.add(way);
      this.draw();
    };
  }

  /** A few times a second: compare what the look says, and again when the map changed. */
  tick(): void {
    const { sinceS, atS } = this.look;
    const handles = sinceS === null ? "" : JSON.stringify([sinceS, atS]);
    if (handles !== this.handles) {
      this.handles = handles;
      this.isOld = true;
      if (handles) {
        this.panel.say("Comparing …");
        this.askIn(REST_MS);
      } else {
        this.stop();
        this.changes = null;
        this.things = [];
        this.panel.close();
      }
    } else if (handles && this.head !== this.cells.head && !this.isPending) {
      // The list stays. A head that moves at each tick puts nothing off.
      this.askIn(AGAIN_MS);
    }
    this.draw();
  }

  dispose(): void {
    this.stop();
    this.voxels.dispose();
  }

  private stop(): void {
    window.clearTimeout(this.timer);
    this.turn++;
    this.isPending = false;
  }

  private askIn(waitMs: number): void {
    this.stop();
    this.isPending = true;
    const { turn } = this;
    this.timer = window.setTimeout(() => void this.ask(turn), waitMs);
  }

  private async ask(turn: number): Promise<void> {
    const { sinceS, atS } = this.look;
    // Until the next tick asks for them the handles may be elsewhere.
    if (JSON.stringify([sinceS, atS]) !== this.handles) return this.askIn(REST_MS);
    this.head = this.cells.head;
    const until = atS === null ? "" : `&until=${atS}`;
    try {
      const changes = await this.api.json<Changes>(`maps/${this.info.name}/main/changes?since=${sinceS}${until}`);
      if (turn !== this.turn) return;
      if (this.isOld) this.drawn = ""; // the list takes the place of words also where it is the same
      this.isPending = this.isOld = false;
      this.changes = changes;
      this.things = thingsOf(changes, voxelSizeOf(this.info.geometry));
      this.draw();
    } catch (error) {
      if (turn !== this.turn) return;
      this.isPending = false;
      const isBusy = error instanceof ApiError && error.kind === "busy";
      if (this.isOld || !isBusy) {
        this.isOld = true;
        this.changes = null;
        this.things = [];
        this.panel.say((error as Error).message);
      }
      if (isBusy) this.askIn(AGAIN_MS);
    }
  }

  /** Again only where something is different. */
  private draw(): void {
    const { changes, look } = this;
    const state = changes ? JSON.stringify([changes.cursor, changes.since_s, changes.until_s, [...this.hidden], look.floorM, look.ceilingM, look.clip]) : "";
    if (state === this.drawn) return;
    this.drawn = state;
    if (!changes) this.voxels.clear();
    else {
      const parts = WAYS.filter((way) => !this.hidden.has(way));
      this.voxels.show(parts.map((way) => ({ colour: COLOURS[way], centresM: centresOf(changes, way), isThere: way !== "gone" })), isShown);
      this.panel.show(changes, this.things, this.hidden);
    }
    this.stage.draw();
  }
}

/** Where nothing is any more one looks into the middle; of what is there one sees the top. */
function placeToSee({ way, placeM, highM }: ChangedThing): Vector3 {
  return new Vector3(placeM[0], placeM[1], way === "gone" ? placeM[2] : highM[2]);
}
