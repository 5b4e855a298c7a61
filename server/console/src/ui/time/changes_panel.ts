/** What changed between two moments, as a list: how much in which way, and things to fly to, the largest first. */

import { WAYS, type ChangedThing, type Changes, type Way } from "../../changes.ts";
import { fill, h } from "../../dom.ts";
import { clock, counted, metres } from "../../units.ts";

const THINGS_MAX = 40;

/** Okabe and Ito's, which everybody can tell apart. */
export const COLOURS: Record<Way, string> = { appeared: "#009e73", gone: "#d55e00", warmer: "#f0e442", colder: "#56b4e9", moved: "#cc79a7" };
const NAMES: Record<Way, string> = { appeared: "New", gone: "Gone", warmer: "Warmer", colder: "Colder", moved: "Moved by a voxel" };
const HINTS: Record<Way, string> = {
  appeared: "something is there, and was not", gone: "nothing is there any more", warmer: "by more than 5 °C", colder: "by more than 5 °C",
  moved: "next to a surface that was there: mostly a pose that is off",
};

function swatch(way: Way): HTMLElement {
  const made = h("span", { class: "swatch" });
  made.style.background = COLOURS[way];
  return made;
}

export class ChangesPanel {
  readonly element = h("section", { class: "changes", "aria-label": "Changes", hidden: true });
  onFly: (thing: ChangedThing) => void = () => {};
  /** Show the voxels of one way, or hide them. */
  onWay: (way: Way) => void = () => {};
  onClose: () => void = () => {};

  close(): void {
    this.element.hidden = true;
    fill(this.element);
  }

  say(text: string): void {
    this.open(h("p", { role: "status" }, text));
  }

  show(changes: Changes, things: readonly ChangedThing[], hidden: ReadonlySet<Way>): void {
    const ways = WAYS.filter((way) => changes.counts[way] > 0).map((way) => this.way(way, changes.counts[way], !hidden.has(way)));
    const listed = things.filter(({ way }) => !hidden.has(way));
    const span = `From ${clock(changes.since_s)} to ${changes.until_s === null ? "now" : clock(changes.until_s)}`;
    const more = listed.length > THINGS_MAX && h("p", { class: "hint" }, `and ${listed.length - THINGS_MAX} smaller ones`);
    this.open(
      h("p", { class: "hint" }, span),
      ways.length ? h("ul", { class: "ways" }, ...ways) : h("p", { role: "status" }, "Nothing changed that was looked at."),
      h("ol", { class: "finds" }, ...listed.slice(0, THINGS_MAX).map((thing) => this.thing(thing))), more,
    );
  }

  private open(...children: (HTMLElement | false)[]): void {
    const close = h("button", { type: "button", "aria-label": "End the comparison", title: "End the comparison", onclick: () => this.onClose() }, "×");
    this.element.hidden = false;
    fill(this.element, h("h2", {}, "Changes ", close), ...children);
  }

  private way(way: Way, count: number, isOn: boolean): HTMLElement {
    const button = h(
      "button", { type: "button", "aria-pressed": String(isOn), title: HINTS[way], onclick: () => this.onWay(way) },
      swatch(way), ` ${NAMES[way]}: ${counted(count, "voxel", "voxels")}`,
    );
    return h("li", {}, button);
  }

  private thing(thing: ChangedThing): HTMLElement {
    const { way, voxels, lowM, highM } = thing;
    const size = highM.map((high, axis) => metres(high - lowM[axis]!, 1).replace(" m", "")).join(" × ");
    const text = `${NAMES[way]}, ${size} m`;
    const button = h(
      "button", { type: "button", class: "find", title: "Fly to where it is seen", onclick: () => this.onFly(thing) },
      swatch(way), h("strong", {}, text), h("span", { class: "state" }, counted(voxels, "voxel", "voxels")),
    );
    return h("li", {}, button);
  }
}
