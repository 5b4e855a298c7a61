/** One map on the page: the picture, the panels around it, and what flows between them. */

import { Vector3 } from "three";
import type { Api } from "./api.ts";
import { Appearance } from "./appearance.ts";
import { h } from "./dom.ts";
import { Duties } from "./duties.ts";
import { FindingsDesk } from "./findings_desk.ts";
import { Heights } from "./heights.ts";
import { KeptAddress } from "./kept_address.ts";
import { LogBook } from "./log_book.ts";
import { NewsBook, type NewsItem } from "./news.ts";
import { fieldsOf, toHash, type CameraView, type Field, type Look } from "./look.ts";
import { MapFeed } from "./map_feed.ts";
import type { MapInfo, Triple } from "./messages.ts";
import { rgbOf, robotColour } from "./palettes.ts";
import { Cells } from "./scene/cells.ts";
import { Ground } from "./scene/ground.ts";
import { CellGrid, Outline } from "./scene/lines.ts";
import { Picker } from "./scene/picking.ts";
import { Spread } from "./scene/spread.ts";
import { Stage } from "./scene/stage.ts";
import { Walker } from "./scene/walker.ts";
import { Team } from "./team.ts";
import { TimeDesk } from "./time_desk.ts";
import { CameraPanel } from "./ui/camera_panel.ts";
import { Chips } from "./ui/chips.ts";
import type { CommitStrip } from "./ui/commit_strip.ts";
import { emptyMap } from "./ui/dead_ends.ts";
import { openAsking, openFull } from "./ui/duty_dialogs.ts";
import { DutyPanel } from "./ui/duty_panel.ts";
import { LookPanel } from "./ui/look_panel.ts";
import { mapFacts } from "./ui/map_facts.ts";
import { MeasurePanel } from "./ui/measure_panel.ts";
import { NewsPanel } from "./ui/news_panel.ts";
import { PlanPanel } from "./ui/plan_panel.ts";
import { ReferenceFrame } from "./ui/reference_frame.ts";
import { Shelf } from "./ui/shelf.ts";
import { showLink } from "./ui/link_dialog.ts";
import { TakeAwayPanel } from "./ui/take_away_panel.ts";
import type { TopBar } from "./ui/top_bar.ts";
import { VoxelPanel } from "./ui/voxel_panel.ts";
import { celsius, thousands } from "./units.ts";

const UNSEEN_COLOUR = 0xffb000;
const SOFTWARE_BUDGET = 150_000;
const WALKING = "Walking: W A S D go, drag or arrows look around, Escape ends";
const TICK_MS = 250;
/** A double click brings the eye so near, m, or to a third of the way. */
const NEAR_M = 1.5;

export class Console {
  readonly element: HTMLElement;
  readonly stage: Stage;
  readonly cells: Cells;
  readonly picker: Picker;
  readonly feed: MapFeed;
  readonly team: Team;
  readonly book: LogBook;
  readonly duties: Duties;
  readonly findings: FindingsDesk;
  readonly time: TimeDesk;
  readonly voxel: VoxelPanel;
  readonly measure: MeasurePanel;
  readonly camera: CameraPanel;
  readonly walker: Walker;
  readonly appearance: Appearance;
  readonly spread: Spread;
  readonly heights: Heights;
  readonly ground: Ground;
  private readonly api: Api;
  private readonly info: MapInfo;
  private readonly look: Look;
  private readonly bar: TopBar;
  private readonly panel: LookPanel;
  readonly shelf: Shelf;
  readonly plan: PlanPanel;
  private readonly dutyPanel = new DutyPanel();
  readonly news = new NewsBook();
  private readonly newsPanel = new NewsPanel();
  private readonly takeAway: TakeAwayPanel;
  private readonly grid = new CellGrid();
  /** Cells that changed since the robot that is followed fetched last. */
  private readonly unseen = new CellGrid(UNSEEN_COLOUR, 1);
  private readonly outline = new Outline();
  private readonly foot = h("span", { class: "figures" });
  private readonly chips = new Chips();
  private readonly labels = h("div", { class: "labels", "aria-hidden": "true" });
  private readonly empty: HTMLElement;
  private readonly frame: ReferenceFrame;
  private readonly flag = h("span", { class: "flag", role: "status" });
  private moved = true;
  private logged = false;
  private readonly kept = new KeptAddress(() => this.address);
  private readonly timer: number;

