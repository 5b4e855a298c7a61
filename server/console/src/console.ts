/** One map on the page: the picture, the panels around it, and what flows between them. */

import { Box3, Vector3 } from "three";
import type { Api } from "./api.ts";
import { h } from "./dom.ts";
import { LiveLink, type LinkState } from "./live.ts";
import { FIELDS, toHash, type CameraView, type Field, type Look } from "./look.ts";
import type { LiveEvent, MapInfo, Triple } from "./messages.ts";
import { rgbOf, robotColour, textureOf, type Palette } from "./palettes.ts";
import { Cells } from "./scene/cells.ts";
import { CellGrid, Outline } from "./scene/lines.ts";
import { boxes, FIELD_CODES, squares, uniforms } from "./scene/materials.ts";
import { Picker } from "./scene/picking.ts";
import { Stage } from "./scene/stage.ts";
import { hottest, rangeOf } from "./scene/statistics.ts";
import { Team } from "./team.ts";
import { CommitStrip } from "./ui/commit_strip.ts";
import { Legend } from "./ui/legend.ts";
import { MeasurePanel } from "./ui/measure_panel.ts";
import { LookPanel } from "./ui/look_panel.ts";
import { openCommit } from "./ui/retract_dialog.ts";
import { TakeAwayPanel } from "./ui/take_away_panel.ts";
import { applyTheme, type TopBar } from "./ui/top_bar.ts";
import { VoxelPanel } from "./ui/voxel_panel.ts";
import { celsius, KELVIN_ZERO_C, metres, thousands } from "./units.ts";

const UNSEEN_COLOUR = 0xffb000;
const SOFTWARE_BUDGET = 150_000;
const TICK_MS = 250;
const SIDE = new Vector3(-0.7, -1, 0.75);

export class Console {
  readonly element: HTMLElement;
  readonly stage: Stage;
  readonly cells: Cells;
  readonly picker: Picker;
  readonly link: LiveLink;
  readonly team: Team;
  readonly strip: CommitStrip;
  readonly voxel: VoxelPanel;
  readonly measure: MeasurePanel;
  private readonly api: Api;
  private readonly info: MapInfo;
  private readonly look: Look;
  private readonly bar: TopBar;
  private readonly legend = new Legend();
  private readonly panel: LookPanel;
  private readonly takeAway: TakeAwayPanel;
  private readonly grid = new CellGrid();
  /** Cells that changed since the robot that is followed fetched last. */
  private readonly unseen = new CellGrid(UNSEEN_COLOUR, 1);
  private readonly outline = new Outline();
  private readonly foot = h("span", { class: "figures" });
  private readonly flag = h("span", { class: "flag", role: "status" });
  private state: LinkState = { live: false, heardMs: null };
  private moved = true;
  private framed: boolean;
  private loading: Promise<void>;
  /** State that the index was last taken from. */
  private cursor = "";
  private readonly timer: number;
  private readonly palettes = new Map<Palette, ReturnType<typeof textureOf>>();

  constructor(api: Api, info: MapInfo, look: Look, camera: CameraView | null, bar: TopBar, onRefused: () => void) {
    this.api = api;
    this.info = info;
    this.look = look;
    this.bar = bar;
    const host = h("div", { class: "host" });
    const labels = h("div", { class: "labels", "aria-hidden": "true" });
    this.strip = new CommitStrip(api, info.name);
    this.voxel = new VoxelPanel(api, info.name);
    this.takeAway = new TakeAwayPanel(api, info, look);
    this.panel = new LookPanel(look);
    this.measure = new MeasurePanel(info.geometry.voxel_edge_um / 1e6);
    const view = h("main", { class: "view" }, host, labels, this.flag, this.legend.element);
    const left = h("aside", { class: "left", "aria-label": "Team and map" });
    const right = h("aside", { class: "right", "aria-label": "Tools" }, this.panel.element, this.voxel.element, this.measure.element, this.takeAway.element);
    this.element = h("div", { class: "console" }, left, view, right, h("footer", {}, this.strip.element, this.foot));
    document.body.append(this.element);
    this.stage = new Stage(host);
    this.cells = new Cells(api, info);
    this.cells.budget = this.stage.isSoftware ? SOFTWARE_BUDGET : 2_000_000;
    this.team = new Team(api, info.name, labels, this.stage);
    view.append(h("div", { class: "through" }, this.team.picture.element, this.team.fromPose.element));
    left.append(this.presets(), this.team.panel.element, this.mapFacts());
    this.picker = new Picker(this.stage, this.cells);
    this.stage.add(this.cells.group, this.grid.lines, this.unseen.lines, this.outline.lines, this.measure.lines, this.team.group);
    this.framed = camera !== null;
    if (camera) this.stage.place(camera);
    else if (info.box_m) this.stage.place(this.stage.lookAt(new Box3(new Vector3(...info.box_m[0]), new Vector3(...info.box_m[1])), SIDE));
    this.connect(onRefused);
    this.loading = Promise.resolve();
    this.link = new LiveLink(api, info.name, (event) => this.heard(event), (state) => (this.state = state), onRefused);
    this.timer = window.setInterval(() => this.tick(), TICK_MS);
    this.theme();
    this.apply();
    this.loading = this.reload();
    void this.prepare();
  }

