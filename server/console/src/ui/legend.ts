/** What the colours mean: of the field that is shown, and of no other; its ends can be locked. */

import { fill, h } from "../dom.ts";
import { KEPT } from "../log_book.ts";
import { FIELDS, type Field, type Look } from "../look.ts";
import { robotColour, stopsOf } from "../palettes.ts";
import { thousands } from "../units.ts";

/** What the log tells: the unit of ages, how much of the range's own it is, and how far back the log is known. */
export interface Told {
  readonly unit: string;
  readonly size: number;
  /** To all that is shown; not yet; or not so far. */
  readonly log: "whole" | "read" | "short";
}

const READING = "older entries of the log are being read";
const FAR = `before the newest ${thousands(KEPT)} entries of the log`;

export class Legend {
  readonly element = h("section", { class: "legend", "aria-label": "Legend" });
  onRange: (range: [number, number] | null) => void = () => {};
  private shown = "";
  private locked = false;

  /** `range` in the look's unit; null: nothing that is shown has this field. */
  show(look: Look, range: [number, number] | null, robots: readonly string[], told: Told): void {
    const locked = look.ranges[look.field] !== undefined;
    const state = JSON.stringify([look.field, range?.map((end) => end.toFixed(2)), locked, look.field === "robot" && robots, told]);
    const controls = () => [...this.element.querySelectorAll<HTMLElement>("input, button")];
    const focused = controls().indexOf(document.activeElement as HTMLElement);
    // Whoever types an end is not disturbed by one that follows what is shown.
    const isTyping = document.activeElement instanceof HTMLInputElement && focused >= 0;
    // Nor is a button replaced between press and release, which would be no click.
    const isPressed = this.element.querySelector("button:active") !== null;
    if (state === this.shown || isPressed || (isTyping && locked === this.locked)) return;
    this.shown = state;
    this.locked = locked;
    const { label, palette, unit: ofField } = FIELDS.find(({ field }) => field === look.field)!;
    const isAge = look.field === "age";
    const { unit, size } = isAge ? told : { unit: ofField, size: 1 };
    const bare = h("p", { class: "bare" }, h("span", { class: "hatch", "aria-hidden": "true" }), bareText(look.field, told));
    if (look.field === "robot") return fill(this.element, h("h2", {}, "Robot that added to the cell last"), ...robots.map((name) => named(name, robots)), bare);
    if (!palette) return fill(this.element, h("h2", {}, label), h("p", {}, "As the cameras saw it."), bare);
    if (!range) return fill(this.element, h("h2", {}, label), h("p", {}, `Nothing shown has a ${label.toLowerCase()}.`), bare);
    const title = isAge ? `Age, ${unit} before the newest measurement` : `${label}${unit ? `, ${unit}` : ""}`;
    const ends = range.map((end, n) =>
      h("input", {
        type: "number", step: "any", value: rounded(end / size, look.field === "probability" ? 2 : isAge && size === 1 ? 0 : 1),
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
      isAge && told.log !== "whole" ? h("p", {}, told.log === "read" ? READING : `or older: changed ${FAR}`) : null,
    );
    controls()[focused]?.focus();
  }
}

/** Never minus nothing. */
function rounded(end: number, digits: number): string {
  return end.toFixed(digits).replace(/^-(0(\.0*)?)$/, "$1");
}

function bareText(field: Field, { log }: Told): string {
  if (field === "robot") return log === "read" ? READING : `not known: evidence was taken out, and who brought the rest is not kept${log === "short" ? `, or it changed ${FAR}` : ""}`;
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
