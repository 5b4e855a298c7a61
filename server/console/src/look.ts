/** How the map is looked at: kept in the address, so that a link shows another person the same. */

import { classesOf } from "./map_layers.ts";
import type { Geometry, Triple } from "./messages.ts";
import type { Palette } from "./palettes.ts";

export type Field = "colour" | "temperature" | "probability" | "height" | "age" | "robot" | "difficulty" | "slope" | "step";

export const FIELDS: { field: Field; label: string; palette: Palette | null; unit: string }[] = [
  { field: "colour", label: "Colour", palette: null, unit: "" },
  { field: "temperature", label: "Temperature", palette: "inferno", unit: "°C" },
  { field: "probability", label: "Probability", palette: "cividis", unit: "" },
  { field: "height", label: "Height", palette: "viridis", unit: "m" },
  { field: "age", label: "Age", palette: "cividis", unit: "s" },
  { field: "robot", label: "Robot", palette: null, unit: "" },
  { field: "difficulty", label: "Difficulty", palette: "viridis", unit: "" },
  { field: "slope", label: "Slope", palette: "viridis", unit: "°" },
  { field: "step", label: "Step", palette: "viridis", unit: "m" },
];

/** Fields of levels alone, and what they lack. */
const OF_GROUND: readonly Field[] = ["difficulty", "slope", "step"];
const OF_SPACE: readonly Field[] = ["colour", "temperature"];

/** Fields that a map may be coloured by, the first one as it is opened; what the colours of a map of classes mean is a class. */
export function fieldsOf({ height_step_um, channels }: Geometry): typeof FIELDS {
  if (height_step_um !== undefined) return [FIELDS.find(({ field }) => field === "height")!, ...FIELDS.filter(({ field }) => field !== "height" && !OF_SPACE.includes(field))];
  const isOfClasses = classesOf(channels).length > 0;
  return FIELDS.filter(({ field }) => !OF_GROUND.includes(field)).map((one) => (one.field === "colour" && isOfClasses ? { ...one, label: "Class" } : one));
}

export interface Look {
  field: Field;
  /** Ends of the legend that the operator locked, by field, in its unit; else they follow what is shown. */
  ranges: Partial<Record<Field, [number, number]>>;
  /** What lies below or above is cut off; m in the map; null: nothing is. */
  floorM: number | null;
  ceilingM: number | null;
  /** Somebody said where the ceiling is cut, or that it is not; else the page cuts off a roof by itself. */
  isCeilingChosen: boolean;
  /** Lowest and highest corner of a box outside of which nothing is shown; m. */
  clip: [Triple, Triple] | null;
  /** Least probability shown. */
  minP: number;
  /** Only these temperatures stand out; °C; without an upper end all above. */
  band: [number, number | null] | null;
  cells: boolean;
  boxes: boolean | null;
  /** Time of capture up to which the map is shown, UTC seconds; null: now. */
  atS: number | null;
  /** Time with which that is compared; null: nothing is compared. */
  sinceS: number | null;
  /** Points that were measured, m in the map. */
  points: Triple[];
}

export interface CameraView {
  eye: Triple;
  target: Triple;
}

export function defaultLook(): Look {
  return {
    field: "colour", ranges: {}, floorM: null, ceilingM: null, isCeilingChosen: false, clip: null, minP: 0, band: null,
    cells: false, boxes: null, atS: null, sinceS: null, points: [],
  };
}

/** Findings as addresses name them: a mark by its key, a hot spot by its hottest voxel. */
const FIND = /^(mark [a-z0-9._-]+:\d+|spot -?\d+,-?\d+,-?\d+)$/;

/** Points of a measure at most: addresses stay short enough to be sent. */
export const POINTS_MAX = 50;

/** Times beyond this are none: a date of the page's clock ends at 8.64e12 s; s from 1970. */
const TIME_MAX_S = 1e11;

