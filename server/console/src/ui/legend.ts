/** What the colours mean: of the field that is shown, and of no other; its ends can be locked. */

import { fill, h } from "../dom.ts";
import { FIELDS, type Field, type Look } from "../look.ts";
import { robotColour, stopsOf } from "../palettes.ts";

/** How ages are told: the unit, how much of the range's own it is, and whether some cells are older than is known. */
export interface Ages {
  readonly unit: string;
  readonly size: number;
  readonly mayBeOlder: boolean;
}

export class Legend {
  readonly element = h("section", { class: "legend", "aria-label": "Legend" });
  onRange: (range: [number, number] | null) => void = () => {};
  private shown = "";

  /** `range` in the look's unit; null: nothing that is shown has this field. */
  show(look: Look, range: [number, number] | null, robots: readonly string[], ages: Ages): void {
    const locked = look.ranges[look.field] !== undefined;
    const state = JSON.stringify([look.field, range?.map((end) => end.toFixed(2)), locked, look.field === "robot" && robots, look.field === "age" && ages]);
    if (state === this.shown || this.element.contains(document.activeElement)) return;
    this.shown = state;
    const { label, palette, unit: ofField } = FIELDS.find(({ field }) => field === look.field)!;
    const isAge = look.field === "age";
    const { unit, size } = isAge ? ages : { unit: ofField, size: 1 };
    const bare = h("p", { class: "bare" }, h("span", { class: "hatch", "aria-hidden": "true" }), bareText(look.field));
    if (look.field === "robot") return fill(this.element, h("h2", {}, "Robot that changed the cell last"), ...robots.map((name) => named(name, robots)), bare);
    if (!palette) return fill(this.element, h("h2", {}, label), h("p", {}, "As the cameras saw it."), bare);
    if (!range) return fill(this.element, h("h2", {}, label), h("p", {}, `Nothing shown has a ${label.toLowerCase()}.`), bare);
    const title = isAge ? `Age, ${unit} before the newest measurement` : `${label}${unit ? `, ${unit}` : ""}`;
    const ends = range.map((end, n) =>
      h("input", {
        type: "number", step: "any", value: (end / size).toFixed(look.field === "probability" ? 2 : isAge && size === 1 ? 0 : 1),
        "aria-label": `${n ? "Upper" : "Lower"} end of the legend${unit ? `, ${unit}` : ""}`,
        onchange: () => this.onRange(ends.map((input) => size * Number(input.value)) as [number, number]),
      }),
    );
    const lock = h(
      "button",
      {
        type: "button", "aria-pressed": String(locked),
        title: locked ? "Let the ends follow what is shown" : "Keep these ends",
        onclick: () => this.onRange(locked ? null : range),
      },
      locked ? "Locked" : "Auto",
    );
    fill(
      this.element, h("h2", {}, title), bar(stopsOf(palette), isAge),
      h("div", { class: "ends" }, ends[0], lock, ends[1]),
      look.field === "temperature" ? bare : null,
      isAge && ages.mayBeOlder ? h("p", {}, "or older: their commits are no longer loaded here") : null,
    );
  }
}

function bareText(field: Field): string {
  if (field === "robot") return "not known: taken out, or long ago";
  return field === "temperature" ? "no temperature was measured" : "no colour was measured";
}

function named(name: string, robots: readonly string[]): HTMLElement {
  const dot = h("span", { class: "dot", "aria-hidden": "true" });
  dot.style.background = robotColour(name, robots);
  return h("p", {}, dot, ` ${name}`);
}

/** A canvas, because a strict page takes no gradient in an attribute. */
function bar(stops: string[], reversed: boolean): HTMLCanvasElement {
  const canvas = h("canvas", { width: 240, height: 12, class: "ramp", "aria-hidden": "true" });
  const context = canvas.getContext("2d")!;
  const gradient = context.createLinearGradient(0, 0, canvas.width, 0);
  const order = reversed ? [...stops].reverse() : stops;
  order.forEach((stop, n) => gradient.addColorStop(n / (order.length - 1), stop));
  context.fillStyle = gradient;
  context.fillRect(0, 0, canvas.width, canvas.height);
  return canvas;
}
