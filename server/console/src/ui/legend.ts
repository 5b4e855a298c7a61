/** Legend of the field that is shown: the meaning of its colours, and ends that can be locked. */

import { classColours, unsureColour } from "../class_colours.ts";
import { fill, h } from "../dom.ts";
import { KEPT } from "../log_book.ts";
import { FIELDS, type Field, type Look } from "../look.ts";
import { OVER, robotColour, stopsOf, UNDER } from "../palettes.ts";
import { SLOPE_MAX_DEG, STEP_MAX_M } from "../scene/ground.ts";
import { clock, metres, thousands } from "../units.ts";

/** Names that colours stand for: of robots, and of classes where the map counts them. */
export interface Names {
  readonly robots: readonly string[];
  readonly classes: readonly string[];
}

/** Facts from the log for the legend: the unit of ages, and how far back the log is known. */
export interface Told {
  readonly unit: string;
  /** The unit, in the range's own, s or log entries. */
  readonly size: number;
  /** Reach of the known log: to all that is shown, not yet so far, or no farther. */
  readonly log: "whole" | "read" | "short";
  /** Time of the newest measurement that is known, s; null: no entry states a time. */
  readonly newestS: number | null;
  /** Edge of the cells, by which ages and robots are known, m. */
  readonly cellM: number;
}

/** Values of the whole map in the look's unit; `shift`: what is told as 0. */
export interface Values {
  readonly shift: number;
  readonly histogram: { least: number; most: number; begin: number; step: number; counts: readonly number[] } | null;
}

const READING = "older entries of the log are being read";
const FAR = `before the newest ${thousands(KEPT)} entries of the log`;
const RAMP = { width: 240, height: 12 };
/** Length of the block at each end of the ramp that is open, px. */
const BLOCK_PX = 12;
const BARS = 48;
const BARS_PX = 22;

export class Legend {
  readonly element = h("section", { class: "legend", "aria-label": "Legend", tabindex: "0" });
  onRange: (range: [number, number] | null) => void = () => {};
  private shown = "";
  private locked = false;

  /** `range` in the look's unit; null: nothing that is shown has this field. */
  show(look: Look, range: [number, number] | null, { robots, classes }: Names, told: Told, values: Values): void {
    const locked = look.ranges[look.field] !== undefined;
    const state = JSON.stringify([look.field, range?.map((end) => end.toFixed(2)), locked, look.field === "robot" ? robots : look.field === "colour" && classes, told, values]);
    const controls = () => [...this.element.querySelectorAll<HTMLElement>("input, button")];
    const focused = controls().indexOf(document.activeElement as HTMLElement);
    // Whoever types an end is not disturbed by one that follows what is shown.
    const isTyping = document.activeElement instanceof HTMLInputElement && focused >= 0;
    // Nor is a button replaced between press and release, which would be no click.
    const isPressed = this.element.querySelector("button:active") !== null;
    if (state === this.shown || isPressed || (isTyping && locked === this.locked)) return;
    this.shown = state;
    this.locked = locked;
    const { label, palette } = FIELDS.find(({ field }) => field === look.field)!;
    const bare = h("p", { class: "bare" }, h("span", { class: "flat", "aria-hidden": "true" }), bareText(look.field, told, classes.length > 0));
    if (look.field === "robot") return fill(this.element, h("h2", {}, "Robot that added to the cell last"), ...robots.map((name) => named(name, robots)), byCell(told), bare);
    if (look.field === "colour" && classes.length) return fill(this.element, h("h2", {}, "Class with the most votes"), ...classList(classes), bare);
    if (!palette) return fill(this.element, h("h2", {}, label), h("p", {}, "As the cameras saw it."), bare);
    if (!range) return fill(this.element, h("h2", {}, label), h("p", {}, `Nothing shown has a ${label.toLowerCase()}.`), bare);
    const isAge = look.field === "age";
    fill(
      this.element, h("h2", {}, titleOf(look.field, told, values)), values.histogram && bars(values.histogram, range, openEnds(look.field, range, values)),
      bar(stopsOf(palette), openEnds(look.field, range, values), isAge), this.ends(look.field, range, told, values),
      ...beyond(look.field, range, values), look.field === "temperature" || isOfGround(look.field) ? bare : null,
      ...(isAge ? agesSaid(range, told) : []),
      isAge && told.log !== "whole" ? h("p", { class: "hint" }, told.log === "read" ? READING : `or older: changed ${FAR}`) : null,
    );
    controls()[focused]?.focus();
  }