  constructor(api: Api, info: MapInfo, look: Look, camera: CameraView | null, bar: TopBar, onRefused: () => void) {
    this.api = api;
    this.info = info;
    this.look = look;
    this.bar = bar;
    this.check();
    const host = h("div", { class: "host" });
    this.book = new LogBook(api, info.name);
    this.duties = new Duties(api, info.name);
    this.voxel = new VoxelPanel(api, info, look, (seq) => this.book.robotAt(seq));
    this.takeAway = new TakeAwayPanel(api, info, look);
    this.panel = new LookPanel(look);
    this.cells = new Cells(api, info);
    this.measure = new MeasurePanel(this.cells, look, info.geometry.voxel_edge_um / 1e6);
    this.empty = emptyMap(info.name);
    this.empty.hidden = true;
    const view = h("main", { class: "view" }, host, this.empty, this.labels, this.measure.words, h("div", { class: "notes" }, this.flag, this.chips.element));
    const left = h("aside", { class: "left", "aria-label": "Team and map" });
    const right = h("aside", { class: "right", "aria-label": "Tools" }, this.panel.element, this.voxel.element, this.measure.element, this.takeAway.element);
    const footer = h("footer");
    this.element = h("div", { class: "console" }, left, view, right, footer);
    this.shelf = new Shelf(this.element, new Map([
      ["look", this.panel.element], ["voxel", this.voxel.element], ["measure", this.measure.element], ["export", this.takeAway.element],
    ]));
    view.append(this.shelf.tools);
    this.element.append(this.shelf.tabs);
    document.body.append(this.element);
    this.stage = new Stage(host);
    this.cells.budget = this.stage.isSoftware ? SOFTWARE_BUDGET : 2_000_000;
    this.time = new TimeDesk(api, info, look, { stage: this.stage, cells: this.cells }, this.book, {
      say: (text) => this.say(text), isOperator: () => this.duties.isOperator, plan: () => this.replan(), fly: (to) => this.camera.go(to),
    });
    footer.append(this.strip.element);
    this.strip.head.append(this.foot);
    view.append(this.time.comparison.panel.element);
    this.spread = new Spread(api, info.name);
    this.heights = new Heights(look, this.cells, this.spread);
    this.ground = new Ground(this.cells);
    this.ground.onChange = () => this.stage.draw();
    this.team = new Team(api, info.name, this.labels, this.stage, this.cells);
    view.append(h("div", { class: "through" }, this.team.picture.element, this.team.fromPose.element));
    this.picker = new Picker(this.stage, this.cells);
    this.stage.voxels.add(this.cells.group);
    this.stage.add(this.grid.lines, this.unseen.lines, this.outline.lines, this.measure.lines, this.team.group);
    this.frame = new ReferenceFrame(this.stage, this.picker);
    view.append(this.frame.element);
    this.walker = new Walker(this.stage, this.cells);
    this.camera = new CameraPanel(this.stage, this.cells, this.team, info, camera);
    this.findings = new FindingsDesk(api, info, { stage: this.stage, cells: this.cells, picker: this.picker }, look, {
      fly: (to) => this.camera.go(to), look: () => this.apply(), say: (text) => this.say(text), isOperator: () => this.duties.isOperator,
      witness: (commit) => this.book.placeOf(commit),
      link: (id) => showLink("This finding", new URL(toHash(info.name, look, null, id), document.baseURI).href),
      plans: (width, height) => this.plan.pictures(width, height), moment: () => ({ name: this.time.moment, words: this.time.words }),
    });
    this.stage.add(this.findings.pins.group);
    view.append(this.findings.pins.element, this.findings.alarm.banner);
    left.append(this.dutyPanel.element, this.findings.panel.element, this.newsPanel.element, this.camera.element, this.team.panel.element, mapFacts(info));
    this.appearance = new Appearance(info, look, this.stage, this.cells, this.book, this.spread);
    view.append(this.appearance.legend.element);
    this.plan = new PlanPanel({ stage: this.stage, cells: this.cells, ground: this.ground }, this.heights, {
      ink: () => this.appearance.planInk, findings: () => this.findings.all, robots: () => this.team.places,
      choose: (id) => this.findings.fly(id), go: (place) => this.camera.over(place),
    });
    view.append(this.plan.small, this.plan.element);
    this.connect(onRefused);
    this.feed = new MapFeed(api, info, { cells: this.cells, book: this.book, strip: this.strip, team: this.team, findings: this.findings, news: this.news }, {
      plan: () => this.replan(), refuse: onRefused,
      show: () => {
        this.moved = true;
        this.tick();
      },
    });
    this.timer = window.setInterval(() => this.tick(), TICK_MS);
    this.theme();
    this.apply();
    this.feed.begin();
    void this.prepare();
  }

