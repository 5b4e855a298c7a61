/** Lengths and areas by clicks: each click on a surface adds a point, where the pixel's ray meets the voxel. */

import { BufferGeometry, Float32BufferAttribute, LineBasicMaterial, LineSegments, Vector3 } from "three";
import { facts, fill, h } from "../dom.ts";
import { metres } from "../units.ts";

const PINK = 0xff3d7f;

export class MeasurePanel {
  readonly element = h("section", { "aria-label": "Measure" });
  readonly lines = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ color: PINK, depthTest: false }));
  onChange: () => void = () => {};
  /** Clicks set points from now on, or no more. */
  onSwitch: (isOn: boolean) => void = () => {};
  private readonly voxelM: number;
  private readonly points: Vector3[] = [];
  private readonly toggle = h("button", { type: "button", "aria-pressed": "false", title: "Clicks set points (M)" }, "Set points");
  private readonly undo = h("button", { type: "button" }, "Undo");
  private readonly again = h("button", { type: "button" }, "Clear");
  private readonly said = h("div", { role: "status" });

  constructor(voxelM: number) {
    this.voxelM = voxelM;
    this.lines.frustumCulled = false;
    this.lines.renderOrder = 11;
    this.toggle.addEventListener("click", () => this.switch());
    this.undo.addEventListener("click", () => (this.points.pop(), this.show()));
    this.again.addEventListener("click", () => this.clear());
    fill(this.element, h("h2", {}, "Measure"), h("div", { class: "buttons" }, this.toggle, this.undo, this.again), this.said);
    this.show();
  }

  /** Whether clicks set points, rather than ask of voxels. */
  get isOn(): boolean {
    return this.toggle.getAttribute("aria-pressed") === "true";
  }

  switch(): void {
    this.toggle.setAttribute("aria-pressed", String(!this.isOn));
    this.show();
    this.onSwitch(this.isOn);
  }

  add(point: Vector3): void {
    this.points.push(point.clone());
    this.show();
  }

  clear(): void {
    this.points.length = 0;
    this.show();
  }

  private show(): void {
    const { points } = this;
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
      const rise = points[points.length - 1].z - points[points.length - 2].z;
      rows.push(["last step", `${metres(steps[steps.length - 1])}, rises ${metres(rise)}`]);
    }
    if (steps.length > 1) rows.push(["along all", metres(steps.reduce((sum, step) => sum + step, 0))]);
    if (points.length > 2) rows.push(["area", `${areaOf(points).toFixed(2)} m²`]);
    const hint = !this.isOn && !points.length ? "Lengths of two clicks, areas of three or more."
      : points.length < 2 ? "Click surfaces of the map." : `Each end is exact to about a voxel, ${metres(this.voxelM)}.`;
    fill(this.said, rows.length > 0 && facts(rows), h("p", { class: "hint" }, hint));
    this.onChange();
  }
}

/** Of the polygon with these corners, m²: half the length of its vector area (Newell), so of its flattest picture. */
export function areaOf(corners: readonly Vector3[]): number {
  const sum = new Vector3();
  corners.forEach((corner, n) => {
    const a = corner.clone().sub(corners[0]);
    sum.add(a.cross(corners[(n + 1) % corners.length].clone().sub(corners[0])));
  });
  return sum.length() / 2;
}
