/** Picture of a floor plan: columns as a raster, and over it findings by number, robots, the eye, a scale bar.
 *
 * The same drawing is the plan over the map, the small one at its edge, and the one in a report. */

import { DataTexture } from "three";
import { DIFFICULTY_STEP, NO_SLOPE, RISE_STEP_M, SLOPE_STEP_DEG } from "../decode/pack.ts";
import type { Finding } from "../findings.ts";
import type { CameraView, Field } from "../look.ts";
import { OVER, rgbOf, textureOf } from "../palettes.ts";
import type { Triple } from "../messages.ts";
import { columnAt, FLOOR, FOG, GAP, THING, WALL, type FloorPlan } from "../scene/floor_plan.ts";
import { roundM } from "./reference_frame.ts";

export interface PlanInk {
  readonly theme: "dark" | "light";
  readonly field: Field;
  /** Ends of temperatures, K. */
  readonly rangeK: [number, number] | null;
  /** Ends of what is told of a level's ground. */
  readonly range: [number, number];
}

export interface PlanMarks {
  readonly findings: readonly Finding[];
  readonly robots: readonly { name: string; place: Triple; colour: string }[];
  /** null: on paper. */
  readonly view: CameraView | null;
}

/** Place of a plan in a picture: px of a column, and of its upper left corner. */
export interface Fit {
  readonly scale: number;
  readonly left: number;
  readonly top: number;
}

type Rgb = readonly [number, number, number];
const FOG_STRIPE = 4;
const GROUNDS: Record<"dark" | "light", { fog: Rgb; stripe: Rgb; gap: Rgb; gapStripe: Rgb; floor: Rgb; thing: Rgb; wall: Rgb; ink: string; paper: string }> = {
  dark: {
    fog: [14, 17, 22], stripe: [23, 28, 36], gap: [58, 44, 14], gapStripe: [112, 84, 20], floor: [66, 72, 82], thing: [128, 136, 148], wall: [214, 220, 228],
    ink: "#e6edf3", paper: "#161b22",
  },
  light: {
    fog: [226, 229, 234], stripe: [212, 216, 222], gap: [250, 232, 186], gapStripe: [230, 192, 100], floor: [252, 252, 253], thing: [168, 174, 184], wall: [48, 54, 64],
    ink: "#1c2128", paper: "#ffffff",
  },
};
const INFERNO = textureOf("inferno") as DataTexture;
const VIRIDIS = textureOf("viridis") as DataTexture;
const BEYOND = rgbOf(OVER).map((part) => Math.round(255 * part)) as unknown as Rgb;
/** Byte of a node's colour that has a field of a level, and its unit. */
const CODED = { difficulty: { byte: 0, step: DIFFICULTY_STEP }, slope: { byte: 1, step: SLOPE_STEP_DEG }, step: { byte: 2, step: RISE_STEP_M } };
/** Part of its place that a plan fills, and the least length of the scale bar, px. */
const FILLED = 0.94;
const BAR_PX = 90;
/** A finding without another one so near has its temperature next to it, px. */
const PIN = { wide: 62, high: 20 };
/** Smaller plans have dots for findings, no numbers; px. */
const SMALL_PX = 260;

export function fitOf({ width, height }: FloorPlan, canvas: { width: number; height: number }): Fit {
  const scale = Math.min((canvas.width * FILLED) / width, (canvas.height * FILLED) / height);
  return { scale, left: (canvas.width - width * scale) / 2, top: (canvas.height - height * scale) / 2 };
}

/** Pixel of a place of the map. */
export function pixelOf(plan: FloorPlan, fit: Fit, place: Triple): [number, number] {
  const [a, b] = columnAt(plan, place);
  return [fit.left + a * fit.scale, fit.top + (plan.height - b) * fit.scale];
}

/** x and y in the map of a pixel. */
export function placeOf(plan: FloorPlan, fit: Fit, x: number, y: number): [number, number] {
  return [plan.x + ((x - fit.left) / fit.scale) * plan.edgeM, plan.y + (plan.height - (y - fit.top) / fit.scale) * plan.edgeM];
}