  private ends(field: Field, range: [number, number], told: Told, { shift }: Values): HTMLElement {
    const isAge = field === "age";
    const { unit, size } = isAge ? told : { unit: FIELDS.find((one) => one.field === field)!.unit, size: 1 };
    const digits = field === "probability" || field === "step" ? 2 : isAge && size === 1 ? 0 : 1;
    const wrong = h("p", { class: "error", role: "alert" });
    const take = () => {
      const [low, high] = inputs.map((input) => size * input.valueAsNumber + shift);
      wrong.textContent = low < high ? "" : "The lower end must be below the upper one.";
      if (low < high) this.onRange([low, high]);
    };
    const inputs = range.map((end, n) =>
      h("input", {
        type: "number", step: "any", value: rounded((end - shift) / size, digits),
        "aria-label": `${n ? "Upper" : "Lower"} end of the legend${unit ? `, ${unit}` : ""}`, onchange: take,
      }),
    );
    const lock = h(
      "button",
      {
        type: "button", "aria-pressed": String(this.locked),
        title: this.locked ? "Let the ends follow the map" : "Keep these ends",
        onclick: () => this.onRange(this.locked ? null : range),
      },
      this.locked ? "Locked" : "Auto",
    );
    return h("div", {}, h("div", { class: "ends" }, inputs[0], lock, inputs[1]), wrong);
  }
}

/** Edges of colour that are the cells' own, and say nothing of the building. */
function byCell({ cellM }: Told): HTMLElement {
  return h("p", { class: "hint" }, `Known by cell, cubes of ${metres(cellM)}: a commit colours all of each cell that it touched.`);
}

/** Ages as times of day, as people tell them. */
function agesSaid([low, high]: [number, number], told: Told): HTMLElement[] {
  const { newestS } = told;
  return newestS === null ? [byCell(told)] : [h("p", { class: "hint" }, `before the newest measurement: from ${clock(newestS - high)} to ${clock(newestS - low)}`), byCell(told)];
}

function titleOf(field: Field, told: Told, { shift }: Values): string {
  const { label, unit } = FIELDS.find((one) => one.field === field)!;
  if (field === "difficulty") return "Difficulty for a usual vehicle";
  if (field === "age") return `Age by cell, ${told.unit}`;
  if (field === "height" && shift) return `Height over the floor, ${unit}`;
  return `${label}${unit ? `, ${unit}` : ""}`;
}

/** Ends of the range beyond which the map has values: below the lower one, and above the upper one. */
function openEnds(field: Field, [low, high]: [number, number], { histogram }: Values): [boolean, boolean] {
  if (field === "age") return [false, false];
  if (isOfGround(field)) return [false, true];
  return histogram ? [histogram.least < low, histogram.most > high] : [false, false];
}

/** Meaning of the end blocks, in words. */
function beyond(field: Field, range: [number, number], values: Values): HTMLElement[] {
  const { shift, histogram } = values;
  const line = (colour: string, text: string) => h("p", { class: "bare" }, block(colour), text);
  if (isOfGround(field)) {
    const { unit } = FIELDS.find((one) => one.field === field)!;
    return [line(OVER, `above ${Number(range[1].toFixed(2))}${unit && ` ${unit}`}`), h("p", { class: "hint" }, `A usual vehicle passes slopes of ${SLOPE_MAX_DEG}° and steps of ${100 * STEP_MAX_M} cm; a difficulty above 1 is more.`)];
  }
  if (!histogram) return [];
  const { unit } = FIELDS.find((one) => one.field === field)!;
  const [isBelow, isAbove] = openEnds(field, range, values);
  const said = (value: number) => `${rounded(value - shift, 1)} ${unit}`;
  const [lowest, highest] = field === "temperature" ? ["coldest", "hottest"] : ["lowest", "highest"];
  return [
    ...(isAbove ? [line(OVER, `above ${said(range[1])}; ${highest} ${said(histogram.most)}`)] : []),
    ...(isBelow ? [line(UNDER, `below ${said(range[0])}; ${lowest} ${said(histogram.least)}`)] : []),
  ];
}

