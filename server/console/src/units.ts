/** Numbers as people read them, always with a unit. */

import { pageZone } from "./zone.ts";

export const KELVIN_ZERO_C = 273.15;

export function celsius(kelvin: number, digits = 1): string {
  return `${(kelvin - KELVIN_ZERO_C).toFixed(digits)} °C`;
}

/** Never minus nothing. */
export function metres(value: number, digits = 2): string {
  return `${value.toFixed(digits).replace(/^-(0(\.0*)?)$/, "$1")} m`;
}

export function bytes(count: number): string {
  if (count < 1000) return `${count} B`;
  const units = ["kB", "MB", "GB", "TB"];
  let n = -1;
  while (count >= 1000 && n < units.length - 1) {
    count /= 1000;
    n++;
  }
  return `${count < 10 ? count.toFixed(1) : Math.round(count)} ${units[n]}`;
}

/** How long ago, in one unit. */
export function ago(seconds: number): string {
  if (seconds < 2) return "now";
  for (const [unit, size] of [["d", 86400], ["h", 3600], ["min", 60]] as const) {
    if (seconds >= size) return `${Math.floor(seconds / size)} ${unit} ago`;
  }
  return `${Math.floor(seconds)} s ago`;
}

/** Day and time, with the name of the page's zone. */
export function clock(timeS: number): string {
  return pageZone().format(timeS);
}

/** The time of day, with the day where the day begins. */
export function clockTime(timeS: number): string {
  const text = clock(timeS);
  return text.slice(11, 19) === "00:00:00" ? text.slice(0, 10) : text.slice(11, 19).replace(/:00$/, "");
}

/** How long, in one unit. */
export function duration(seconds: number): string {
  for (const [unit, size] of [["d", 86400], ["h", 3600], ["min", 60]] as const) {
    if (seconds >= 2 * size) return `${Math.round(seconds / size)} ${unit}`;
  }
  return `${Math.round(seconds)} s`;
}

export function thousands(count: number): string {
  return Math.round(count).toLocaleString("en-GB").replaceAll(",", "\u202f");
}

export function counted(count: number, one: string, many: string): string {
  return `${count} ${count === 1 ? one : many}`;
}
