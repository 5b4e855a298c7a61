/** The time axis: how densely commits lie, a lane for each robot, folded gaps, and handles for the moments that are shown.
 *
 * Only what is in sight is drawn, however far one zooms in: the pictures stay where they are while their scroller moves. */

import { fill, h, svg } from "../../dom.ts";
import { robotColour } from "../../palettes.ts";
import type { Commit } from "../../timeline.ts";
import { clockTime, counted, duration } from "../../units.ts";
import { clustersOf, densityOf, type Cluster } from "./clusters.ts";
import { markOf } from "./commit_mark.ts";
import { TimeScale } from "./time_scale.ts";

const LANE_PX = 14;
const NAME_PX = 84;
/** Right of the last commit lies now. */
const NOW_PX = 40;
const TOP_PX = 30;
const DENSITY_PX = 12;
const BIN_PX = 4;
const TICK_PX = 110;
const ZOOM_MAX = 5000;

/** A moment that a handle stands at; null: now. */
export interface Handle {
  readonly name: string;
  readonly timeS: number | null;
  readonly says: string;
}

export class TimeAxis {
  readonly element = h("div", { class: "axis" });
  onChoose: (commits: readonly Commit[]) => void = () => {};
  /** A handle was moved to a time; null: to now. */
  onMove: (handle: number, timeS: number | null) => void = () => {};
  /** A handle was moved by keys, by so many moments. */
  onStep: (handle: number, by: number) => void = () => {};
  zoom = 1;
  private commits: readonly Commit[] = [];
  private names: readonly string[] = [];
  private handles: readonly Handle[] = [];
  private scale = new TimeScale([]);
  private clusters: readonly Cluster[] = [];
  private readonly top = svg("svg", { class: "ticks", height: TOP_PX, role: "group", "aria-label": "Time" });
  private readonly lanes = svg("svg", { class: "lanes", role: "group", "aria-label": "Log of the map" });
  private readonly spacer = h("div", { class: "spacer" });
  /** Commit that the Tab key leads to: arrows go on from it. */
  private reached: string | null = null;
  private dragged: number | null = null;
  private waiting = false;
  private readonly resizes: ResizeObserver;

  constructor() {
    this.spacer.append(this.top, this.lanes);
    this.element.append(this.spacer);
    this.element.addEventListener("scroll", () => this.drawSoon());
    this.element.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    this.element.addEventListener("pointerdown", (event) => this.grab(event));
    this.element.addEventListener("pointermove", (event) => this.dragged !== null && this.drag(event));
    for (const end of ["pointerup", "pointercancel"]) this.element.addEventListener(end, () => (this.dragged = null));
    this.lanes.addEventListener("keydown", (event) => this.goOn(event as KeyboardEvent));
    this.resizes = new ResizeObserver(() => this.drawSoon());
    this.resizes.observe(this.element);
  }

  dispose(): void {
    this.resizes.disconnect();
  }

  /** `commits` rising in time; `names`: robots whose colours are the same everywhere on the page. */
  show(commits: readonly Commit[], names: readonly string[]): void {
    const atEnd = this.element.scrollLeft + this.element.clientWidth >= this.element.scrollWidth - 40;
    this.commits = commits;
    this.names = names;
    this.scale = new TimeScale(commits.map(({ timeS }) => timeS));
    this.drawSoon();
    if (atEnd) this.element.scrollLeft = this.element.scrollWidth;
  }

  place(handles: readonly Handle[]): void {
    this.handles = handles;
    this.drawSoon();
  }

  /** Zoom by a factor, around what is at so many px of the element, or in its middle. */
  zoomBy(factor: number, aroundPx = this.element.clientWidth / 2): void {
    const place = this.placeAt(aroundPx);
    this.zoom = Math.min(Math.max(this.zoom * factor, 1), ZOOM_MAX);
    this.spacer.style.width = `${this.widthPx}px`;
    this.element.scrollLeft = this.pxOf(place) - aroundPx;
    this.drawSoon();
  }

  /** As close as some commits fill a good part of the axis. */
  zoomTo(commits: readonly Commit[]): void {
    const [from, to] = [commits[0]!, commits[commits.length - 1]!].map(({ timeS }) => this.scale.place(timeS)) as [number, number];
    this.zoom = Math.min(Math.max(0.6 / Math.max(to - from, 1e-9), 1), ZOOM_MAX);
    this.spacer.style.width = `${this.widthPx}px`;
    this.element.scrollLeft = this.pxOf((from + to) / 2) - this.element.clientWidth / 2;
    this.drawSoon();
  }

  private get widthPx(): number {
    return Math.max(this.element.clientWidth, 200) * this.zoom;
  }

  private pxOf(place: number): number {
    return NAME_PX + 8 + place * (this.widthPx - NAME_PX - NOW_PX - 16);
  }

  /** Px in the picture. */
  private xOf(timeS: number): number {
    return this.pxOf(this.scale.place(timeS)) - this.element.scrollLeft;
  }

