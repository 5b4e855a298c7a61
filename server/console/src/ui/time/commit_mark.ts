/** The mark of a commit, or of several, on the time axis: full, hollow and struck if taken out, a cross for who takes out. */

import { svg } from "../../dom.ts";
import { whoTookOut, type Commit } from "../../timeline.ts";
import { bytes, clock, counted } from "../../units.ts";
import type { Cluster } from "./clusters.ts";

/** A button in the axis, without what it does. */
export function markOf(cluster: Cluster, y: number, colour: string): SVGElement {
  const { x, commits } = cluster;
  const shape = commits.length === 1 ? one(commits[0]!, x, y, colour) : several(commits, x, y, colour);
  const said = commits.length === 1 ? nameOf(commits[0]!) : nameOfMany(commits);
  const target = svg("rect", { x: x - 7.5, y: y - 7, width: 15, height: 14, fill: "transparent" });
  return svg("g", { role: "button", "aria-label": said, class: "commit" }, target, ...shape, svg("title", {}, said));
}

export function nameOf({ entry, timeS, out, isRetract }: Commit): string {
  const when = `, ${clock(timeS)}`;
  if (isRetract) return `retract ${entry.id} of ${counted(entry.retracts.length, "commit", "commits")}${when}${entry.note ? `: ${entry.note}` : ""}`;
  return `commit ${entry.id}${out ? `, ${outText(out)}` : ""}, ${counted(entry.cells, "cell", "cells")}, ${bytes(entry.size_bytes)}${when}`;
}

/** When, by whom and why: as far as that is known. */
export function outText(out: NonNullable<Commit["out"]>): string {
  const { whenS, by, note } = out;
  return `taken out${whenS === null ? "" : ` ${clock(whenS)}`}${by === null ? "" : ` by ${whoTookOut(out)}`}${note ? `: ${note}` : ""}`;
}

function nameOfMany(commits: readonly Commit[]): string {
  const out = commits.filter((commit) => commit.out).length;
  const gone = out ? `, ${out} of them taken out` : "";
  return `${counted(commits.length, "commit", "commits")} of ${commits[0]!.robot}${gone}, ${clock(commits[0]!.timeS)} to ${clock(commits[commits.length - 1]!.timeS)}`;
}

function one({ out, isRetract }: Commit, x: number, y: number, colour: string): SVGElement[] {
  if (isRetract) return [svg("path", { d: `M${x - 4} ${y - 4}l8 8m0 -8l-8 8`, stroke: colour, "stroke-width": 2 })];
  const dot = svg("circle", { cx: x, cy: y, r: 5, fill: out ? "none" : colour, stroke: colour, "stroke-width": 2 });
  return out ? [dot, svg("path", { d: `M${x - 6} ${y + 6}l12 -12`, stroke: colour, "stroke-width": 2 })] : [dot];
}

function several(commits: readonly Commit[], x: number, y: number, colour: string): SVGElement[] {
  const allOut = commits.every(({ out }) => out);
  const box = svg("rect", {
    x: x - 7, y: y - 6, width: 14, height: 12, rx: 4, class: "several", stroke: colour, "stroke-width": 2, "stroke-dasharray": allOut ? "2 2" : "none",
  });
  const text = commits.length > 99 ? "∷" : String(commits.length);
  return [box, svg("text", { x, y: y + 3.5, class: "count", "text-anchor": "middle" }, text)];
}
