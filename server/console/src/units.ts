/** Numbers as people read them, always with a unit. */

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

export function clock(timeS: number): string {
  return new Date(timeS * 1000).toISOString().replace("T", " ").slice(0, 19) + " UTC";
}

export function thousands(count: number): string {
  return Math.round(count).toLocaleString("en-GB").replaceAll(",", "\u202f");
}

export function counted(count: number, one: string, many: string): string {
  return `${count} ${count === 1 ? one : many}`;
}