/** `ratio`: pixels of the canvas to one of the page. */
export function drawPlan(canvas: HTMLCanvasElement, plan: FloorPlan, ink: PlanInk, marks: PlanMarks, ratio: number): void {
  const context = canvas.getContext("2d")!;
  const ground = GROUNDS[ink.theme];
  const fit = fitOf(plan, canvas);
  const small = Math.max(canvas.width, canvas.height) / ratio < SMALL_PX;
  drawFog(context, ground);
  context.imageSmoothingEnabled = false;
  context.drawImage(rasterOf(plan, ink), fit.left, fit.top, plan.width * fit.scale, plan.height * fit.scale);
  if (marks.view) drawEye(context, plan, fit, marks.view, ground.ink, ratio);
  for (const { name, place, colour } of marks.robots) drawRobot(context, pixelOf(plan, fit, place), small ? "" : name, colour, ground, ratio);
  // The first numbers lie on top.
  const pins = marks.findings.map((one) => ({ one, at: pixelOf(plan, fit, one.place) }));
  const isFree = (n: number) => pins.every(({ at: [x, y] }, m) => m === n || Math.abs(y - pins[n].at[1]) > PIN.high * ratio || Math.abs(x - pins[n].at[0]) > PIN.wide * ratio);
  for (let n = pins.length - 1; n >= 0; n--) drawPin(context, pins[n].at, pins[n].one, { small, isSaid: isFree(n) }, ground, ratio);
  if (!small) drawBar(context, canvas, plan, fit, ground.ink, ratio);
}

function drawFog(context: CanvasRenderingContext2D, { fog, stripe }: { fog: Rgb; stripe: Rgb }): void {
  const tile = new OffscreenCanvas(2 * FOG_STRIPE, 2 * FOG_STRIPE);
  const drawn = tile.getContext("2d")!;
  for (let y = 0; y < tile.height; y++) {
    for (let x = 0; x < tile.width; x++) {
      drawn.fillStyle = `rgb(${((x + y) % tile.width < FOG_STRIPE ? fog : stripe).join(" ")})`;
      drawn.fillRect(x, y, 1, 1);
    }
  }
  context.fillStyle = context.createPattern(tile, "repeat")!;
  context.fillRect(0, 0, context.canvas.width, context.canvas.height);
}

/** The raster of each plan that was drawn last, and its ink: an eye that moves needs no other one. */
const rasters = new WeakMap<FloorPlan, { of: string; raster: OffscreenCanvas }>();

function rasterOf(plan: FloorPlan, ink: PlanInk): OffscreenCanvas {
  const of = JSON.stringify(ink);
  let kept = rasters.get(plan);
  if (kept?.of !== of) rasters.set(plan, (kept = { of, raster: makeRaster(plan, ink) }));
  return kept.raster;
}

/** One pixel a column, clear where there is fog. */
function makeRaster({ width, height, kinds, colours, kelvins }: FloorPlan, { theme, field, rangeK, range }: PlanInk): OffscreenCanvas {
  const image = new ImageData(width, height);
  const ground = GROUNDS[theme];
  const coded = field in CODED ? CODED[field as keyof typeof CODED] : null;
  for (let b = 0; b < height; b++) {
    for (let a = 0; a < width; a++) {
      const from = b * width + a;
      const kind = kinds[from];
      if (kind === FOG) continue;
      let ink: Rgb = kind === FLOOR ? ground.floor : kind === THING ? ground.thing : kind === WALL ? ground.wall
        : kind === GAP && (a + b) % 4 < 2 ? ground.gapStripe : ground.gap;
      if (kind >= FLOOR && kind <= WALL) {
        if (field === "colour" && colours[4 * from + 3] && kind !== WALL) ink = [colours[4 * from], colours[4 * from + 1], colours[4 * from + 2]];
        if (field === "temperature" && kelvins[from] && rangeK) ink = shaded(INFERNO, kelvins[from], rangeK);
        const code = coded ? colours[4 * from + coded.byte]! : NO_SLOPE;
        if (coded && colours[4 * from + 3] && !(field === "slope" && code === NO_SLOPE)) ink = shaded(VIRIDIS, code * coded.step, range);
      }
      image.data.set([...ink, 255], 4 * ((height - 1 - b) * width + a));
    }
  }
  const canvas = new OffscreenCanvas(width, height);
  canvas.getContext("2d")!.putImageData(image, 0, 0);
  return canvas;
}

