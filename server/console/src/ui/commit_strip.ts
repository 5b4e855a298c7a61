/** The log as a strip: a lane for each robot, a dot for each commit; those taken out again are hollow. */

import { fill, h, svg } from "../dom.ts";
import { robotOf } from "../log_book.ts";
import type { LogEntry } from "../messages.ts";
import { robotColour } from "../palettes.ts";
import { bytes, clock } from "../units.ts";

/** Entries that are shown. */
export const SHOWN = 240;
const LANE_PX = 14;
const STEP_PX = 16;
const NAME_PX = 84;

export class CommitStrip {
  readonly element = h("section", { class: "strip", "aria-label": "Commits" });
  onChoose: (entry: LogEntry) => void = () => {};
  private names: readonly string[] = [];
  private readonly entries = new Map<number, LogEntry>();
  private waiting = false;

  /** Robots of the team, whose colours are the same everywhere on the page. */
  show(names: readonly string[]): void {
    if (names.join() === this.names.join()) return;
    this.names = names;
    this.add([]);
  }

  add(entries: readonly LogEntry[]): void {
    for (const entry of entries) this.entries.set(entry.seq, entry);
    for (const seq of [...this.entries.keys()].sort((a, b) => a - b).slice(0, -SHOWN)) this.entries.delete(seq);
    if (!this.waiting) requestAnimationFrame(() => this.draw());
    this.waiting = true;
  }

  /** Forget all: the log may be another one. */
  forget(): void {
    this.entries.clear();
    this.add([]);
  }

  get robots(): string[] {
    return [...new Set([...this.entries.values()].map(({ id }) => robotOf(id)))].sort();
  }

  private draw(): void {
    this.waiting = false;
    const entries = [...this.entries.values()].sort((a, b) => a.seq - b.seq);
    const names = this.robots;
    const out = new Set(entries.filter(({ kind }) => kind === "-").map(({ id }) => id));
    const width = NAME_PX + entries.length * STEP_PX + 20;
    const lane = (id: string) => names.indexOf(robotOf(id)) * LANE_PX + LANE_PX / 2 + 3;
    const labels = names.map((name) => svg("text", { x: 4, y: lane(name) + 4, class: "lane" }, name));
    const lines = names.map((name) => svg("line", { x1: NAME_PX, x2: width, y1: lane(name), y2: lane(name), class: "rail" }));
    const dots = entries.map((entry, n) => this.dot(entry, NAME_PX + 8 + n * STEP_PX, lane(entry.id), out.has(entry.id)));
    const picture = svg(
      "svg", { width, height: Math.max(names.length, 1) * LANE_PX + 6, role: "group", "aria-label": "Log of the map" },
      ...lines, ...labels, ...dots,
    );
    const atEnd = this.element.scrollLeft + this.element.clientWidth >= this.element.scrollWidth - 40;
    fill(this.element, entries.length ? picture : h("p", { class: "hint" }, "No commits yet."));
    if (atEnd) this.element.scrollLeft = this.element.scrollWidth;
  }

  private dot(entry: LogEntry, x: number, y: number, isOut: boolean): SVGElement {
    const taken = entry.kind === "-";
    const said = `${taken ? "taken out" : isOut ? "commit, taken out later" : "commit"} ${entry.id}, ${entry.cells} cells, ${bytes(entry.size_bytes)}`;
    const when = entry.captured_s ? `, ${clock(entry.captured_s[1])}` : "";
    const colour = robotColour(robotOf(entry.id), this.names);
    const mark = taken
      ? svg("path", { d: `M${x - 4} ${y - 4}l8 8m0 -8l-8 8`, stroke: colour, "stroke-width": 2 })
      : svg("circle", { cx: x, cy: y, r: 5, fill: isOut ? "none" : colour, stroke: colour, "stroke-width": 2 });
    const target = svg("rect", { x: x - 8, y: y - 7, width: 16, height: 14, fill: "transparent" });
    const group = svg("g", { tabindex: 0, role: "button", "aria-label": said, class: "commit" }, target, mark, svg("title", {}, said + when));
    const choose = () => this.onChoose(entry);
    group.addEventListener("click", choose);
    group.addEventListener("keydown", (event) => {
      if ((event as KeyboardEvent).key === "Enter") choose();
    });
    return group;
  }
}