  /** Compile the voxels' shaders on a voxel that nobody sees, while the first cells are on their way. */
  private async prepare(): Promise<void> {
    const sample = this.cells.sample();
    this.stage.add(sample);
    await this.stage.prepare();
    this.stage.scene.remove(sample);
  }

  dispose(): void {
    window.clearInterval(this.timer);
    this.link.close();
    this.cells.dispose();
    this.stage.renderer.dispose();
    this.element.remove();
  }

  setField(field: Field): void {
    this.look.field = field;
    this.apply();
  }

  step(up: boolean): void {
    this.panel.step(up);
  }

  toggleGrid(): void {
    this.look.cells = !this.look.cells;
    this.panel.show();
    this.apply();
  }

  /** The address that shows the same. */
  get address(): string {
    return new URL(toHash(this.info.name, this.look, this.stage.view), document.baseURI).href;
  }

  home(): void {
    this.team.follow(null);
    this.stage.fly(this.stage.lookAt(this.cells.tightBounds, SIDE));
  }

  top(): void {
    this.team.follow(null);
    this.stage.fly(this.stage.lookAt(this.cells.tightBounds, new Vector3(0, -0.001, 1)));
  }

  /** Stand inside, eyes at the height of a person's, where a robot is, and look towards the middle of the map. */
  walk(): void {
    this.team.follow(null);
    const { target } = this.stage.view;
    const box = this.cells.tightBounds;
    const robot = this.team.nearest(new Vector3(...target));
    const ahead = box.getCenter(new Vector3()).sub(robot ?? box.min).setZ(0);
    if (ahead.lengthSq() < 1e-6) ahead.set(0, 1, 0);
    ahead.normalize();
    const z = robot ? robot.z + 0.6 : box.min.z + 1.6;
    const stand = robot ?? box.clampPoint(new Vector3(...target), new Vector3());
    const from = new Vector3(stand.x, stand.y, z);
    const to = from.clone().addScaledVector(ahead, 3);
    this.stage.fly({ eye: from.toArray() as Triple, target: to.toArray() as Triple });
  }

  /** Go to the hottest place that is shown. */
  jumpToHottest(): void {
    const { uLow, uHigh, uMinP } = uniforms;
    const shown = new Box3(uLow.value, uHigh.value);
    const found = hottest(this.cells, (place, p) => shown.containsPoint(place) && p >= uMinP.value);
    if (!found) return this.say("Nothing that is shown has a temperature.");
    this.team.follow(null);
    this.setField("temperature");
    const box = new Box3().setFromCenterAndSize(found.centre, new Vector3(1, 1, 1).multiplyScalar(1.6));
    this.stage.fly(this.stage.lookAt(box, SIDE));
    this.say(`Hottest: ${celsius(found.kelvin)} at ${found.centre.toArray().map((value) => value.toFixed(2)).join(", ")} m`);
  }

  say(text: string): void {
    this.flag.textContent = text;
  }

