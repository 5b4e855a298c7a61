/** The log as a strip: an axis of time with a lane for each robot, and the moment at which the map is shown. */

import { fill, h } from "../dom.ts";
import type { LogEntry } from "../messages.ts";
import type { Commit, Timeline } from "../timeline.ts";
import { clock, counted, thousands } from "../units.ts";
import { openList } from "./time/commit_list.ts";
import { TimeAxis, type Handle } from "./time/time_axis.ts";

/** Entries that are read at first. */
export const SHOWN = 240;

/** What the strip shows besides the commits. */
export interface StripState {
  readonly handles: readonly Handle[];
  /** Entries of the whole log. */
  readonly total: number;
  readonly isReading: boolean;
}

export class CommitStrip {
  readonly element: HTMLElement;
  readonly axis = new TimeAxis();
  onChoose: (entry: LogEntry) => void = () => {};
  /** Earlier or later by one moment. */
  onStep: (by: number) => void = () => {};
  onNow: () => void = () => {};
  onCompare: () => void = () => {};
  /** Read entries that are older, or newer, than those that are here. */
  onRead: (older: boolean) => void = () => {};
  private names: readonly string[] = [];
  private readonly timeline: Timeline;
  private readonly said = h("output", { class: "moment", "aria-live": "polite" });
  private readonly count = h("span", { class: "hint" });
  private readonly older = press("", "Read older entries of the log", () => this.onRead(true));
  private readonly newer = press("", "Read newer entries of the log", () => this.onRead(false));
  private readonly back = press("◀", "Earlier by one commit (,)", () => this.onStep(-1));
  private readonly on = press("▶", "Later by one commit (.)", () => this.onStep(1));
  private readonly now = press("Now", "The map as it is now", () => this.onNow());
  private readonly compare = press("Compare", "What is different between two moments", () => this.onCompare());
  /** Buttons and words over the axis; the page may add to them. */
  readonly head = h("div", { class: "time-head" });
  private readonly none = h("p", { class: "hint" }, "No commits yet.");
  private waiting = false;
  private told = "";

  constructor(timeline: Timeline) {
    this.timeline = timeline;
    const zoom = [press("−", "Show more of the time", () => this.axis.zoomBy(0.5)), press("+", "Show less of the time, larger", () => this.axis.zoomBy(2))];
    this.head.append(this.back, this.on, this.now, this.said, this.count, this.older, this.newer, ...zoom, this.compare);
    this.element = h("section", { class: "strip", "aria-label": "Commits" }, this.head, this.none, this.axis.element);
    this.axis.onChoose = (commits) => this.choose(commits);
  }

  /** By number. */
  get entries(): Map<number, LogEntry> {
    return this.timeline.entries;
  }

  /** Robots of the team, whose colours are the same everywhere on the page. */
  show(names: readonly string[]): void {
    if (names.join() === this.names.join()) return;
    this.names = names;
    this.changed();
  }

  add(entries: readonly LogEntry[], keepsOld = false): void {
    this.timeline.add(entries, keepsOld);
    this.changed();
  }

  /** Forget all: the log may be another one. */
  forget(): void {
    this.timeline.forget();
    this.changed();
  }

  /** A few times a second: what stands at the axis, and in words. */
  tell({ handles, total, isReading }: StripState): void {
    const { firstSeq, lastSeq } = this.timeline;
    const text = JSON.stringify([handles, total, isReading, firstSeq, lastSeq, this.timeline.entries.size]);
    if (text === this.told) return;
    this.told = text;
    this.axis.place(handles);
    const [first] = handles;
    const isNow = handles.length === 1 && first!.timeS === null;
    this.said.textContent = handles.length > 1 ? `${handles[0]!.says} → ${handles[1]!.says}` : isNow ? "As it is now" : `A${first!.says.slice(1)}`;
    this.said.dataset.past = String(!isNow);
    this.now.disabled = isNow;
    this.compare.setAttribute("aria-pressed", String(handles.length > 1));
    const since = this.timeline.commits[0];
    const here = this.timeline.commits.length;
    fill(this.count, since ? `${thousands(here)} ${here === 1 ? "commit" : "commits"} since ${clock(since.timeS)}` : "");
    offer(this.older, Math.max(firstSeq - 1, 0), "older", isReading);
    offer(this.newer, Math.max(total - lastSeq, 0), "newer", isReading);
  }

  dispose(): void {
    this.axis.dispose();
  }

  private changed(): void {
    if (!this.waiting) requestAnimationFrame(() => this.draw());
    this.waiting = true;
  }

  private draw(): void {
    this.waiting = false;
    this.none.hidden = this.timeline.entries.size > 0;
    this.axis.element.hidden = !this.none.hidden;
    this.axis.show(this.timeline.commits, this.names);
  }

  private choose(commits: readonly Commit[]): void {
    if (commits.length === 1) return this.onChoose(commits[0]!.entry);
    openList(commits, { choose: ({ entry }) => this.onChoose(entry), zoom: () => this.axis.zoomTo(commits) });
  }
}

/** A moment in words; null: now. */
export function momentText(atS: number | null, epochS: number | null): string {
  if (atS === null) return "now";
  return `by ${clock(epochS ? (Math.floor(atS / epochS) + 1) * epochS : atS)}`;
}

function press(text: string, title: string, onclick: () => void): HTMLButtonElement {
  return h("button", { type: "button", title, "aria-label": title, onclick }, text);
}

function offer(button: HTMLButtonElement, count: number, which: string, isReading: boolean): void {
  button.hidden = count === 0;
  button.disabled = isReading;
  button.textContent = isReading ? "Reading …" : `Read ${counted(count, "entry", "entries")} ${which === "older" ? "before" : "after"}`;
  button.setAttribute("aria-label", button.textContent);
}
