/** Findings as files for other programs, in metres of the map's frame. */

import type { Finding } from "./findings.ts";
import { robotOf } from "./log_book.ts";
import { authorOf } from "./mark_book.ts";

const COLUMNS = [
  "number", "state", "kind", "name", "celsius", "sigma", "x_m", "y_m", "z_m", "over_floor_m", "voxels", "low_x_m", "low_y_m", "low_z_m",
  "high_x_m", "high_y_m", "high_z_m", "author", "time_utc", "note", "key",
] as const;
type Row = Record<(typeof COLUMNS)[number], string | number | null>;

function rowOf({ number, state, title, place, box, celsius, spot, entry }: Finding): Row {
  const [low, high] = box;
  const timeS = entry ? entry.mark.time_ms / 1000 : (spot?.captured_s?.[1] ?? spot?.measured_s);
  return {
    number, state, kind: state === "mark" ? entry!.mark.kind : "hot_spot", name: title, celsius, sigma: spot?.sigma ?? null,
    x_m: metric(place[0]), y_m: metric(place[1]), z_m: metric(place[2]), over_floor_m: spot?.over_floor_m ?? null, voxels: spot?.voxels ?? null,
    low_x_m: metric(low[0]), low_y_m: metric(low[1]), low_z_m: metric(low[2]),
    high_x_m: metric(high[0]), high_y_m: metric(high[1]), high_z_m: metric(high[2]),
    author: entry ? authorOf(entry) : (spot?.commit ? robotOf(spot.commit) : null),
    time_utc: timeS === undefined ? null : new Date(timeS * 1000).toISOString(), note: entry?.mark.note ?? null, key: entry?.key ?? null,
  };
}

/** A table as RFC 4180 has it; what a spreadsheet would take for a formula is text. */
export function csvOf(findings: readonly Finding[]): string {
  const cell = (value: string | number | null) => {
    if (value === null) return "";
    const text = typeof value === "string" && /^[=+\-@\t\r]/.test(value) ? `'${value}` : String(value);
    return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  return [COLUMNS.join(","), ...findings.map((one) => COLUMNS.map((name) => cell(rowOf(one)[name])).join(","))].join("\r\n") + "\r\n";
}

/** Points with properties; GeoJSON means degrees, so the file says that these are metres of the map. */
export function geoJsonOf(findings: readonly Finding[], map: string): string {
  const features = findings.map((one) => {
    const { x_m, y_m, z_m, ...properties } = rowOf(one);
    return { type: "Feature", geometry: { type: "Point", coordinates: [x_m, y_m, z_m] }, properties };
  });
  return JSON.stringify({ type: "FeatureCollection", map, coordinates: "metres in the map's frame, not degrees", features });
}

function metric(value: number): number {
  return Math.round(value * 1000) / 1000;
}