  /** Outline and name what lies under a place of the canvas. */
  ask(x: number, y: number): void {
    const picked = this.picker.at(x, y);
    if (this.measure.isOn) {
      if (picked) this.measure.add(picked.point);
      return;
    }
    this.outline.show(picked);
    this.stage.draw();
    this.takeAway.choose(picked?.cell.key ?? null);
    if (picked) void this.voxel.show(picked, this.cells.depthMax);
    else this.voxel.clear();
  }

  forget(): void {
    this.outline.show(null);
    this.team.follow(null);
    this.voxel.clear();
    this.say("");
    this.stage.draw();
  }

  theme(): void {
    const light = applyTheme() === "light";
    uniforms.uBare.value.set(...((light ? [0.62, 0.63, 0.66] : [0.42, 0.44, 0.47]) as Triple));
    this.stage.setBackground(light ? "#eef0f3" : "#0e1116");
  }

  private connect(onRefused: () => void): void {
    const { canvas } = this.stage;
    let down: [number, number] | null = null;
    canvas.addEventListener("pointerdown", (event) => (down = event.button === 0 ? [event.clientX, event.clientY] : null));
    canvas.addEventListener("pointerup", (event) => {
      if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 4) this.ask(event.offsetX, event.offsetY);
      down = null;
    });
    canvas.addEventListener("webglcontextrestored", () => this.stage.draw());
    this.stage.onMove = () => (this.moved = true);
    this.stage.onFrame = () => {
      this.team.place();
      return this.cells.isFresh;
    };
    this.cells.onChange = () => this.stage.draw();
    this.cells.onRefused = onRefused;
    this.cells.colourOf = (lm) => {
      const robot = this.strip.robotAt(lm);
      return robot === null ? null : rgbOf(robotColour(robot, this.team.names));
    };
    this.bar.onField = (field) => this.setField(field);
    this.bar.onTheme = () => this.theme();
    this.panel.onChange = () => this.apply();
    this.measure.onChange = () => this.stage.draw();
    this.panel.boxInView = () => this.boxInView();
    this.legend.onRange = (range) => {
      if (range) this.look.ranges[this.look.field] = range;
      else delete this.look.ranges[this.look.field];
      this.apply();
    };
    this.strip.onChoose = (entry) => openCommit(this.api, this.info.name, entry);
    this.team.onFollow = () => this.stage.draw();
  }

  private heard(event: LiveEvent): void {
    if (event.type === "hello") {
      this.team.greet(event.robots);
      if (!event.resumed) void this.loading.then(() => (this.cursor === event.cursor ? undefined : this.reload()));
    } else if (event.type === "cells") {
      if (event.cells === "many") void this.reload();
      else for (const [i, j, k, lm] of event.cells) this.cells.changed([i, j, k], lm);
    } else if (event.type === "log") {
      this.strip.add(event.entries);
      this.team.refresh();
    } else if (event.type === "robot") {
      this.team.hear(event.robot);
    }
  }

  /** Everything anew: what the page has of it stays. */
  private async reload(): Promise<void> {
    try {
      const { cursor, entries } = await this.api.cells(this.info.name);
      this.cursor = cursor;
      this.cells.takeIndex(entries);
      this.moved = true;
      this.team.refresh();
      await this.strip.load(entries.reduce((most, { lm }) => Math.max(most, lm), 0));
    } catch (error) {
      this.cells.error = (error as Error).message;
    }
  }

  /** A few times a second: what has no event of its own. */
  private tick(): void {
    if (this.moved || this.cells.needsPlan || this.cells.waiting) {
      this.moved = false;
      this.cells.update(this.stage.camera, this.stage.heightPx, this.stage.frustum);
      this.refreshRange();
    }
    if (!this.framed && this.cells.firstPictureMs !== null) {
      this.framed = true;
      this.stage.place(this.stage.lookAt(this.cells.tightBounds, SIDE));
    }
    const bounds = this.cells.tightBounds;
    if (!bounds.isEmpty()) this.panel.span(bounds.min.z, bounds.max.z);
    this.grid.lines.visible = this.look.cells;
    this.grid.update([...this.cells.all.values()].filter(({ points }) => points).map(({ box }) => box));
    this.bar.showLink(this.state, this.cells.waiting, this.cells.error);
    this.team.tick(this.look.field, this.cells.head);
    const { lastSeq } = this.team;
    const missed = lastSeq === null ? [] : [...this.cells.all.values()].filter(({ points, lm }) => points && lm > lastSeq);
    this.unseen.update(missed.map(({ box }) => box));
    const drawn = `${thousands(this.cells.drawn)} nodes of ${this.cells.all.size} cells`;
    this.foot.textContent = this.stage.isSoftware ? `${drawn} · drawn without a graphics card: coarser and slower` : drawn;
  }

  private refreshRange(): void {
    const { look } = this;
    const { uLow, uHigh, uRange } = uniforms;
    const found = look.field === "colour" || look.field === "robot" ? null : rangeOf(this.cells, look.field, uLow.value.z, uHigh.value.z);
    const zero = look.field === "temperature" ? KELVIN_ZERO_C : 0;
    const locked = look.ranges[look.field];
    const range = locked ?? (found && (found.map((end) => end - zero) as [number, number]));
    if (range) uRange.value.set(range[0] + zero, range[1] + zero);
    this.legend.show(look, range, this.team.names);
    this.stage.draw();
  }

  /** Uniforms as the look says; nothing else is touched, so nothing is fetched. */
  private apply(): void {
    const { look } = this;
    const { palette } = FIELDS.find(({ field }) => field === look.field)!;
    uniforms.uField.value = FIELD_CODES[look.field];
    if (palette) {
      if (!this.palettes.has(palette)) this.palettes.set(palette, textureOf(palette));
      uniforms.uPalette.value = this.palettes.get(palette)!;
    }
    const [low, high] = look.clip ?? [[-1e9, -1e9, -1e9], [1e9, 1e9, 1e9]];
    uniforms.uLow.value.set(low[0], low[1], Math.max(low[2], look.floorM ?? -1e9));
    uniforms.uHigh.value.set(high[0], high[1], Math.min(high[2], look.ceilingM ?? 1e9));
    uniforms.uMinP.value = look.minP;
    uniforms.uBand.value.set(...((look.band ?? [1, 0]).map((end) => (look.band ? end + KELVIN_ZERO_C : end)) as [number, number]));
    look.boxes ??= !this.stage.isSoftware;
    this.cells.setMaterial(look.boxes ? boxes : squares);
    this.bar.showField(look.field);
    this.panel.show();
    this.takeAway.show();
    this.refreshRange();
  }

  /** What is seen within half of the picture's width, as a box: five rays' ends. */
  private boxInView(): Box3 | null {
    const { clientWidth, clientHeight } = this.stage.canvas;
    const box = new Box3();
    for (let n = 0; n < 25; n++) {
      const x = clientWidth * (0.3 + 0.1 * (n % 5));
      const y = clientHeight * (0.3 + 0.1 * Math.floor(n / 5));
      const picked = this.picker.at(x, y);
      if (picked) box.expandByPoint(picked.point);
    }
    return box.isEmpty() ? null : box.expandByScalar(0.2);
  }

  private presets(): HTMLElement {
    const button = (label: string, title: string, run: () => void) => h("button", { type: "button", title, onclick: run }, label);
    return h(
      "section", { "aria-label": "Camera" }, h("h2", {}, "Camera"),
      h(
        "div", { class: "buttons" },
        button("All", "All of the map (H)", () => this.home()), button("Top", "From above (T)", () => this.top()),
        button("Walk", "Inside, at a person's height (W)", () => this.walk()),
        button("Hottest", "The hottest place shown (X)", () => this.jumpToHottest()),
      ),
    );
  }

  private mapFacts(): HTMLElement {
    const { geometry, sensor_model } = this.info;
    const edge = geometry.voxel_edge_um / 1e6;
    const lines = [
      `voxels of ${metres(edge)}, cells of ${metres(edge * 2 ** geometry.depth)}`,
      `shown: p above ${sensor_model.p_occupied}`,
      geometry.channels.map(({ name }) => name).join(", ") || "no channels",
    ];
    return h("section", { "aria-label": "Map" }, h("h2", {}, "Map"), ...lines.map((line) => h("p", { class: "hint" }, line)));
  }
}
