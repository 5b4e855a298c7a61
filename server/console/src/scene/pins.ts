/** Pins: findings in the picture, each with its number and what it is in words, never by a colour alone.
 *
 * The first ones, by number, are elements over the canvas, which take clicks. All others are one cloud of dots. */

import {
  BoxGeometry, BufferGeometry, EdgesGeometry, Float32BufferAttribute, Group, LineBasicMaterial, LineSegments, Points, PointsMaterial, Vector3,
} from "three";
import { h } from "../dom.ts";
import type { Finding } from "../findings.ts";
import type { Stage } from "./stage.ts";

/** Elements that are moved with each frame: more would slow it. */
const PINS_MAX = 40;
const DOT_PX = 7;
const AMBER = 0xffb000;
/** Of a box around a point, and beyond the faces of what it is around; m. */
const LEAST_M = 0.1;
const BEYOND_M = 0.02;
/** Height of a pin: those of which one would lie over another show their number alone. */
const HIGH_PX = 26;
const SIGNS: Record<Finding["state"], string> = { new: "", seen: "✓", dismissed: "×", mark: "⚑" };

export class Pins {
  readonly element = h("div", { class: "pins", "aria-hidden": "true" });
  /** What is drawn over the map: the dots, and the box of the finding that is chosen. */
  readonly group = new Group();
  readonly dots: Points;
  private readonly box = new LineSegments(new EdgesGeometry(new BoxGeometry(1, 1, 1)), new LineBasicMaterial({ color: AMBER, depthTest: false }));
  onChoose: (id: string) => void = () => {};
  private pins: { pin: HTMLElement; place: Vector3; width: number }[] = [];
  private shown = "";
  private readonly stage: Stage;

  constructor(stage: Stage) {
    this.stage = stage;
    const material = new PointsMaterial({ color: AMBER, size: DOT_PX, sizeAttenuation: false, depthTest: false, transparent: true });
    this.dots = new Points(new BufferGeometry(), material);
    this.dots.frustumCulled = false;
    this.dots.renderOrder = 8;
    this.dots.visible = this.box.visible = false;
    this.box.renderOrder = 9;
    this.group.add(this.dots, this.box);
  }

  show(findings: readonly Finding[], chosen: string | null): void {
    const state = JSON.stringify([chosen, findings.map(({ id, number, state, place, celsius, title }) => [id, number, state, place, celsius, title])]);
    if (state === this.shown) return;
    this.shown = state;
    this.pins = findings.slice(0, PINS_MAX).map((one) => ({ pin: this.pin(one, one.id === chosen), place: new Vector3(...one.place), width: 0 }));
    // What matters most lies over what matters less.
    this.pins.forEach(({ pin }, n) => (pin.style.zIndex = String(pin.classList.contains("chosen") ? PINS_MAX + 1 : PINS_MAX - n)));
    this.element.replaceChildren(...this.pins.map(({ pin }) => pin));
    const rest = findings.slice(PINS_MAX).flatMap(({ place }) => place);
    this.dots.geometry.dispose();
    this.dots.geometry = new BufferGeometry();
    this.dots.geometry.setAttribute("position", new Float32BufferAttribute(rest, 3));
    this.dots.visible = rest.length > 0;
    const found = findings.find(({ id }) => id === chosen);
    this.box.visible = found !== undefined;
    if (found) {
      const [low, high] = found.box.map((corner) => new Vector3(...corner));
      this.box.scale.copy(high.clone().sub(low).addScalar(2 * BEYOND_M).max(new Vector3(LEAST_M, LEAST_M, LEAST_M)));
      this.box.position.copy(low.add(high).multiplyScalar(0.5));
    }
    this.stage.draw();
  }

  /** Before a frame: where each is in the picture now. */
  place(): void {
    const { clientWidth, clientHeight } = this.stage.canvas;
    const at = new Vector3();
    const taken: { x: number; y: number; end: number }[] = [];
    for (const one of this.pins) {
      const { pin } = one;
      at.copy(one.place).project(this.stage.camera);
      pin.hidden = at.z > 1 || Math.abs(at.x) > 1 || Math.abs(at.y) > 1;
      if (pin.hidden) continue;
      one.width ||= pin.offsetWidth;
      const [x, y] = [((at.x + 1) / 2) * clientWidth, ((1 - at.y) / 2) * clientHeight];
      const end = x + one.width;
      pin.classList.toggle("small", taken.some((other) => Math.abs(other.y - y) < HIGH_PX && x < other.end && other.x < end));
      pin.style.transform = `translate(${x}px, ${y}px)`;
      taken.push({ x, y, end });
    }
  }

  dispose(): void {
    this.dots.geometry.dispose();
    (this.dots.material as PointsMaterial).dispose();
    this.box.geometry.dispose();
    this.box.material.dispose();
  }

  private pin({ id, number, state, celsius, title }: Finding, isChosen: boolean): HTMLElement {
    const said = celsius === null ? title : `${celsius.toFixed(1)} °C`;
    return h(
      "span", { class: isChosen ? "pin chosen" : "pin", "data-state": state, onclick: () => this.onChoose(id) },
      h("b", {}, `${SIGNS[state]}${number}`), h("span", {}, said.length > 24 ? `${said.slice(0, 23)}…` : said),
    );
  }
}
