/** Plan over the map, storey by storey, and a small one at the map's edge that tells where one looks from. */

import { fill, h } from "../dom.ts";
import type { Finding } from "../findings.ts";
import type { Heights } from "../heights.ts";
import type { Triple } from "../messages.ts";
import type { Cells } from "../scene/cells.ts";
import { floorPlanOf, slabOf, storeyAt, type FloorPlan } from "../scene/floor_plan.ts";
import type { Ground } from "../scene/ground.ts";
import { uniforms } from "../scene/materials.ts";
import type { Stage } from "../scene/stage.ts";
import { storeyName } from "./look_panel.ts";
import { drawPlan, fitOf, pixelOf, placeOf, type PlanInk, type PlanMarks } from "./plan_picture.ts";

/** Between two rasters of a map that changes, ms; a click so near to a finding is its; px. */
const AGAIN_MS = 1500;
const NEAR_PX = 16;
/** Pixels of a plan on paper to one of its words. */
const PAPER_RATIO = 1.4;

const NOTHING = "Nothing of this storey is in the map.";

/** Parts of the page that the plan shows, and its effects on the page. */
export interface PlanSource {
  ink(): PlanInk;
  findings(): readonly Finding[];
  robots(): PlanMarks["robots"];
  /** Fly to a finding, or over a place of a storey. */
  choose(id: string): void;
  go(place: Triple): void;
}

export class PlanPanel {
  readonly element = h("section", { class: "plan", "aria-label": "Plan", hidden: true });
  /** Small plan at the map's edge. */
  readonly small: HTMLButtonElement;
  private storey = 0;
  private isChosen = false;
  private plan: FloorPlan | null = null;
  private madeOf = "";
  private drawnOf = "";
  private nextMs = 0;
  private readonly canvas = h("canvas", { role: "img" });
  private readonly corner = h("canvas", { width: 150, height: 150 });
  private readonly said = h("p", { class: "hint", role: "status" });
  private readonly storeys = h("div", { class: "buttons", role: "group", "aria-label": "Storey of the plan" });
  private readonly stage: Stage;
  private readonly cells: Cells;
  private readonly ground: Ground;
  private readonly heights: Heights;
  private readonly source: PlanSource;

  constructor({ stage, cells, ground }: { stage: Stage; cells: Cells; ground: Ground }, heights: Heights, source: PlanSource) {
    this.stage = stage;
    this.cells = cells;
    this.ground = ground;
    this.heights = heights;
    this.source = source;
    this.small = h("button", { type: "button", class: "corner", title: "Plan of this storey (P)", "aria-label": "Small plan: open it", hidden: true, onclick: () => this.switch() }, this.corner);
    const close = h("button", { type: "button", onclick: () => this.switch() }, "Back to the map");
    fill(this.element, h("div", { class: "plan-head" }, this.storeys, close), h("div", { class: "plan-host" }, this.canvas), this.said);
    this.canvas.addEventListener("click", (event) => this.click(event));
  }

  get isOpen(): boolean {
    return !this.element.hidden;
  }

  /** Open on the storey that is looked at, or shut. */
  switch(): void {
    this.element.hidden = this.isOpen;
    this.isChosen = false;
    this.nextMs = 0;
    this.drawnOf = "";
    this.tick();
  }

  /** A few times a second: a new raster where the map changed, and what lies over it. */
  tick(): void {
    this.small.hidden = this.isOpen || !this.plan;
    if (!this.isOpen && this.plan && !this.small.checkVisibility()) return; // narrow pages have no room for it
    const { floorsM } = this.heights.storeys;
    if (!this.isChosen) this.storey = storeyAt(floorsM, this.stage.view.target[2]);
    const madeOf = JSON.stringify([this.cells.head, this.cells.momentKey, this.cells.drawn, this.ground.writes, uniforms.uMinP.value, floorsM, this.storey]);
    // A raster of all that is there takes the time of a frame or more: while a large map comes, none is made.
    const isComing = this.cells.isFetching || this.cells.waiting > 0 || this.cells.needsPlan;
    if (madeOf !== this.madeOf && performance.now() >= this.nextMs && !(isComing && !this.isOpen) && this.cells.firstPictureMs !== null) {
      this.madeOf = madeOf;
      this.nextMs = performance.now() + AGAIN_MS;
      this.plan = floorPlanOf(this.cells, floorsM, this.storey);
      this.drawnOf = "";
    }
    this.small.hidden = this.isOpen || !this.plan;
    const marks = this.marks(this.storey);
    const { clientWidth, clientHeight } = this.canvas.parentElement!;
    const ink = this.source.ink();
    const drawnOf = JSON.stringify([this.isOpen, ink, clientWidth, clientHeight, marks.view, marks.robots, marks.findings.map(({ id, number, state }) => [id, number, state])]);
    if (drawnOf === this.drawnOf) return;
    this.drawnOf = drawnOf;
    if (this.isOpen) this.draw(this.plan, ink, marks, floorsM, clientWidth, clientHeight);
    else if (this.plan) drawPlan(this.corner, this.plan, ink, marks, 1);
  }

