/** Measures by clicks: lengths, profiles, areas and volumes; each click on a surface adds a point, where the pixel's ray meets the voxel.
 *
 * What was measured is written at its line, too, and is of what is shown: a ceiling that is cut off is not in it. */

import { BufferGeometry, Float32BufferAttribute, LineBasicMaterial, LineSegments, Vector3 } from "three";
import { facts, fill, h, svg } from "../dom.ts";
import { POINTS_MAX, type Look } from "../look.ts";
import type { Triple } from "../messages.ts";
import type { Cells } from "../scene/cells.ts";
import { uniforms } from "../scene/materials.ts";
import { profileOf, volumeOver, type Profile } from "../scene/section.ts";
import type { Stage } from "../scene/stage.ts";
import { metres } from "../units.ts";

const PINK = 0xff3d7f;
/** Size of a profile's picture, px. */
const PROFILE = { width: 244, height: 80 };

export class MeasurePanel {
  readonly element = h("section", { "aria-label": "Measure" });
  readonly lines = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ color: PINK, depthTest: false }));
  onChange: () => void = () => {};
  /** Clicks set points from now on, or no more. */
  onSwitch: (isOn: boolean) => void = () => {};
  private readonly voxelM: number;
  private points: Vector3[] = [];
  private readonly toggle = h("button", { type: "button", "aria-pressed": "false", title: "Clicks set points (M)" }, "Set points");
  private readonly undo = h("button", { type: "button" }, "Undo");
  private readonly again = h("button", { type: "button" }, "Clear");
  private readonly said = h("div", { role: "status" });
  /** Words at the lines, in the picture. */
  readonly words = h("div", { class: "lengths", "aria-hidden": "true" });
  private written: { word: HTMLElement; at: Vector3 }[] = [];
  /** State of the picture of which profile and volume were made. */
  private madeOf = "";
  private readonly cells: Cells;
  private readonly look: Look;

  constructor(cells: Cells, look: Look, voxelM: number) {
    this.cells = cells;
    this.look = look;
    this.voxelM = voxelM;
    this.lines.frustumCulled = false;
    this.lines.renderOrder = 11;
    this.toggle.addEventListener("click", () => this.switch());
    this.undo.addEventListener("click", () => (this.points.pop(), this.show()));
    this.again.addEventListener("click", () => this.clear());
    fill(this.element, h("h2", {}, "Measure"), h("div", { class: "buttons" }, this.toggle, this.undo, this.again), this.said);
    this.follow();
  }

  /** Take the points that an address names. */
  follow(): void {
    this.points = this.look.points.map((point) => new Vector3(...point));
    this.show();
  }

  /** Measure again where what is shown has become finer, or is of another moment; a few times a second. */
  tick(): void {
    if (this.points.length > 1 && !this.cells.waiting && !this.cells.needsPlan && this.madeOf !== this.shown) this.show();
  }

  /** State of the picture, as a key. */
  private get shown(): string {
    const { uLow, uHigh, uMinP } = uniforms;
    return JSON.stringify([this.cells.drawn, this.cells.head, this.look.atS, uLow.value, uHigh.value, uMinP.value]);
  }

  /** Clicks set points, rather than ask of voxels. */
  get isOn(): boolean {
    return this.toggle.getAttribute("aria-pressed") === "true";
  }

  switch(): void {
    this.toggle.setAttribute("aria-pressed", String(!this.isOn));
    this.show();
    this.onSwitch(this.isOn);
  }

  /** Add a point, unless there are as many as an address holds. */
  add(point: Vector3): void {
    if (this.points.length < POINTS_MAX) this.points.push(point.clone());
    this.show();
  }

  clear(): void {
    this.points.length = 0;
    this.show();
  }

  /** Before a frame: words at their lines. */
  place({ camera, canvas }: Stage): void {
    for (const { word, at } of this.written) {
      const { x, y, z } = at.clone().project(camera);
      word.hidden = z > 1 || Math.abs(x) > 1 || Math.abs(y) > 1;
      word.style.transform = `translate(${((x + 1) / 2) * canvas.clientWidth}px, ${((1 - y) / 2) * canvas.clientHeight}px)`;
    }
  }

  private write(steps: readonly number[]): void {
    this.written = steps.map((step, n) => {
      const { rise, level } = riseOf(this.points[n], this.points[n + 1]);
      const parts = Math.abs(rise) > this.voxelM && level > this.voxelM ? ` (level ${metres(level)}, rises ${metres(rise)})` : "";
      return { word: h("span", { class: "length" }, metres(step) + parts), at: this.points[n].clone().lerp(this.points[n + 1], 0.5) };
    });
    fill(this.words, ...this.written.map(({ word }) => word));
  }

  private show(): void {
    const { points } = this;
    this.look.points = points.map((point) => point.toArray() as Triple);
    this.madeOf = this.shown;
    this.undo.disabled = this.again.disabled = points.length === 0;
    const steps = points.slice(1).map((point, n) => point.distanceTo(points[n]));
    const ends = points.slice(1).flatMap((point, n) => [...points[n].toArray(), ...point.toArray()]);
    if (points.length > 2) ends.push(...points[points.length - 1].toArray(), ...points[0].toArray());
    const arm = this.voxelM / 2;
    for (const point of points) {
      for (const axis of [0, 1, 2]) {
        const step = new Vector3().setComponent(axis, arm);
        ends.push(...point.clone().sub(step).toArray(), ...point.clone().add(step).toArray());
      }
    }
    this.lines.geometry.dispose();
    this.lines.geometry = new BufferGeometry();
    this.lines.geometry.setAttribute("position", new Float32BufferAttribute(ends, 3));
    const rows: [string, string][] = [];
    if (steps.length) {
      const { rise, level } = riseOf(points[points.length - 2], points[points.length - 1]);
      rows.push(["last step", `${metres(steps[steps.length - 1])}, rises ${metres(rise)}`], ["level", metres(level)]);
    }
    if (steps.length > 1) rows.push(["along all", metres(steps.reduce((sum, step) => sum + step, 0))]);
    if (points.length > 2) {
      rows.push(["area", `${areaOf(points).toFixed(2)} m²`]);
      const volume = volumeOver(this.cells, points);
      if (volume) rows.push(["volume over it", volumeSaid(volume)]);
    }
    const profile = steps.length ? profileOf(this.cells, points[points.length - 2], points[points.length - 1]) : null;
    const hint = !this.isOn && !points.length ? "Length and profile of two clicks, area and volume of three or more."
      : points.length < 2 ? "Click surfaces of the map." : points.length === POINTS_MAX ? `${POINTS_MAX} points are the most.` : `Each end is exact to about a voxel, ${metres(this.voxelM)}.`;
    this.write(steps);
    fill(this.said, rows.length > 0 && facts(rows), profile && profilePicture(profile), h("p", { class: "hint" }, hint));
    this.onChange();
  }
}

