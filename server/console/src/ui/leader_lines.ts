/** Labels of robots in the picture, each with a line to its robot where it stands off; many at one place become one label.
 *
 *     labels at their robots  -->  heaps of those that would lie over one another  -->  a stack of a few, or one label that counts */

import { h, svg } from "../dom.ts";
import { heaps, stacked } from "./label_stack.ts";

/** Labels of one place that stand in a stack; more become one. */
const STACK_MAX = 3;
/** Names that a label of many says before it counts. */
const NAMES = 2;
/** Labels so far off their robots have a line, px. */
const OFF_PX = 12;
/** Of a label's box from its place: style.css. */
const LEFT_PX = 8;
const UP_PX = 11;

export interface SeenLabel {
  readonly name: string;
  readonly label: HTMLElement;
  readonly x: number;
  readonly y: number;
}

interface Standing {
  readonly label: HTMLElement;
  readonly members: readonly SeenLabel[];
  readonly x: number;
  readonly y: number;
}

export class LeaderLines {
  private readonly lines = svg("svg", { class: "leaders" });
  private readonly counts: HTMLElement[] = [];
  private readonly host: HTMLElement;
  private drawn = "";

  constructor(host: HTMLElement) {
    this.host = host;
    host.append(this.lines);
  }

  /** Put the labels where none lies over another, and draw lines to the robots of those that stand off. */
  place(seen: readonly SeenLabel[], widthPx: number, heightPx: number): void {
    const boxOf = ({ label, x, y }: { label: HTMLElement; x: number; y: number }) => ({ x, y, width: label.offsetWidth, height: label.offsetHeight });
    const groups = heaps(seen.map(boxOf)).map((heap) => heap.map((n) => seen[n]));
    let used = 0;
    const standing = groups.flatMap((members): Standing[] => {
      if (members.length <= STACK_MAX) return members.map((one) => ({ label: one.label, members: [one], x: one.x, y: one.y }));
      for (const { label } of members) label.hidden = true;
      const middle = (axis: "x" | "y") => members.reduce((sum, one) => sum + one[axis], 0) / members.length;
      return [{ label: this.count(used++, members), members, x: middle("x"), y: middle("y") }];
    });
    this.counts.slice(used).forEach((label) => (label.hidden = true));
    const tops = stacked(standing.map(boxOf), heightPx);
    const ends: number[][] = [];
    standing.forEach(({ label, members, x, y }, n) => {
      label.style.transform = `translate(${x}px, ${tops[n]}px)`;
      for (const one of members) {
        if (members.length > 1 || Math.abs(tops[n] - y) > OFF_PX) ends.push([one.x, one.y, x + LEFT_PX, tops[n] - UP_PX]);
      }
    });
    this.draw(ends, widthPx, heightPx);
  }

  /** The n-th label that stands for many. */
  private count(n: number, members: readonly SeenLabel[]): HTMLElement {
    const label = (this.counts[n] ??= this.host.appendChild(h("span", { class: "label many" })));
    const text = `${members.length} robots: ${members.slice(0, NAMES).map(({ name }) => name).join(", ")} …`;
    if (label.textContent !== text) label.textContent = text;
    label.hidden = false;
    return label;
  }

  private draw(ends: readonly number[][], widthPx: number, heightPx: number): void {
    const path = ends.map(([x, y, toX, toY]) => `M${x.toFixed(0)} ${y.toFixed(0)}L${toX.toFixed(0)} ${toY.toFixed(0)}`).join("");
    if (path === this.drawn) return;
    this.drawn = path;
    for (const [name, value] of [["width", widthPx], ["height", heightPx]] as const) this.lines.setAttribute(name, String(value));
    this.lines.replaceChildren(svg("path", { d: path }));
  }
}
