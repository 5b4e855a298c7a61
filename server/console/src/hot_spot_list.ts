/** The map's hot spots as the server lists them: asked for when cells changed, and not while nothing does. */

import { ApiError, type Api } from "./api.ts";
import type { HotSpot, HotSpots, MapInfo } from "./messages.ts";
import { KELVIN_ZERO_C } from "./units.ts";

/** Spots of an answer at most: 10 kB. */
const COUNT = 30;
/** Answers that go on from the one before, while a server has not read all of the map yet. */
const TRIES = 100;
/** Between two questions: robots that push together make one. */
const PAUSE_MS = 1500;
const AGAIN_MS = 5000;
const COLD = "This map has no temperatures.";

export class HotSpotList {
  onChange: () => void = () => {};
  spots: readonly HotSpot[] = [];
  /** Number of spots in the map, of which `spots` are the first. */
  total = 0;
  /** `spots` are of a search through all of the map for what is above the threshold. */
  isComplete = false;
  /** Reason for which the list is missing or incomplete, in words; empty: it is complete. */
  said = "";
  /** Threshold of the list that is asked for, °C. */
  overC: number;
  /** Time of the next question, as of performance.now(). */
  private askAtMs = 0;
  private isAsking = false;
  private readonly api: Api;
  private readonly map: string;
  /** The map has temperatures. */
  private readonly isWarm: boolean;

  constructor(api: Api, { name, geometry }: MapInfo, overC: number) {
    this.api = api;
    this.map = name;
    this.overC = overC;
    this.isWarm = geometry.channels.some(({ kind }) => kind === "temperature");
    if (!this.isWarm) this.said = COLD;
  }

  /** Ask soon; many callings make one question. */
  refresh(): void {
    this.askAtMs = Math.min(this.askAtMs, Math.max(this.nextMs, performance.now()));
  }

  /** Spots are what is warmer than this from now on. */
  setThreshold(overC: number): void {
    if (overC === this.overC) return;
    this.overC = overC;
    this.isComplete = false;
    this.askAtMs = 0;
  }

  /** A few times a second. */
  tick(): void {
    if (this.isWarm && !this.isAsking && performance.now() >= this.askAtMs) void this.ask();
  }

  private nextMs = 0;
  private tries = 0;

  private async ask(): Promise<void> {
    const { overC } = this;
    this.isAsking = true;
    this.askAtMs = Infinity;
    this.nextMs = performance.now() + PAUSE_MS;
    try {
      const overK = Math.max(0, overC + KELVIN_ZERO_C);
      const found = await this.api.json<HotSpots>(`maps/${this.map}/main/hotspots?over_k=${overK}&count=${COUNT}`);
      this.spots = found.spots;
      this.total = found.total;
      this.isComplete = found.complete && overC === this.overC;
      this.said = found.complete ? "" : "The server is still looking through the map.";
      this.tries = found.complete ? 0 : this.tries + 1;
      if (!found.complete && this.tries < TRIES) this.askAtMs = this.nextMs;
    } catch (error) {
      this.failed(error);
    } finally {
      this.isAsking = false;
      if (overC !== this.overC) this.askAtMs = 0;
      this.onChange();
    }
  }

  private failed(error: unknown): void {
    const kind = error instanceof ApiError ? error.kind : "";
    if (kind === "unknown_channel" || kind === "no_route" || kind === "too_costly") {
      this.spots = [];
      this.total = 0;
      this.isComplete = false;
      this.said =
        kind === "unknown_channel" ? COLD
        : kind === "no_route" ? "This server is older than lists of hot spots."
        : "Too much of the map is that warm: give a higher temperature.";
      return;
    }
    // Of a link that is gone the bar tells; a busy server is asked again.
    this.askAtMs = performance.now() + AGAIN_MS;
  }
}
