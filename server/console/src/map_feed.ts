/** Feed of one map from the server: the index of its cells, its log, and live events.
 *
 *     live link  -->  events: cells, log, robots, marks  -->  takers, which show them
 *                 \-  the log may be another one, or too much changed  -->  index and newest entries once more */

import { NONE_READY, type Api } from "./api.ts";
import type { FindingsDesk } from "./findings_desk.ts";
import { LiveLink, type LinkState } from "./live.ts";
import type { LogBook } from "./log_book.ts";
import type { LiveEvent, MapInfo } from "./messages.ts";
import type { NewsBook } from "./news.ts";
import type { Cells } from "./scene/cells.ts";
import { serverNowS } from "./server_time.ts";
import type { Team } from "./team.ts";
import { SHOWN, type CommitStrip } from "./ui/commit_strip.ts";

/** From a load that failed to the next one. */
const AGAIN_MS = 3000;

/** Parts of the page that show what comes. */
export interface FeedTakers {
  readonly cells: Cells;
  readonly book: LogBook;
  readonly strip: CommitStrip;
  readonly team: Team;
  readonly findings: FindingsDesk;
  readonly news: NewsBook;
}

export interface FeedActs {
  /** Other cells are wanted. */
  plan(): void;
  /** The index is another one. */
  show(): void;
  /** The token is not valid any more. */
  refuse(): void;
}

export class MapFeed {
  state: LinkState = { live: false, heardMs: null };
  /** State of the map that the index was last taken from; empty: none came yet. */
  cursor = "";
  private readonly link: LiveLink;
  private isAsking = false;
  private loading: Promise<void>;
  /** Time of the next try to load what could not be loaded, as of performance.now(). */
  private againAtMs = Infinity;
  private readonly api: Api;
  private readonly info: MapInfo;
  private readonly takers: FeedTakers;
  private readonly acts: FeedActs;

  constructor(api: Api, info: MapInfo, takers: FeedTakers, acts: FeedActs) {
    this.api = api;
    this.info = info;
    this.takers = takers;
    this.acts = acts;
    this.loading = Promise.resolve();
    this.link = new LiveLink(api, info.name, (event) => this.heard(event), (state) => (this.state = state), () => acts.refuse());
  }

  /** Load the map for the first time. */
  begin(): void {
    this.loading = this.reload();
  }

  /** Try again what could not be loaded; a few times a second. */
  tick(): void {
    if (performance.now() < this.againAtMs) return;
    this.againAtMs = Infinity;
    void this.reload();
  }

  /** Ask whose evidence is left in cells that a retract changed last, which the log does not say. */
  async askHeld(): Promise<void> {
    const { cells, book } = this.takers;
    if (this.isAsking || ![...cells.all.values()].some(({ lm, held }) => held?.lm !== lm && book.isOut(lm))) return;
    this.isAsking = true;
    // Without an answer they stay grey, and are asked for again with the next entry of the log.
    await this.api.cells(this.info.name, "&held=true").then(({ entries }) => cells.takeHeld(entries), () => undefined);
    this.isAsking = false;
  }

  close(): void {
    this.link.close();
  }

  private heard(event: LiveEvent): void {
    const { cells, book, strip, team, findings, news } = this.takers;
    findings.hear(event);
    news.hear(event);
    if (event.type === "hello") {
      team.greet(event.robots);
      if (!event.resumed) void this.loading.then(() => (this.cursor === event.cursor ? undefined : this.reloadAll()));
    } else if (event.type === "cells") {
      if (event.cells === "many") void this.reload();
      else {
        for (const [i, j, k, lm] of event.cells) cells.changed([i, j, k], lm);
        this.acts.plan();
      }
    } else if (event.type === "log") {
      // Events leave out when the server received them, which was just now.
      const entries = event.entries.map((entry) => ({ ...entry, pushed_s: entry.pushed_s ?? serverNowS() }));
      book.add(entries);
      strip.add(entries);
      if (event.left_out) void this.readLog(event.entries[event.entries.length - 1].seq, event.left_out + event.entries.length).catch(() => this.reload());
      team.refresh();
    } else if (event.type === "robot") {
      team.hear(event.robot);
    }
  }

  /** Load everything, and forget the log: the server cannot prove that its own is the one that is known here, of which a part may be lost. */
  private reloadAll(): Promise<void> {
    this.takers.book.forget();
    this.takers.strip.forget();
    return this.reload();
  }

  /** Load everything once more; cells that did not change stay. */
  private async reload(): Promise<void> {
    const { cells, book, team } = this.takers;
    try {
      const { name } = this.info;
      const isNew = cells.all.size === 0;
      const [{ cursor, entries }, ready] = await Promise.all([
        this.api.cells(name), isNew ? this.api.readyViews(name).catch(() => NONE_READY) : NONE_READY,
      ]);
      this.cursor = cursor;
      cells.error = null;
      cells.takeIndex(entries, ready);
      this.acts.show();
      team.refresh();
      await this.readLog(Number(cursor.split(".")[1]), SHOWN);
      await book.reachBack(entries.reduce((least, { lm, voxels }) => (voxels ? Math.min(least, lm) : least), Infinity));
    } catch (error) {
      cells.error = (error as Error).message;
      this.againAtMs = performance.now() + AGAIN_MS;
    }
  }

  private async readLog(head: number, count: number): Promise<void> {
    this.takers.strip.add(await this.takers.book.newest(head, count));
  }
}