function riseOf(from: Vector3, to: Vector3): { rise: number; level: number } {
  return { rise: to.z - from.z, level: Math.hypot(to.x - from.x, to.y - from.y) };
}

function volumeSaid({ volumeM3, covered }: { volumeM3: number; covered: number }): string {
  return `${volumeM3.toFixed(volumeM3 < 1 ? 3 : 2)} m³${covered < 0.995 ? `; ${Math.round(100 * covered)} % of the area has a surface` : ""}`;
}

/** Highest surfaces along the last line; where nothing is shown it is open. */
function profilePicture({ stepM, tops }: Profile): HTMLElement {
  const known = [...tops].filter((top) => !Number.isNaN(top));
  if (!known.length) return h("p", { class: "hint" }, "Nothing is shown along the line.");
  const [low, high] = [Math.min(...known), Math.max(...known)];
  const { width, height } = PROFILE;
  const y = (top: number) => height - 4 - ((top - low) / Math.max(high - low, stepM)) * (height - 8);
  const wide = width / tops.length;
  const path = [...tops].map((top, n) => (Number.isNaN(top) ? "" : `M${(n * wide).toFixed(1)} ${y(top).toFixed(1)}h${wide.toFixed(2)}`)).join("");
  const text = `Profile of ${metres(tops.length * stepM)}: surfaces from ${metres(low)} to ${metres(high)} in the map, ${metres(high - low)} apart`;
  return h(
    "figure", { class: "profile" }, svg("svg", { ...PROFILE, viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": text }, svg("path", { d: path })),
    h("figcaption", { class: "hint" }, `${text}.`),
  );
}

/** Area of the polygon with these corners, m²: half the length of its vector area (Newell), so of its flattest picture. */
export function areaOf(corners: readonly Vector3[]): number {
  const sum = new Vector3();
  corners.forEach((corner, n) => {
    const a = corner.clone().sub(corners[0]);
    sum.add(a.cross(corners[(n + 1) % corners.length].clone().sub(corners[0])));
  });
  return sum.length() / 2;
}