function shaded(palette: DataTexture, value: number, [low, high]: [number, number]): Rgb {
  if (palette === VIRIDIS && value > high) return BEYOND;
  const at = 4 * Math.round(255 * Math.min(Math.max((value - low) / (high - low), 0), 1));
  const data = palette.image.data as Uint8Array;
  return [data[at], data[at + 1], data[at + 2]];
}

/** The eye: its place, and the direction in which it looks. */
function drawEye(context: CanvasRenderingContext2D, plan: FloorPlan, fit: Fit, { eye, target }: CameraView, ink: string, ratio: number): void {
  const [x, y] = pixelOf(plan, fit, eye);
  const way = Math.atan2(-(target[1] - eye[1]), target[0] - eye[0]);
  context.save();
  context.translate(x, y);
  context.rotate(way);
  context.beginPath();
  context.moveTo(10 * ratio, 0);
  context.lineTo(-6 * ratio, 6 * ratio);
  context.lineTo(-6 * ratio, -6 * ratio);
  context.closePath();
  context.lineWidth = 2 * ratio;
  context.strokeStyle = ink;
  context.stroke();
  context.restore();
}

function drawRobot(
  context: CanvasRenderingContext2D, [x, y]: [number, number], name: string, colour: string, { ink, paper }: { ink: string; paper: string }, ratio: number,
): void {
  context.beginPath();
  context.arc(x, y, 5 * ratio, 0, 2 * Math.PI);
  context.fillStyle = `rgb(${rgbOf(colour).map((part) => Math.round(255 * part)).join(" ")})`;
  context.fill();
  context.lineWidth = 1.5 * ratio;
  context.strokeStyle = ink;
  context.stroke();
  write(context, name, x + 9 * ratio, y, ink, paper, ratio);
}

function drawPin(
  context: CanvasRenderingContext2D, [x, y]: [number, number], { number, state, celsius }: Finding, { small, isSaid }: { small: boolean; isSaid: boolean }, { ink, paper }: { ink: string; paper: string },
  ratio: number,
): void {
  context.beginPath();
  context.arc(x, y, (small ? 3.5 : 10) * ratio, 0, 2 * Math.PI);
  context.fillStyle = small ? "#ffb000" : paper;
  context.fill();
  context.lineWidth = (state === "new" ? 2.5 : 1.5) * ratio;
  context.strokeStyle = state === "new" ? "#e5484d" : ink;
  context.stroke();
  if (small) return;
  context.font = `600 ${11 * ratio}px system-ui, sans-serif`;
  context.fillStyle = ink;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(String(number), x, y);
  if (celsius !== null && isSaid) write(context, `${celsius.toFixed(0)} °C`, x + 14 * ratio, y, ink, paper, ratio);
}

function write(context: CanvasRenderingContext2D, text: string, x: number, y: number, ink: string, paper: string, ratio: number): void {
  context.font = `${11 * ratio}px system-ui, sans-serif`;
  context.textAlign = "left";
  context.textBaseline = "middle";
  context.lineWidth = 3 * ratio;
  context.strokeStyle = paper;
  context.strokeText(text, x, y);
  context.fillStyle = ink;
  context.fillText(text, x, y);
}

function drawBar(context: CanvasRenderingContext2D, { height }: { height: number }, { edgeM }: FloorPlan, { scale }: Fit, ink: string, ratio: number): void {
  const pxPerM = scale / edgeM;
  const longM = roundM((BAR_PX * ratio * 1.5) / pxPerM);
  const [x, y] = [14 * ratio, height - 14 * ratio];
  context.lineWidth = 2 * ratio;
  context.strokeStyle = ink;
  context.beginPath();
  context.moveTo(x, y - 6 * ratio);
  context.lineTo(x, y);
  context.lineTo(x + longM * pxPerM, y);
  context.lineTo(x + longM * pxPerM, y - 6 * ratio);
  context.stroke();
  context.font = `${12 * ratio}px system-ui, sans-serif`;
  context.fillStyle = ink;
  context.textAlign = "left";
  context.textBaseline = "bottom";
  context.fillText(longM >= 1 ? `${longM} m` : `${Math.round(longM * 100)} cm`, x + 4 * ratio, y - 4 * ratio);
}
