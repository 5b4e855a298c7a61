/** The server's clock, as its answers tell it: that of a tablet may be minutes off where nothing sets it. */

/** Answers tell whole seconds; what differs by less is no difference. */
const EXACT_MS = 2000;
let aheadMs = 0;
let trusted = true;

/** Take what an answer's header `Cairn-Time` says; null: the server does not trust its clock. */
export function noteTrust(time: string | null): void {
  trusted = time !== null;
}

/** False while the server does not trust its clock: robots' measurements may wait then. */
export function isClockTrusted(): boolean {
  return trusted;
}

/** Take what an answer's header `Date` says; null: it says nothing. */
export function noteServerDate(date: string | null): void {
  const told = date === null ? NaN : Date.parse(date) + 500;
  if (!Number.isFinite(told)) return;
  const ahead = told - Date.now();
  aheadMs = Math.abs(ahead) > EXACT_MS ? ahead : 0;
}

/** UTC seconds by the server's clock. */
export function serverNowS(): number {
  return (Date.now() + aheadMs) / 1000;
}