  /** Compile the voxels' shaders on a voxel that nobody sees, while the first cells are on their way. */
  private async prepare(): Promise<void> {
    const sample = this.cells.sample();
    this.stage.voxels.add(sample);
    await this.stage.prepare();
    this.stage.voxels.remove(sample);
    sample.geometry.dispose();
  }

  get strip(): CommitStrip {
    return this.time.strip;
  }

  get name(): string {
    return this.info.name;
  }

  /** Show what another address of this map says: a link, or Back. */
  take(look: Look, camera: CameraView | null): void {
    Object.assign(this.look, look, { boxes: look.boxes ?? this.look.boxes });
    this.check();
    this.heights.forget();
    this.time.follow();
    this.team.follow(null);
    if (camera) {
      this.stage.place(camera);
      this.camera.isPlaced = true;
    }
    this.measure.follow();
    this.kept.followed();
    this.apply();
  }

  /** True if this address is the one that is kept. */
  isAt(address: string): boolean {
    return this.kept.isAt(address);
  }

  dispose(): void {
    window.clearInterval(this.timer);
    this.feed.close();
    this.cells.dispose();
    this.shelf.dispose();
    this.findings.dispose();
    this.time.dispose();
    this.picker.dispose();
    this.frame.dispose();
    this.appearance.dispose();
    this.stage.dispose();
    this.element.remove();
  }

  setField(field: Field): void {
    if (!fieldsOf(this.info.geometry).some((one) => one.field === field)) return;
    this.look.field = field;
    this.apply();
  }

  /** A field that this map does not have gives way to the one that it is opened with. */
  private check(): void {
    const fields = fieldsOf(this.info.geometry);
    if (!fields.some(({ field }) => field === this.look.field)) this.look.field = fields[0]!.field;
  }

  step(up: boolean): void {
    this.panel.step(up);
  }

  toggleCeiling(): void {
    this.heights.toggleCeiling();
  }

  toggleGrid(): void {
    this.look.cells = !this.look.cells;
    this.panel.show();
    this.apply();
  }

  /** The address that shows the same. */
  get address(): string {
    return new URL(toHash(this.info.name, this.look, this.stage.view, this.findings.chosen), document.baseURI).href;
  }

  say(text: string): void {
    this.flag.textContent = text;
  }

  /** Outline and name what lies under a place of the canvas. */
  ask(x: number, y: number): void {
    const picked = this.picker.at(x, y);
    if (this.findings.isMarking) {
      if (picked) this.findings.mark(picked.point);
      return;
    }
    if (this.measure.isOn) {
      if (picked) this.measure.add(picked.point);
      return;
    }
    this.outline.show(picked);
    this.stage.draw();
    this.takeAway.choose(picked?.cell.key ?? null);
    if (!picked) return this.askNothing();
    this.shelf.open("voxel");
    void this.voxel.show(picked, this, this.heights.floorM);
  }

  private askNothing(): void {
    this.voxel.clear();
    this.shelf.shut("voxel");
  }

