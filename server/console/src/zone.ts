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

export function zoneOf(name: string): Zone {
  const format = new Intl.DateTimeFormat("en-CA", {
    timeZone: name, year: "numeric", month: "2-digit", day: "2-digit", hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23", timeZoneName: "short",
  });
  return { name, format: (timeS) => format.format(timeS * 1000).replace(",", "") };
}