/** The part of an address behind #; `find`: the finding that it leads to, or with a camera the one that is chosen there. */
export function toHash(map: string, look: Look, camera: CameraView | null, find: string | null = null): string {
  const parts: [string, string][] = [["map", map]];
  const add = (name: string, value: string | null) => value !== null && parts.push([name, value]);
  const numbers = (values: number[], digits = 2) => values.map((value) => +value.toFixed(digits)).join(",");
  if (look.field !== "colour") add("by", look.field);
  for (const [field, range] of Object.entries(look.ranges)) add(`range.${field}`, numbers(range));
  add("floor", look.floorM === null ? null : numbers([look.floorM]));
  if (look.isCeilingChosen) add("ceiling", look.ceilingM === null ? "off" : numbers([look.ceilingM]));
  add("clip", look.clip && numbers(look.clip.flat()));
  add("p", look.minP > 0 ? numbers([look.minP]) : null);
  add("band", look.band && `${numbers([look.band[0]])},${look.band[1] === null ? "" : numbers([look.band[1]])}`);
  add("cells", look.cells ? "1" : null);
  add("at", look.atS === null ? null : String(look.atS));
  add("since", look.sinceS === null ? null : String(look.sinceS));
  add("points", look.points.length ? numbers(look.points.flat(), 3) : null);
  add("eye", camera && numbers(camera.eye));
  add("target", camera && numbers(camera.target));
  add("find", find && find.replace(" ", "+"));
  return "#" + parts.map(([name, value]) => `${name}=${value}`).join("&");
}

/** Numbers of a list; none, unless each is one. */
function numbersOf(text: string | undefined): number[] {
  const found = text ? text.split(",").map((part) => (part.trim() ? Number(part) : NaN)) : [];
  return found.every(Number.isFinite) ? found : [];
}

export function fromHash(hash: string): { map: string | null; look: Look; camera: CameraView | null; find: string | null } {
  const given = new Map(hash.replace(/^#/, "").split("&").map((part) => part.split("=", 2) as [string, string]));
  const look = defaultLook();
  const numbers = (name: string, count: number): number[] | null => {
    const found = numbersOf(given.get(name));
    return found.length === count ? found : null;
  };
  const one = (name: string) => numbers(name, 1)?.[0] ?? null;
  look.field = FIELDS.find(({ field }) => field === given.get("by"))?.field ?? "colour";
  for (const { field } of FIELDS) {
    const range = numbers(`range.${field}`, 2);
    if (range) look.ranges[field] = range as [number, number];
  }
  look.floorM = one("floor");
  look.ceilingM = one("ceiling");
  look.isCeilingChosen = given.has("ceiling");
  const clip = numbers("clip", 6);
  if (clip) look.clip = [clip.slice(0, 3) as Triple, clip.slice(3) as Triple];
  look.minP = one("p") ?? 0;
  const isOpen = given.get("band")?.endsWith(",");
  if (isOpen) given.set("band", given.get("band")!.slice(0, -1));
  const band = isOpen ? [one("band"), null] : numbers("band", 2);
  look.band = band && band[0] !== null ? (band as [number, number | null]) : null;
  look.cells = given.get("cells") === "1";
  look.boxes = given.has("boxes") ? given.get("boxes") === "1" : null;
  const time = (name: string) => {
    const timeS = one(name);
    return timeS !== null && Math.abs(timeS) <= TIME_MAX_S ? timeS : null;
  };
  look.atS = time("at");
  look.sinceS = time("since");
  const points = numbersOf(given.get("points"));
  if (points.length % 3 === 0 && points.length <= 3 * POINTS_MAX) for (let n = 0; n < points.length; n += 3) look.points.push(points.slice(n, n + 3) as Triple);
  const eye = numbers("eye", 3) as Triple | null;
  const target = numbers("target", 3) as Triple | null;
  const map = given.get("map") ?? null;
  const find = (given.get("find") ?? "").replace("+", " ");
  return {
    map: map && /^[a-z0-9][a-z0-9_-]{0,31}(\.[a-z][a-z0-9_]{0,31})?$/.test(map) ? map : null, look, camera: eye && target && { eye, target },
    find: FIND.test(find) ? find : null,
  };
}