  private xOfHandle({ timeS }: Handle): number {
    return timeS === null ? this.pxOf(1) + NOW_PX / 2 - this.element.scrollLeft : this.xOf(timeS);
  }

  private placeAt(px: number): number {
    return (px + this.element.scrollLeft - this.pxOf(0)) / Math.max(this.pxOf(1) - this.pxOf(0), 1);
  }

  private drawSoon(): void {
    if (!this.waiting) requestAnimationFrame(() => this.draw());
    this.waiting = true;
  }

  private draw(): void {
    this.waiting = false;
    const width = Math.max(this.element.clientWidth, 200);
    const robots = [...new Set(this.commits.map(({ robot }) => robot))].sort();
    const height = Math.max(robots.length, 1) * LANE_PX + 6;
    this.spacer.style.width = `${this.widthPx}px`;
    for (const [picture, tall] of [[this.top, TOP_PX], [this.lanes, height]] as const) {
      picture.setAttribute("width", String(width));
      picture.setAttribute("height", String(tall));
    }
    const laneOf = new Map(robots.map((name, n) => [name, n * LANE_PX + LANE_PX / 2 + 3]));
    const inSight = (x: number) => x > NAME_PX - 20 && x < width + 20;
    this.clusters = clustersOf(this.commits.filter(({ timeS }) => inSight(this.xOf(timeS))), ({ timeS }) => this.xOf(timeS));
    const focused = document.activeElement instanceof SVGElement && this.lanes.contains(document.activeElement);
    fill(this.top, ...this.ticks(width), ...this.density(width), ...this.handles.map((handle, n) => this.handle(handle, n, width)));
    fill(
      this.lanes,
      ...robots.map((name) => svg("line", { x1: NAME_PX, x2: width, y1: laneOf.get(name)!, y2: laneOf.get(name)!, class: "rail" })),
      ...this.scale.folds.map(({ begin, end }) => this.fold(begin, end, height)),
      ...this.handles.map((handle) => line(this.xOfHandle(handle), 0, height, "cursor")),
      ...this.marks(laneOf),
      svg("rect", { x: 0, y: 0, width: NAME_PX - 2, height, class: "names" }),
      ...robots.map((name) => svg("text", { x: 4, y: laneOf.get(name)! + 4, class: "lane" }, name)),
    );
    if (focused) this.lanes.querySelector<SVGElement>("[tabindex='0']")?.focus();
  }

  private marks(laneOf: ReadonlyMap<string, number>): SVGElement[] {
    const until = this.handles[this.handles.length - 1]?.timeS ?? Infinity;
    const reached = this.clusters.find(({ commits }) => commits.some(({ id }) => id === this.reached)) ?? this.clusters[this.clusters.length - 1];
    return this.clusters.map((cluster) => {
      const mark = markOf(cluster, laneOf.get(cluster.robot)!, robotColour(cluster.robot, this.names));
      mark.setAttribute("tabindex", cluster === reached ? "0" : "-1");
      if (cluster.commits[0]!.timeS > until) mark.classList.add("later");
      const choose = () => {
        this.reached = cluster.commits[0]!.id;
        this.onChoose(cluster.commits);
      };
      mark.addEventListener("click", choose);
      mark.addEventListener("keydown", (event) => {
        if ((event as KeyboardEvent).key !== "Enter") return;
        event.preventDefault(); // else it presses the button that the dialog puts the focus on
        choose();
      });
      mark.addEventListener("focus", () => (this.reached = cluster.commits[0]!.id));
      mark.dataset.first = cluster.commits[0]!.id;
      return mark;
    });
  }

  /** Arrows lead from mark to mark. */
  private goOn(event: KeyboardEvent): void {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    const at = this.clusters.findIndex(({ commits }) => commits[0]!.id === (event.target as SVGElement).dataset.first);
    if (by === undefined || at < 0) return;
    event.stopPropagation();
    event.preventDefault();
    const next = this.clusters[at + by];
    if (!next) return void (this.element.scrollLeft += by * 100);
    [...this.lanes.querySelectorAll<SVGElement>("[data-first]")].find(({ dataset }) => dataset.first === next.commits[0]!.id)?.focus();
  }

