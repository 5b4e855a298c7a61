/** Time on the page: the moment at which the map is shown, what is compared with it, and the log along the axis. */

import type { Api } from "./api.ts";
import { Comparison } from "./comparison.ts";
import type { LogBook } from "./log_book.ts";
import type { CameraView, Look } from "./look.ts";
import type { LogEntry, MapInfo } from "./messages.ts";
import type { Cells } from "./scene/cells.ts";
import type { Stage } from "./scene/stage.ts";
import { RetractPreview } from "./retract_preview.ts";
import { Timeline } from "./timeline.ts";
import { CommitStrip, momentText } from "./ui/commit_strip.ts";
import { openCommit } from "./ui/retract_dialog.ts";

/** Entries of the log in one request. */
const PAGE = 1000;

/** Effects of the desk on the rest of the page. */
export interface TimeActs {
  say(text: string): void;
  isOperator(): boolean;
  /** Other cells are wanted. */
  plan(): void;
  fly(view: CameraView): void;
}

export class TimeDesk {
  readonly timeline: Timeline;
  readonly strip: CommitStrip;
  readonly comparison: Comparison;
  readonly preview: RetractPreview;
  private isReading = false;
  /** A handle that is dragged moves more often than frames are drawn. */
  private wanted: { handle: number; atS: number | null } | null = null;
  /** Moment that one more step would show, which is fetched once all that is shown is there; undefined: none. */
  private ahead: { atS: number | null } | undefined;
  /** Moments that are fetched ahead at present. */
  private fetchesAhead = 0;
  private readonly api: Api;
  private readonly info: MapInfo;
  private readonly look: Look;
  private readonly cells: Cells;
  private readonly book: LogBook;
  private readonly acts: TimeActs;

  constructor(api: Api, info: MapInfo, look: Look, scene: { stage: Stage; cells: Cells }, book: LogBook, acts: TimeActs) {
    this.api = api;
    this.info = info;
    this.look = look;
    this.cells = scene.cells;
    this.book = book;
    this.acts = acts;
    this.timeline = new Timeline(info.epoch_s ?? null);
    this.strip = new CommitStrip(this.timeline);
    this.strip.onChoose = (entry) => this.open(entry);
    this.strip.onStep = (by) => this.step(by);
    this.strip.onNow = () => this.showNow();
    this.strip.onCompare = () => this.compare();
    this.strip.onRead = (older) => void this.read(older);
    this.strip.axis.onMove = (handle, timeS) => this.scrub(handle, timeS);
    this.strip.axis.onStep = (handle, by) => this.step(by, handle);
    this.comparison = new Comparison(api, info, look, scene.stage, scene.cells);
    this.preview = new RetractPreview(api, info, scene.stage);
    this.comparison.panel.onClose = () => this.compare();
    this.comparison.onFly = (view) => acts.fly(view);
    if (look.atS !== null) this.show(look.atS);
  }

  /** The map as it was at a time, by capture; null: now. */
  show(atS: number | null): void {
    const moment = atS === null ? null : this.timeline.momentAt(atS);
    this.ahead = undefined;
    this.look.atS = moment?.atS ?? null;
    if (this.look.sinceS !== null && atS !== null) this.look.sinceS = Math.min(this.look.sinceS, atS);
    this.cells.showMoment(moment);
    this.tell();
    this.acts.plan();
  }

  /** Take over what an address says. */
  follow(): void {
    this.show(this.look.atS);
  }

  /** Now, and nothing compared with it. */
  showNow(): void {
    this.look.sinceS = null;
    this.show(null);
  }

  /** Compare what is shown with the moment before it, or now with what is shown; or end that. */
  compare(): void {
    const { look } = this;
    if (look.sinceS !== null) {
      look.sinceS = null;
      return this.tell();
    }
    const { moments } = this.timeline;
    if (!moments.length) return this.acts.say("Nothing to compare: no commit states a time.");
    look.sinceS = look.atS ?? moments[Math.max(moments.length - 2, 0)]!.atS;
    this.show(null);
  }

  /** Earlier or later by so many moments; the last one is now. Of two handles the first is what is compared with. */
  step(by: number, handle = Infinity): void {
    const isFirst = handle === 0 && this.look.sinceS !== null;
    const next = this.next(isFirst ? this.look.sinceS : this.look.atS, by);
    if (isFirst) return this.since(next);
    this.show(next);
    if (Number.isFinite(by) && (next !== null || by < 0)) this.ahead = { atS: this.next(next, by) };
  }

  /** A moment is fetched that is not shown yet, or is about to be. */
  get isLookingAhead(): boolean {
    return this.ahead !== undefined || this.fetchesAhead > 0;
  }