/** A patch of a colour. */
function block(colour: string): HTMLElement {
  const found = h("span", { class: "flat", "aria-hidden": "true" });
  found.style.background = colour;
  return found;
}

const cssOf = (rgb: readonly number[]) => `rgb(${rgb.join(" ")})`;

function isOfGround(field: Field): boolean {
  return field === "difficulty" || field === "slope" || field === "step";
}

/** Each class in its colour, and in the paler one of voxels in which it hardly leads. */
function classList(classes: readonly string[]): HTMLElement[] {
  const rows = classColours(classes.length).map((colour, n) => h("li", {}, block(cssOf(colour)), block(cssOf(unsureColour(colour))), classes[n]!));
  return [h("ul", { class: "classes" }, ...rows), h("p", { class: "hint" }, "Paler: unsure, it leads by less than two votes.")];
}

/** Never minus nothing. */
function rounded(end: number, digits: number): string {
  return end.toFixed(digits).replace(/^-(0(\.0*)?)$/, "$1");
}

function bareText(field: Field, { log }: Told, isOfClasses: boolean): string {
  if (isOfGround(field)) return "not told: stands on the ground, is seen from afar, or has too little around it";
  if (field === "colour" && isOfClasses) return "nothing was named";
  if (field === "robot") return log === "read" ? READING : `not known: evidence was taken out, and who brought the rest is not kept${log === "short" ? `, or it changed ${FAR}` : ""}`;
  return field === "temperature" ? "no temperature was measured" : "no colour was measured";
}

function named(name: string, robots: readonly string[]): HTMLElement {
  const dot = h("span", { class: "dot", "aria-hidden": "true" });
  dot.style.background = robotColour(name, robots);
  return h("p", {}, dot, ` ${name}`);
}

/** Begin and end of the palette on the bar, px: between the blocks of ends that are open. */
function innerPx(isBelow: boolean, isAbove: boolean): [number, number] {
  return [isBelow ? BLOCK_PX : 0, RAMP.width - (isAbove ? BLOCK_PX : 0)];
}

/** A canvas, because a strict page takes no gradient in an attribute; ends beyond which the map goes on are blocks. */
function bar(stops: string[], [isBelow, isAbove]: [boolean, boolean], reversed: boolean): HTMLCanvasElement {
  const canvas = h("canvas", { ...RAMP, class: "ramp", "aria-hidden": "true" });
  const context = canvas.getContext("2d")!;
  const [left, right] = innerPx(isBelow, isAbove);
  const gradient = context.createLinearGradient(left, 0, right, 0);
  const order = reversed ? [...stops].reverse() : stops;
  order.forEach((stop, n) => gradient.addColorStop(n / (order.length - 1), stop));
  const block = (colour: string | CanvasGradient, from: number, to: number) => {
    context.fillStyle = colour;
    context.fillRect(from, 0, to - from, RAMP.height);
  };
  block(UNDER, 0, left);
  block(OVER, right, RAMP.width);
  block(gradient, left, right);
  return canvas;
}

/** Histogram of the voxels' values: roots of counts, so that the few hot ones are seen, too. */
function bars({ begin, step, counts }: { begin: number; step: number; counts: readonly number[] }, [low, high]: [number, number], open: [boolean, boolean]): HTMLCanvasElement {
  const canvas = h("canvas", { width: RAMP.width, height: BARS_PX, class: "bars", "aria-hidden": "true" });
  const context = canvas.getContext("2d")!;
  const sums = new Array<number>(BARS + 2).fill(0);
  counts.forEach((count, n) => {
    const place = Math.floor(((begin + (n + 0.5) * step - low) / (high - low)) * BARS);
    sums[Math.min(Math.max(place, -1), BARS) + 1] += count;
  });
  const most = Math.max(...sums);
  const [first, last] = innerPx(...open);
  const wide = (last - first) / BARS;
  context.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--quiet");
  sums.forEach((sum, n) => {
    const tall = Math.sqrt(sum / most) * BARS_PX;
    const left = n === 0 ? 0 : first + (n - 1) * wide;
    context.fillRect(left, BARS_PX - tall, n === 0 ? first : n > BARS ? RAMP.width - last : wide, tall);
  });
  return canvas;
}