  private ticks(width: number): SVGElement[] {
    if (!this.commits.length) return [];
    const [from, to] = [this.placeAt(NAME_PX), this.placeAt(width)];
    const times = this.scale.ticks(Math.max(from, 0), Math.min(to, 1), Math.max(Math.floor((width - NAME_PX) / TICK_PX), 1));
    const nowX = this.pxOf(1) + NOW_PX / 2 - this.element.scrollLeft;
    // The most telling first: what would lie over another is left out.
    const taken: [number, number][] = [];
    const label = (x: number, text: string): SVGElement[] => {
      const half = text.length * 3.2 + 4;
      if (x - half < NAME_PX || x - half > width || taken.some(([low, high]) => x - half < high && x + half > low)) return [];
      taken.push([x - half, x + half]);
      return [svg("text", { x, y: 11, class: "time", "text-anchor": "middle" }, text)];
    };
    const now = label(nowX, "now");
    const folds = this.scale.folds.flatMap(({ begin, end, lengthS }) => label(this.pxOf((begin + end) / 2) - this.element.scrollLeft, `⋯ ${duration(lengthS)} ⋯`));
    const found = times.flatMap((timeS) => {
      const x = this.xOf(timeS);
      return x < NAME_PX ? [] : [line(x, TOP_PX - 5, TOP_PX, "tick"), ...label(x, clockTime(timeS))];
    });
    return [...now, ...folds, ...found];
  }

  /** Bars: how many commits lie where, of the most. */
  private density(width: number): SVGElement[] {
    const bins = Math.floor((width - NAME_PX) / BIN_PX);
    const counts = densityOf(this.commits, ({ timeS }) => (this.xOf(timeS) - NAME_PX) / (width - NAME_PX), bins);
    const most = counts.reduce((a, b) => Math.max(a, b), 1);
    const path = [...counts].map((count, n) => {
      const tall = count ? Math.max((count / most) * DENSITY_PX, 2) : 0;
      return count ? `M${NAME_PX + n * BIN_PX} ${TOP_PX}v${-tall}h${BIN_PX - 1}v${tall}z` : "";
    });
    return [svg("path", { d: path.join(""), class: "density" }, svg("title", {}, `${counted(most, "commit", "commits")} where most lie`))];
  }

  private fold(begin: number, end: number, height: number): SVGElement {
    const [x, to] = [begin, end].map((place) => this.pxOf(place) - this.element.scrollLeft) as [number, number];
    return svg("rect", { x, y: 0, width: Math.max(to - x, 1), height, class: "fold" });
  }

  private handle(handle: Handle, n: number, width: number): SVGElement {
    const x = this.xOfHandle(handle);
    const grip = svg(
      "g",
      {
        class: "handle", tabindex: 0, role: "slider", "aria-label": handle.name, "aria-valuemin": 0, "aria-valuemax": 100,
        "aria-valuenow": Math.round(100 * (handle.timeS === null ? 1 : this.scale.place(handle.timeS))), "aria-valuetext": handle.says,
      },
      svg("rect", { x: x - 12, y: 0, width: 24, height: TOP_PX, fill: "transparent" }),
      svg("path", { d: `M${x - 7} 14h14v7l-7 7l-7 -7z` }),
      ...(handle.name.length === 1 ? [svg("text", { x, y: 23, "text-anchor": "middle" }, handle.name)] : []),
      svg("title", {}, `${handle.name}: ${handle.says}`),
    );
    if (x < NAME_PX - 12 || x > width + 12) grip.setAttribute("visibility", "hidden");
    grip.addEventListener("pointerdown", (event) => this.grab(event as PointerEvent, n));
    grip.addEventListener("keydown", (event) => {
      const { key } = event as KeyboardEvent;
      const by = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, Home: -Infinity, End: Infinity }[key];
      if (by === undefined) return;
      event.stopPropagation();
      event.preventDefault();
      this.onStep(n, by);
      requestAnimationFrame(() => requestAnimationFrame(() => this.top.querySelectorAll<SVGElement>(".handle")[n]?.focus()));
    });
    return grip;
  }

  /** On a handle: drag it; on the free axis: bring the nearest one there. */
  private grab(event: PointerEvent, handle: number | null = null): void {
    event.stopPropagation();
    const target = event.target as Element;
    if (event.button !== 0 || target.closest(".commit, .names, .lane") || !(target.closest("svg"))) return;
    // In the lanes a finger scrolls.
    if (event.pointerType === "touch" && handle === null && !target.closest(".ticks")) return;
    const x = event.clientX - this.element.getBoundingClientRect().left;
    const away = this.handles.map((each) => Math.abs(this.xOfHandle(each) - x));
    this.dragged = handle ?? away.indexOf(Math.min(...away));
    this.element.setPointerCapture(event.pointerId);
    this.drag(event);
  }

  private drag(event: PointerEvent): void {
    const place = this.placeAt(event.clientX - this.element.getBoundingClientRect().left);
    const isNow = place > 1 + NOW_PX / 4 / Math.max(this.pxOf(1) - this.pxOf(0), 1);
    this.onMove(this.dragged!, isNow ? null : this.scale.time(Math.min(Math.max(place, 0), 1)));
  }

  private wheel(event: WheelEvent): void {
    if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) return;
    event.preventDefault();
    this.zoomBy(event.deltaY < 0 ? 1.25 : 0.8, event.clientX - this.element.getBoundingClientRect().left);
  }
}

function line(x: number, from: number, to: number, kind: string): SVGElement {
  return svg("line", { x1: x, x2: x, y1: from, y2: to, class: kind });
}
