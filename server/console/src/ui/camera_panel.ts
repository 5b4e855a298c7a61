/** Where to look from: all, above, inside, and the hottest place that is shown. */

import { Box3, Vector3 } from "three";
import { h } from "../dom.ts";
import type { CameraView } from "../look.ts";
import type { MapInfo, Triple } from "../messages.ts";
import type { Cells } from "../scene/cells.ts";
import { uniforms } from "../scene/materials.ts";
import type { Stage } from "../scene/stage.ts";
import { standing } from "../scene/standpoint.ts";
import { hottest, type HotPlace } from "../scene/statistics.ts";
import { visibleFrom } from "../scene/viewpoint.ts";
import type { Team } from "../team.ts";

const SIDE = new Vector3(-0.7, -1, 0.75);
/** How much of the map is seen around a place that is looked at from above, m. */
const OVER_M = 6;
const ABOVE = new Vector3(0, -0.001, 1);

export class CameraPanel {
  readonly element: HTMLElement;
  /** Whether the camera stands where it was put, so that the first cells do not move it. */
  isPlaced: boolean;
  /** The operator wants the hottest place; it is there. */
  onHottest: (place: HotPlace | null) => void = () => {};
  onGo: () => void = () => {};
  /** Before a place is looked for in what is shown. */
  onSearch: () => void = () => {};
  onNoFloor: () => void = () => {};
  /** The operator stands in the map. */
  onWalk: () => void = () => {};
  private readonly stage: Stage;
  private readonly cells: Cells;
  private readonly team: Team;
  /** View of all of the map that was given last, and the picture's width by its height at that time. */
  private whole = "";
  private aspect = 0;

  constructor(stage: Stage, cells: Cells, team: Team, info: MapInfo, camera: CameraView | null) {
    this.stage = stage;
    this.cells = cells;
    this.team = team;
    this.isPlaced = camera !== null;
    if (camera) stage.place(camera);
    else if (info.box_m) stage.place(stage.lookAt([new Box3(new Vector3(...info.box_m[0]), new Vector3(...info.box_m[1]))], SIDE));
    const button = (label: string, title: string, run: () => void) => h("button", { type: "button", title, onclick: run }, label);
    this.element = h(
      "section", { "aria-label": "Camera" }, h("h2", {}, "Camera"),
      h(
        "div", { class: "buttons" },
        button("All", "All of the map (H)", () => this.home()), button("Top", "From above (T)", () => this.top()),
        button("Walk", "Inside, at a person's height (W)", () => this.walk()),
        button("Hottest", "The hottest place shown (X)", () => this.hottest()),
      ),
    );
  }

  /** Look at what there is, once all of it is there, unless the operator looks elsewhere already; and again where a phone is turned. */
  settle(): void {
    const { aspect } = this.stage.camera;
    const isTurned = aspect !== this.aspect && JSON.stringify(this.stage.view) === this.whole;
    this.aspect = aspect;
    if (this.cells.firstPictureMs === null || (this.isPlaced && !isTurned)) return;
    this.isPlaced = true;
    this.stage.place(this.stage.lookAt(this.cells.tightBoxes, SIDE));
    this.whole = JSON.stringify(this.stage.view);
  }

  home(): void {
    const all = this.stage.lookAt(this.cells.tightBoxes, SIDE);
    this.go(all);
    this.whole = JSON.stringify(all);
  }

  top(): void {
    this.go(this.stage.lookAt(this.cells.tightBoxes, ABOVE));
  }

  /** Look down at a place, from a room's width over it. */
  over(place: Triple): void {
    const around = new Box3().setFromCenterAndSize(new Vector3(...place), new Vector3(OVER_M, OVER_M, 0.5));
    this.go(this.stage.lookAt([around], ABOVE));
  }

  /** Stand on the floor, as near as can be to where a robot is, and look where most of the map is seen. */
  walk(): void {
    const target = new Vector3(...this.stage.view.target);
    const view = standing(this.cells, this.team.nearest(target) ?? target);
    if (!view) return this.onNoFloor();
    this.go(view);
    this.onWalk();
  }

  /** Go to the hottest place that is shown. */
  hottest(): void {
    this.onSearch();
    const { uLow, uHigh, uMinP } = uniforms;
    const shown = new Box3(uLow.value, uHigh.value);
    const found = hottest(this.cells, (place, p) => shown.containsPoint(place) && p >= uMinP.value);
    if (found) this.go(visibleFrom(this.cells, found.centre, this.stage.camera.position));
    this.onHottest(found);
  }

  /** Fly somewhere, and follow nobody any more. */
  go(to: CameraView): void {
    this.isPlaced = true;
    this.team.follow(null);
    this.stage.fly(to); // first, so that Back leads to what was shown until now
    this.onGo();
  }
}
