/** Short notes over the picture: that a roof is cut off, that cells are left out, that a map is still on its way. */

import { h } from "../dom.ts";
import type { Look } from "../look.ts";
import type { Cells } from "../scene/cells.ts";
import type { Storeys } from "../scene/storeys.ts";
import { counted, metres } from "../units.ts";

export class Chips {
  readonly element: HTMLElement;
  /** Cut the ceiling off, or show it again. */
  onCeiling: () => void = () => {};
  private readonly ceiling: HTMLButtonElement;
  private readonly loading = h("span", { class: "chip", role: "status", hidden: true });
  private readonly past = h("span", { class: "chip late", role: "status", hidden: true });
  private readonly leftOut = h("span", { class: "chip late", role: "status", hidden: true });

  constructor() {
    this.ceiling = h("button", { type: "button", class: "chip", title: "Ceiling off or on (C)", hidden: true, onclick: () => this.onCeiling() });
    this.element = h("div", { class: "chips" }, this.past, this.ceiling, this.loading, this.leftOut);
  }

  /** Heights are told over `zeroM`; `past`: that the map is not shown as it is. */
  show(look: Look, cells: Cells, { isRoofed }: Storeys, zeroM: number, past: string): void {
    say(this.past, past);
    say(this.ceiling, look.ceilingM !== null ? `Ceiling off above ${metres(look.ceilingM - zeroM, 1)}: show it` : isRoofed ? "Ceiling on: cut it off" : "");
    const all = cells.all.size;
    const here = [...cells.all.values()].filter(({ etag }) => etag !== null).length;
    say(this.loading, cells.firstPictureMs === null && all > 0 ? `Loading the map: ${here} of ${counted(all, "cell", "cells")}` : "");
    say(this.leftOut, cells.leftOut ? `${counted(cells.leftOut, "cell", "cells")} not shown: come closer` : "");
  }
}

function say(chip: HTMLElement, text: string): void {
  if (chip.textContent !== text) chip.textContent = text;
  chip.hidden = text === "";
}