  /** Moment so many further on; null: now. */
  private next(atS: number | null, by: number): number | null {
    const { moments } = this.timeline;
    const now = moments.length - 1;
    if (now < 0) return null;
    const key = atS === null ? "" : this.timeline.momentAt(atS).key;
    const same = moments.findIndex((moment) => moment.key === key);
    // Between two moments the next one is half a step away.
    const at = atS === null ? now : same >= 0 ? same : moments.filter((moment) => moment.atS <= atS).length - 0.5;
    const next = by > 0 ? Math.floor(at + by) : Math.ceil(at + by);
    return next >= now ? null : moments[Math.max(next, 0)]!.atS;
  }

  /** Compare with a moment, not later than the one that is shown. */
  private since(atS: number | null): void {
    const latestS = this.look.atS ?? this.timeline.moments[this.timeline.moments.length - 1]?.atS ?? Infinity;
    this.look.sinceS = Math.min(atS ?? latestS, latestS);
    this.tell();
  }

  /** Bring the axis up to date, and begin to look ahead; a few times a second. */
  tick(): void {
    this.tell();
    this.comparison.tick();
    if (this.ahead && !this.cells.waiting && !this.cells.needsPlan) void this.lookAhead(this.ahead.atS);
  }

  private async lookAhead(atS: number | null): Promise<void> {
    this.ahead = undefined;
    this.fetchesAhead++;
    try {
      await this.cells.lookAhead(atS === null ? null : this.timeline.momentAt(atS));
    } catch {
      // The step that shows it asks again, and says why it is not there.
    } finally {
      this.fetchesAhead--;
    }
  }

  dispose(): void {
    this.strip.dispose();
    this.comparison.dispose();
    this.preview.dispose();
  }

  /** Words that the past is shown, and how much of it is unknown; empty: now is shown. */
  get words(): string {
    const { atS } = this.look;
    if (atS === null) return "";
    const lacking = this.cells.lacking;
    const gaps = lacking ? ` ${lacking} of ${this.cells.all.size} cells are not known then: ${this.cells.unknown ?? ""}.` : "";
    return `The map as it was ${momentText(atS, this.info.epoch_s ?? null)}, without what was taken out since. Robots, findings and ages are of now.${gaps}`;
  }

  /** The moment that is shown, in words; empty: now. */
  get moment(): string {
    const { atS } = this.look;
    return atS === null ? "" : `as it was ${momentText(atS, this.info.epoch_s ?? null)}`;
  }

  private tell(): void {
    const { atS, sinceS } = this.look;
    const text = (timeS: number | null) => momentText(timeS, this.info.epoch_s ?? null);
    const shown = { timeS: atS, says: atS === null ? "now" : `as it was ${text(atS)}` };
    const handles = sinceS === null ? [{ name: "Moment", ...shown }] : [{ name: "A", timeS: sinceS, says: text(sinceS) }, { name: "B", ...shown, says: text(atS) }];
    this.strip.tell({ handles, total: this.cells.head, isReading: this.isReading });
  }

  /** Move a handle to the last moment at or before a time, once a frame. */
  private scrub(handle: number, timeS: number | null): void {
    const isWaiting = this.wanted !== null;
    this.wanted = { handle, atS: timeS };
    if (isWaiting) return;
    requestAnimationFrame(() => {
      const { handle: moved, atS } = this.wanted!;
      this.wanted = null;
      const at = atS === null ? null : (this.timeline.moments.findLast((moment) => moment.atS <= atS + 1e-6)?.atS ?? atS);
      if (moved === 0 && this.look.sinceS !== null) this.since(at);
      else this.show(at);
    });
  }

  private open(entry: LogEntry): void {
    openCommit(this.api, this.info.name, entry, {
      mayRetract: this.acts.isOperator(), out: this.timeline.takenOut(entry.id),
      preview: async (body) => {
        if (body) {
          this.showNow(); // what goes, goes from the map as it is
          return this.preview.show(body);
        }
        this.preview.hide();
        return "";
      },
    });
  }

  /** Read entries of the log before or after those that are here. */
  private async read(older: boolean): Promise<void> {
    if (this.isReading) return;
    this.isReading = true;
    this.tell();
    try {
      const { firstSeq, lastSeq } = this.timeline;
      const end = older ? firstSeq - 1 : Infinity;
      // A page ends early where its entries name very many commits: on to where the known ones begin.
      for (let after = older ? Math.max(firstSeq - 1 - PAGE, 0) : lastSeq; after < end; ) {
        const entries = await this.api.json<LogEntry[]>(`maps/${this.info.name}/log?after=${after}&limit=${PAGE}`);
        if (!entries.length) break;
        this.strip.add(entries, older);
        this.book.add(entries);
        after = entries[entries.length - 1]!.seq;
        if (!older) break;
      }
    } catch (error) {
      this.acts.say((error as Error).message);
    } finally {
      this.isReading = false;
      this.tell();
    }
  }
}