  /** Plans of all storeys for a report, from the lowest: drawn for paper. */
  pictures(width: number, height: number): { name: string; canvas: HTMLCanvasElement; said: string }[] {
    const { floorsM } = this.heights.storeys;
    this.ground.finish();
    return (floorsM.length ? floorsM : [0]).flatMap((floorM, storey) => {
      const plan = floorPlanOf(this.cells, floorsM, storey);
      if (!plan) return [];
      const marks = { ...this.marks(storey), view: null };
      const canvas = h("canvas", { width, height, role: "img", "aria-label": said(plan, marks.findings.length) });
      drawPlan(canvas, plan, { ...this.source.ink(), theme: "light" }, marks, PAPER_RATIO);
      const name = floorsM.length > 1 ? storeyName(storey, floorM - floorsM[0]) : floorsM.length ? "The storey, to 2 m over its floor" : "All heights";
      const { waiting } = this.cells;
      return [{ name, canvas, said: waiting ? `${areas(plan)} ${waiting} cells of the map were still on their way.` : areas(plan) }];
    });
  }

  /** `plan`: null where nothing of the storey is in the map. */
  private draw(plan: FloorPlan | null, ink: PlanInk, marks: PlanMarks, floorsM: readonly number[], width: number, height: number): void {
    const ratio = devicePixelRatio;
    this.canvas.width = width * ratio;
    this.canvas.height = height * ratio; // which clears it
    if (plan) drawPlan(this.canvas, plan, ink, marks, ratio);
    this.canvas.setAttribute("aria-label", plan ? said(plan, marks.findings.length) : NOTHING);
    this.said.textContent = plan ? `${areas(plan)} Click to fly there.` : NOTHING;
    const button = (floorM: number, storey: number) => h(
      "button", { type: "button", "aria-pressed": String(storey === this.storey), onclick: () => this.turnTo(storey) }, storeyName(storey, floorM - floorsM[0]),
    );
    fill(this.storeys, ...(floorsM.length > 1 ? floorsM.map(button) : [h("strong", {}, "Plan")]));
  }

  private turnTo(storey: number): void {
    this.storey = storey;
    this.isChosen = true;
    this.nextMs = 0;
    this.tick();
  }

  /** Findings and robots in a storey's slab, and in the space above it up to the next floor. */
  private marks(storey: number): PlanMarks {
    const { floorsM } = this.heights.storeys;
    const isHere = (place: Triple) => floorsM.length < 2 || storeyAt(floorsM, place[2]) === storey;
    return {
      findings: this.source.findings().filter(({ place, state }) => state !== "dismissed" && isHere(place)),
      robots: this.source.robots().filter(({ place }) => isHere(place)), view: this.stage.view,
    };
  }

  private click({ offsetX, offsetY }: MouseEvent): void {
    const { plan } = this;
    if (!plan) return;
    const ratio = devicePixelRatio;
    const fit = fitOf(plan, this.canvas);
    const near = this.marks(this.storey).findings.map(({ id, place }) => {
      const [x, y] = pixelOf(plan, fit, place);
      return { id, offPx: Math.hypot(x / ratio - offsetX, y / ratio - offsetY) };
    }).sort((a, b) => a.offPx - b.offPx)[0];
    const [x, y] = placeOf(plan, fit, offsetX * ratio, offsetY * ratio);
    const [lowM] = slabOf(this.heights.storeys.floorsM, this.storey);
    this.switch();
    if (near && near.offPx <= NEAR_PX) this.source.choose(near.id);
    else this.source.go([x, y, Number.isFinite(lowM) ? lowM + 0.3 : this.stage.view.target[2]]);
  }
}

function areas({ seenM2, gapsM2, coarseM }: FloorPlan): string {
  if (gapsM2 === null) return `Coarse, ± ${Math.ceil(100 * coarseM)} cm: about ${seenM2.toFixed(0)} m² were seen, and gaps within it are not measured; striped: no surface was seen there.`;
  const gaps = gapsM2 >= 0.1 ? ` ${gapsM2.toFixed(1)} m² within it, in amber, were never seen.` : "";
  return `${seenM2.toFixed(0)} m² were seen; striped: no surface was seen there.${gaps}`;
}

function said(plan: FloorPlan, findings: number): string {
  return `Plan from straight above, x to the right, y up. ${areas(plan)} ${findings} findings.`;
}
