/** Times of day in a zone that is chosen, always with the zone's name. */

export interface Zone {
  readonly name: string;
  format(timeS: number): string;
}

/** UTC, the zone of this computer, and all others that the browser knows; each once. */
export function zoneNames(): string[] {
  const here = Intl.DateTimeFormat().resolvedOptions().timeZone;
  return [...new Set(["UTC", here, ...Intl.supportedValuesOf("timeZone")])];
}

const PAGE_KEY = "cairn.times";
let page: Zone | null = null;

/** The zone of all times on the page, as it was chosen on this computer. */
export function pageZone(): Zone {
  return (page ??= zoneOf(localStorage.getItem(PAGE_KEY) ?? "UTC"));
}

/** Choose the zone of the page's times; what is written already stays. */
export function setPageZone(name: string): void {
  localStorage.setItem(PAGE_KEY, name);
  page = zoneOf(name);
}

export function zoneOf(name: string): Zone {
  const format = new Intl.DateTimeFormat("en-CA", {
    timeZone: name, year: "numeric", month: "2-digit", day: "2-digit", hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23", timeZoneName: "short",
  });
  return { name, format: (timeS) => format.format(timeS * 1000).replace(",", "") };
}
