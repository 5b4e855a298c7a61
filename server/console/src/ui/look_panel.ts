/** What is cut off and what stands out: slice, clip box, probability, isotherm band. */

import type { Box3 } from "three";
import { h } from "../dom.ts";
import type { Look } from "../look.ts";
import type { Triple } from "../messages.ts";
import { metres } from "../units.ts";

export class LookPanel {
  readonly element: HTMLElement;
  onChange: () => void = () => {};
  /** What the view shows now, as a box: for "clip to what is in view". */
  boxInView: () => Box3 | null = () => null;
  private readonly look: Look;
  private readonly floor: HTMLInputElement;
  private readonly ceiling: HTMLInputElement;
  private readonly least: HTMLInputElement;
  private readonly floorSaid = h("output", { for: "floor" });
  private readonly ceilingSaid = h("output", { for: "ceiling" });
  private readonly leastSaid = h("output", { for: "least" });
  private readonly bandOn = h("input", { type: "checkbox", id: "band-on" });
  private readonly bandLow = h("input", { type: "number", step: "0.5", value: "30", "aria-label": "Band from, °C" });
  private readonly bandHigh = h("input", { type: "number", step: "0.5", value: "45", "aria-label": "Band to, °C" });
  private readonly clip = h("button", { type: "button", id: "clip" });
  private readonly grid = h("input", { type: "checkbox", id: "grid" });
  private readonly boxes = h("input", { type: "checkbox", id: "boxes" });
  private lowM = 0;
  private highM = 1;

  constructor(look: Look) {
    this.look = look;
    const slider = (id: string) => h("input", { type: "range", id, min: "0", max: "200", step: "1" });
    this.floor = slider("floor");
    this.ceiling = slider("ceiling");
    this.least = h("input", { type: "range", id: "least", min: "0", max: "1", step: "0.01" });
    for (const input of [this.floor, this.ceiling, this.least]) input.addEventListener("input", () => this.take());
    for (const input of [this.bandOn, this.bandLow, this.bandHigh, this.grid, this.boxes]) {
      input.addEventListener("change", () => this.take());
    }
    this.clip.addEventListener("click", () => this.toggleClip());
    const row = (label: string, input: HTMLInputElement, said: HTMLElement) =>
      h("div", { class: "slider" }, h("label", { for: input.id }, label), input, said);
    this.element = h(
      "section", { "aria-label": "Look" },
      h("h2", {}, "Look"),
      row("Ceiling", this.ceiling, this.ceilingSaid),
      row("Floor", this.floor, this.floorSaid),
      row("p at least", this.least, this.leastSaid),
      h(
        "div", { class: "band" },
        h("label", { class: "check" }, this.bandOn, " Only"), this.bandLow, h("span", {}, "to"), this.bandHigh, h("span", {}, "°C"),
      ),
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

  /** Move the ceiling by one step of 10 cm. */
  step(up: boolean): void {
    const now = this.look.ceilingM ?? this.highM;
    const next = now + (up ? 0.1 : -0.1);
    this.look.ceilingM = next >= this.highM ? null : toMillimetre(Math.max(next, this.lowM));
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
    if (look.band) [this.bandLow.value, this.bandHigh.value] = look.band.map(String) as [string, string];
    this.grid.checked = look.cells;
    this.boxes.checked = look.boxes === true;
    this.clip.textContent = look.clip ? "Unclip" : "Clip to what is in view";
    this.clip.setAttribute("aria-pressed", String(look.clip !== null));
    this.say();
  }

  private say(): void {
    const { look } = this;
    this.floorSaid.textContent = look.floorM === null ? "all" : metres(look.floorM);
    this.ceilingSaid.textContent = look.ceilingM === null ? "all" : metres(look.ceilingM);
    this.leastSaid.textContent = look.minP === 0 ? "all" : look.minP.toFixed(2);
  }

  private take(): void {
    const { look } = this;
    const metresOf = (input: HTMLInputElement) => toMillimetre(this.lowM + (Number(input.value) / 200) * (this.highM - this.lowM));
    look.floorM = this.floor.value === "0" ? null : metresOf(this.floor);
    look.ceilingM = this.ceiling.value === "200" ? null : metresOf(this.ceiling);
    look.minP = Number(this.least.value);
    const band = [this.bandLow, this.bandHigh].map((input) => Number(input.value)) as [number, number];
    look.band = this.bandOn.checked && band[0] <= band[1] ? band : null;
    look.cells = this.grid.checked;
    look.boxes = this.boxes.checked;
    this.say();
    this.onChange();
  }

  private toggleClip(): void {
    const box = this.look.clip ? null : this.boxInView();
    this.look.clip = box && [box.min.toArray().map(toMillimetre) as Triple, box.max.toArray().map(toMillimetre) as Triple];
    this.show();
    this.onChange();
  }
}

/** What is typed again in a terminal has no more digits than it needs. */
function toMillimetre(metresExactly: number): number {
  return Math.round(metresExactly * 1000) / 1000;
}
