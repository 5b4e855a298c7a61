/** What is cut off and what stands out: slice, clip box, probability, isotherm band. */

import type { Box3 } from "three";
import { fill, h } from "../dom.ts";
import type { Look } from "../look.ts";
import type { Triple } from "../messages.ts";
import { metres } from "../units.ts";

const SHUT = "The floor lies over the ceiling: nothing is shown.";

export class LookPanel {
  readonly element: HTMLElement;
  onChange: () => void = () => {};
  /** What the view shows now, as a box: for "clip to what is in view". */
  boxInView: () => Box3 | null = () => null;
  /** A storey alone, from the lowest; -1: all. */
  onStorey: (storey: number) => void = () => {};
  private readonly look: Look;
  private readonly floor: HTMLInputElement;
  private readonly ceiling: HTMLInputElement;
  private readonly least: HTMLInputElement;
  private readonly floorSaid = h("output", { for: "floor" });
  private readonly ceilingSaid = h("output", { for: "ceiling" });
  private readonly leastSaid = h("output", { for: "least" });
  private readonly bandOn = h("input", { type: "checkbox", id: "band-on" });
  private readonly bandLow = h("input", { type: "number", step: "0.5", value: "30", "aria-label": "Band from, °C" });
  private readonly bandHigh = h("input", { type: "number", step: "0.5", placeholder: "any", "aria-label": "Band to, °C; empty: no upper end" });
  private readonly wrong = h("p", { class: "error", role: "alert" });
  private readonly zero = h("p", { class: "hint" });
  private readonly storeys = h("div", { class: "buttons", role: "group", "aria-label": "Storey" });
  private readonly clip = h("button", { type: "button", id: "clip" });
  private readonly grid = h("input", { type: "checkbox", id: "grid" });
  private readonly boxes = h("input", { type: "checkbox", id: "boxes" });
  private floorsM: readonly number[] = [];
  private lowM = 0;
  private highM = 1;

  constructor(look: Look) {
    this.look = look;
    const slider = (id: string) => h("input", { type: "range", id, min: "0", max: "200", step: "1" });
    this.floor = slider("floor");
    this.ceiling = slider("ceiling");
    this.least = h("input", { type: "range", id: "least", min: "0", max: "1", step: "0.01" });
    this.ceiling.addEventListener("input", () => this.takeCeiling());
    this.floor.addEventListener("input", () => this.takeFloor());
    this.least.addEventListener("input", () => this.take());
    for (const input of [this.bandOn, this.bandLow, this.bandHigh]) input.addEventListener("change", () => this.takeBand());
    for (const input of [this.grid, this.boxes]) input.addEventListener("change", () => this.take());
    this.clip.addEventListener("click", () => this.toggleClip());
    const row = (label: string, input: HTMLInputElement, said: HTMLElement) =>
      h("div", { class: "slider" }, h("label", { for: input.id }, label), input, said);
    this.element = h(
      "section", { "aria-label": "Look" },
      h("h2", {}, "Look"),
      row("Ceiling", this.ceiling, this.ceilingSaid),
      row("Floor", this.floor, this.floorSaid),
      this.zero, this.storeys,
      row("Certainty", this.least, this.leastSaid),
      h(
        "div", { class: "band" },
        h("label", { class: "check" }, this.bandOn, " Only"), this.bandLow, h("span", {}, "to"), this.bandHigh, h("span", {}, "°C"),
      ),
      this.wrong,
      h(
        "div", { class: "checks" },
        h("label", { class: "check" }, this.grid, " Cell borders"), h("label", { class: "check" }, this.boxes, " Cubes"),
      ),
      this.clip,
    );
    this.show();
  }

  /** Heights that the sliders span; m. */
  span(lowM: number, highM: number): void {
    if (Math.abs(lowM - this.lowM) < 0.01 && Math.abs(highM - this.highM) < 0.01) return;
    this.lowM = lowM;
    this.highM = Math.max(highM, lowM + 0.1);
    this.show();
  }

