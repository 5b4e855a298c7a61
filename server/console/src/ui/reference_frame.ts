/** Where one is in the map: how long a metre is, which way the axes point, and what is under the pointer.
 *
 * The map knows no north: its axes are those of the frame in which the robots' poses are told. */

import { Vector3 } from "three";
import { h, svg } from "../dom.ts";
import { readingOf, type Picked, type Picker } from "../scene/picking.ts";
import type { Stage } from "../scene/stage.ts";
import { celsius, metres } from "../units.ts";

const LONGEST_PX = 120;
const AXES_PX = 30;
/** The pointer rests so long before the map is asked what is under it, ms. */
const REST_MS = 120;
const AXES = [
  { name: "x", way: new Vector3(1, 0, 0), colour: "var(--axis-x)" },
  { name: "y", way: new Vector3(0, 1, 0), colour: "var(--axis-y)" },
  { name: "z", way: new Vector3(0, 0, 1), colour: "var(--axis-z)" },
];

export class ReferenceFrame {
  readonly element: HTMLElement;
  /** Upper face of the floor, m in the map; null: none is known. */
  floorM: number | null = null;
  private readonly stage: Stage;
  private readonly picker: Picker;
  private readonly said = h("output", { class: "pointer" });
  private readonly length = h("span", {});
  private readonly bar = h("span", { class: "bar-m" }, this.length);
  private readonly axes: { line: SVGElement; text: SVGElement; way: Vector3 }[];
  private resting = 0;

  constructor(stage: Stage, picker: Picker) {
    this.stage = stage;
    this.picker = picker;
    this.axes = AXES.map(({ name, way, colour }) => ({
      line: svg("line", { x1: 0, y1: 0, stroke: colour, "stroke-width": 2 }), text: svg("text", { fill: colour }, name), way,
    }));
    const size = 2 * AXES_PX + 20;
    const cross = svg(
      "svg", { width: size, height: size, viewBox: `${-size / 2} ${-size / 2} ${size} ${size}`, role: "img", "aria-label": "Axes of the map's frame" },
      ...this.axes.flatMap(({ line, text }) => [line, text]),
    );
    this.element = h("div", { class: "frame" }, cross, this.bar, this.said);
    const { canvas } = stage;
    canvas.addEventListener("pointermove", ({ offsetX, offsetY, buttons, pointerType }) => {
      window.clearTimeout(this.resting);
      if (buttons || pointerType === "touch") return;
      this.resting = window.setTimeout(() => this.point(offsetX, offsetY), REST_MS);
    });
    canvas.addEventListener("pointerleave", () => {
      window.clearTimeout(this.resting);
      this.said.textContent = "";
    });
  }

  /** As the eye is now; to be called with each frame. */
  show(): void {
    const { camera, controls, canvas } = this.stage;
    const back = camera.quaternion.clone().invert();
    for (const { line, text, way } of this.axes) {
      const { x, y } = way.clone().applyQuaternion(back).multiplyScalar(AXES_PX);
      for (const [name, value] of [["x2", x], ["y2", -y]] as const) line.setAttribute(name, value.toFixed(1));
      for (const [name, value] of [["x", x * 1.2 - 3], ["y", 4 - y * 1.2]] as const) text.setAttribute(name, value.toFixed(1));
    }
    // In the middle of the picture, as far off as what is looked at.
    const distanceM = camera.position.distanceTo(controls.target);
    const pxPerM = canvas.clientHeight / (2 * Math.tan((camera.fov * Math.PI) / 360) * distanceM);
    const longM = roundM(LONGEST_PX / pxPerM);
    this.length.textContent = longM >= 1 ? `${longM} m` : `${Math.round(longM * 100)} cm`;
    this.bar.style.width = `${(longM * pxPerM).toFixed(1)}px`;
  }

  dispose(): void {
    window.clearTimeout(this.resting);
  }

  private point(x: number, y: number): void {
    const picked = this.picker.at(x, y);
    this.said.textContent = picked ? saidOf(picked, this.floorM) : "";
  }
}

/** Place and reading, in one line. */
function saidOf(picked: Picked, floorM: number | null): string {
  const { point } = picked;
  const { hottestK } = readingOf(picked.cell, picked.row);
  return [
    `x ${point.x.toFixed(2)}  y ${point.y.toFixed(2)}`,
    floorM === null ? `z ${metres(point.z)}` : `${metres(point.z - floorM)} over the floor`, hottestK === null ? "" : celsius(hottestK),
  ].filter(Boolean).join(" · ");
}

/** The longest of 1, 2, 5, 10, ... m that is no longer. */
export function roundM(mostM: number): number {
  const ten = 10 ** Math.floor(Math.log10(mostM));
  const step = [5, 2, 1].find((one) => one * ten <= mostM) ?? 1;
  return Number((step * ten).toPrecision(1));
}