  /** Fly to what lies under a place of the canvas, along the way one looks. */
  private goTo(x: number, y: number): void {
    const point = this.measure.isOn ? null : this.picker.at(x, y)?.point;
    if (!point) return;
    const { eye } = this.stage.view;
    const back = new Vector3(...eye).sub(point);
    const awayM = Math.min(Math.max(back.length() / 3, NEAR_M), back.length());
    this.team.follow(null);
    this.stage.fly({ eye: point.clone().addScaledVector(back.normalize(), awayM).toArray() as Triple, target: point.toArray() as Triple });
  }

  /** Fly to what a line of news is about: to its finding while there is one, else over its place. */
  private goToNews({ find, place }: NewsItem): void {
    if (find && this.findings.all.some(({ id }) => id === find)) this.findings.fly(find);
    else if (place) this.camera.over(place);
  }

  /** Turn: the head of who walks, or the picture around what is looked at. */
  turn(right: number, down: number): void {
    if (this.walker.isOn) this.walker.turn(right, down);
    else this.stage.turn(-right, down);
  }

  /** A step ahead or aside; who does not walk yet begins to. */
  walk(right: number, ahead: number): void {
    if (this.walker.isOn) this.walker.step(right, ahead);
    else if (ahead > 0) this.camera.walk();
  }

  forget(): void {
    this.walker.end();
    if (this.plan.isOpen) this.plan.switch();
    this.outline.show(null);
    this.team.follow(null);
    this.askNothing();
    this.findings.forget();
    this.say("");
    this.stage.draw();
  }

  theme(): void {
    this.outline.contrastWith(this.appearance.theme());
  }