  /** Upper faces of the map's floors, m; heights are those over the lowest one. */
  stories(floorsM: readonly number[]): void {
    if (floorsM.join() === this.floorsM.join()) return;
    this.floorsM = floorsM;
    this.zero.textContent = floorsM.length ? "Heights are over the floor." : "Heights are those of the map's frame.";
    const named = [...floorsM.entries()].reverse();
    const button = (label: string, n: number) => h("button", { type: "button", "data-storey": String(n), onclick: () => this.onStorey(n) }, label);
    fill(this.storeys, ...(floorsM.length > 1 ? [button("All storeys", -1), ...named.map(([n, z]) => button(storeyName(n, z - floorsM[0]), n))] : []));
    this.show();
  }

  /** Height that is told as 0, m in the map. */
  get zeroM(): number {
    return this.floorsM[0] ?? 0;
  }

  /** Move the ceiling by one step of 10 cm. */
  step(up: boolean): void {
    const now = this.look.ceilingM ?? this.highM;
    const next = now + (up ? 0.1 : -0.1);
    this.look.ceilingM = next >= this.highM ? null : toMillimetre(Math.max(next, this.lowM));
    this.look.isCeilingChosen = true;
    this.show();
    this.onChange();
  }

  /** Controls as the look is. */
  show(): void {
    const { look } = this;
    const at = (value: number) => String(Math.round(((value - this.lowM) / (this.highM - this.lowM)) * 200));
    this.floor.value = look.floorM === null ? "0" : at(look.floorM);
    this.ceiling.value = look.ceilingM === null ? "200" : at(look.ceilingM);
    this.least.value = String(look.minP);
    this.bandOn.checked = look.band !== null;
    if (look.band) [this.bandLow.value, this.bandHigh.value] = look.band.map((end) => String(end ?? "")) as [string, string];
    this.grid.checked = look.cells;
    this.boxes.checked = look.boxes === true;
    this.clip.textContent = look.clip ? "Unclip" : "Clip to what is in view";
    this.clip.setAttribute("aria-pressed", String(look.clip !== null));
    this.say();
  }

  private say(): void {
    const { look } = this;
    this.floorSaid.textContent = look.floorM === null ? "all" : metres(look.floorM - this.zeroM);
    this.ceilingSaid.textContent = look.ceilingM === null ? "all" : metres(look.ceilingM - this.zeroM);
    const isShut = look.floorM !== null && look.ceilingM !== null && look.floorM >= look.ceilingM;
    if (isShut || this.wrong.textContent === SHUT) this.wrong.textContent = isShut ? SHUT : "";
    this.leastSaid.textContent = look.minP === 0 ? "all" : look.minP.toFixed(2);
  }

  private take(): void {
    const { look } = this;
    look.minP = Number(this.least.value);
    look.cells = this.grid.checked;
    look.boxes = this.boxes.checked;
    this.say();
    this.onChange();
  }

  private takeFloor(): void {
    this.look.floorM = this.floor.value === "0" ? null : this.metresOf(this.floor);
    this.take();
  }

  private takeCeiling(): void {
    this.look.ceilingM = this.ceiling.value === "200" ? null : this.metresOf(this.ceiling);
    this.look.isCeilingChosen = true;
    this.take();
  }

  private metresOf(input: HTMLInputElement): number {
    return toMillimetre(this.lowM + (Number(input.value) / 200) * (this.highM - this.lowM));
  }

  /** An end that is no number, or a lower end over the upper one, changes nothing but what is said. */
  private takeBand(): void {
    const from = this.bandLow.valueAsNumber;
    const to = this.bandHigh.value === "" ? null : this.bandHigh.valueAsNumber;
    const isWrong = Number.isNaN(from) || (to !== null && !(from <= to));
    this.wrong.textContent = this.bandOn.checked && isWrong ? "The band begins above its end: it is left as it was." : "";
    if (this.bandOn.checked && isWrong) return;
    this.look.band = this.bandOn.checked ? [from, to] : null;
    this.take();
  }

  private toggleClip(): void {
    const box = this.look.clip ? null : this.boxInView();
    this.look.clip = box && [box.min.toArray().map(toMillimetre) as Triple, box.max.toArray().map(toMillimetre) as Triple];
    this.show();
    this.onChange();
  }
}

export function storeyName(storey: number, overM: number): string {
  return storey === 0 ? "Lowest" : `+${overM.toFixed(1)} m`;
}

/** What is typed again in a terminal has no more digits than it needs. */
function toMillimetre(metresExactly: number): number {
  return Math.round(metresExactly * 1000) / 1000;
}