  private connect(onRefused: () => void): void {
    const { canvas } = this.stage;
    let down: [number, number] | null = null;
    canvas.addEventListener("pointerdown", (event) => (down = event.button === 0 ? [event.clientX, event.clientY] : null));
    canvas.addEventListener("pointerup", (event) => {
      if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 4) this.ask(event.offsetX, event.offsetY);
      down = null;
    });
    canvas.addEventListener("dblclick", ({ offsetX, offsetY }) => this.goTo(offsetX, offsetY));
    canvas.addEventListener("webglcontextrestored", () => this.stage.draw());
    this.stage.onMove = () => (this.moved = true);
    // Back undoes a flight, but for the first one to where the map is.
    this.stage.onFly = () => {
      this.walker.end();
      if (!this.camera.isPlaced) return;
      this.kept.leave();
    };
    this.stage.onFrame = () => {
      this.team.place();
      this.findings.pins.place();
      this.measure.place(this.stage);
      this.frame.show();
      // Without a graphics card, frames would take the time of the cells that are still to come.
      return this.cells.isFresh && !(this.stage.isSoftware && this.cells.isFetching);
    };
    this.cells.onChange = (isWhole) => {
      if (isWhole) this.stage.draw();
      else this.stage.drawSoon();
      if (!this.cells.isFetching) this.replan();
      this.moved = true; // the ends of the palette follow what is shown
    };
    this.cells.onRefused = onRefused;
    this.cells.colourOf = (lm) => {
      const robot = this.book.robotAt(lm);
      return robot === null ? null : rgbOf(robotColour(robot, this.team.names));
    };
    this.cells.ageOf = (lm) => this.book.ageS(lm) ?? this.cells.head - lm;
    this.book.onChange = () => (this.logged = true);
    this.bar.onField = (field) => this.setField(field);
    this.bar.onTheme = () => this.theme();
    this.panel.onChange = () => this.apply();
    this.measure.onChange = () => this.stage.draw();
    this.shelf.onPlan = () => this.plan.switch();
    this.measure.onSwitch = (isOn) => (isOn ? this.shelf.open("measure") : this.shelf.shut("measure"));
    this.panel.boxInView = () => this.picker.boxInView();
    this.panel.onStorey = (storey) => this.heights.showStorey(storey);
    this.heights.onCut = () => this.apply();
    this.heights.onFloors = () => {
      this.panel.stories(this.heights.storeys.floorsM);
      this.appearance.zeroM = this.panel.zeroM;
      this.frame.floorM = this.heights.floorM;
      this.moved = true;
    };
    this.chips.onCeiling = () => this.toggleCeiling();
    this.spread.onChange = () => {
      this.moved = true;
      this.heights.forget();
    };
    this.appearance.legend.onRange = (range) => {
      if (range) this.look.ranges[this.look.field] = range;
      else delete this.look.ranges[this.look.field];
      this.apply();
    };
    this.newsPanel.onGo = (item) => this.goToNews(item);
    this.dutyPanel.onAsking = (asking) => openAsking(this.duties, asking);
    this.dutyPanel.onFull = (robot) => openFull(this.api, this.info.name, this.duties, robot);
    this.team.onFollow = () => this.stage.draw();
    this.camera.onSearch = () => this.findings.cutAgain();
    this.camera.onGo = () => {
      this.say("");
      this.findings.cutAgain();
    };
    this.camera.onWalk = () => {
      this.walker.begin();
      this.say(WALKING);
    };
    this.camera.onNoFloor = () => this.say("Nobody could stand there: no floor is known.");
    this.camera.onHottest = (place) => {
      if (!place) return this.say("Nothing that is shown has a temperature.");
      this.setField("temperature");
      this.say(`Hottest: ${celsius(place.kelvin)} at ${place.centre.toArray().map((value) => value.toFixed(2)).join(", ")} m`);
    };
  }

  /** A few times a second: what has no event of its own. */
  private tick(): void {
    if (this.logged) {
      this.logged = false;
      this.moved = true;
      this.team.wereAt(this.book);
      void this.feed.askHeld();
    }
    if (this.moved || this.cells.needsPlan || this.cells.waiting) {
      this.moved = false;
      this.replan();
      this.appearance.refreshRange(this.team.names);
    }
    if (this.feed.cursor) this.spread.tick(this.cells.head);
    // Of a past moment heights are told as of now: the picture stays comparable.
    if (!this.cells.isLevel && (this.look.atS === null || !this.heights.storeys.floorsM.length)) this.heights.tick();
    this.ground.tick();
    this.camera.settle();
    this.kept.tick(this.camera.isPlaced && !this.stage.isFlying);
    const bounds = this.cells.tightBounds;
    if (!bounds.isEmpty()) this.panel.span(bounds.min.z, bounds.max.z);
    this.grid.lines.visible = this.look.cells;
    this.grid.update([...this.cells.all.values()].filter(({ points }) => points).map(({ box }) => box));
    this.bar.showLink(this.feed.state, this.cells.waiting, this.cells.error);
    this.feed.tick();
    this.duties.tick();
    this.findings.tick();
    this.measure.tick();
    this.news.look(this.findings.all, this.findings.spots);
    this.newsPanel.show(this.news.items);
    this.dutyPanel.show(this.duties);
    this.plan.tick();
    this.shelf.count("findings", this.findings.fresh ? `· ${this.findings.fresh} new` : "");
    this.team.tick(this.look.field, this.cells.head, this.duties.full);
    this.strip.show(this.team.names);
    this.time.tick();
    const { lastSeq } = this.team;
    const missed = lastSeq === null ? [] : [...this.cells.all.values()].filter(({ points, lm }) => points && lm > lastSeq);
    this.unseen.update(missed.map(({ box }) => box));
    this.empty.hidden = this.feed.cursor === "" || this.cells.all.size > 0;
    this.labels.hidden = this.cells.firstPictureMs === null && this.cells.all.size > 0;
    this.chips.show(this.look, this.cells, this.heights.storeys, this.panel.zeroM, this.time.words);
    const drawn = `${thousands(this.cells.drawn)} nodes of ${this.cells.all.size} cells`;
    this.foot.textContent = this.stage.isSoftware ? `${drawn} · drawn without a graphics card: coarser and slower` : drawn;
  }

  private replan(): void {
    this.cells.update(this.stage.camera, this.stage.heightPx, this.stage.frustum);
  }

  /** Uniforms as the look says; nothing else is touched, so nothing is fetched. */
  private apply(): void {
    this.appearance.apply(this.team.names);
    this.bar.showField(this.look.field);
    this.panel.show();
    this.takeAway.show();
  }
}
