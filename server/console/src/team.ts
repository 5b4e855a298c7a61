/** Robots: in the picture, in their panel, and the one that the camera follows. */

import { Group, Vector3 } from "three";
import type { Api } from "./api.ts";
import { h } from "./dom.ts";
import type { FullShare } from "./duties.ts";
import type { LogBook } from "./log_book.ts";
import type { Field } from "./look.ts";
import type { Branch, RobotSign, Triple } from "./messages.ts";
import { robotColour } from "./palettes.ts";
import type { Cells } from "./scene/cells.ts";
import { freeM } from "./scene/line_of_sight.ts";
import { RobotMark, TRAIL_MAX } from "./scene/lines.ts";
import type { Stage } from "./scene/stage.ts";
import { LeaderLines, type SeenLabel } from "./ui/leader_lines.ts";
import { RobotMap } from "./ui/robot_map.ts";
import { RobotPicture } from "./ui/robot_picture.ts";
import { isOffline, TeamPanel } from "./ui/team_panel.ts";

/** Live events tell when robots push, fetch and report; what they left out is asked for now and then. */
const REFRESH_MS = 60_000;
const SOON_MS = 1000;
const OFFLINE_COLOUR = "#8b949e";
/** Place of the eye that follows a robot, m: so far behind it and over it, or nearer, this far before what is in the way. */
const BEHIND_M = 3;
const OVER_M = 2.2;
const NEAREST_M = 0.3;
const BEFORE_M = 0.1;

export class Team {
  readonly panel = new TeamPanel();
  readonly group = new Group();
  readonly picture: RobotPicture;
  readonly fromPose: RobotMap;
  onFollow: () => void = () => {};
  private branches: Branch[] = [];
  private full: readonly FullShare[] = [];
  private readonly signs = new Map<string, RobotSign>();
  private readonly marks = new Map<string, RobotMark>();
  private readonly labels = new Map<string, HTMLElement>();
  private readonly host: HTMLElement;
  private readonly leaders: LeaderLines;
  private readonly api: Api;
  private readonly map: string;
  private readonly stage: Stage;
  private readonly cells: Cells;
  private followed: string | null = null;
  private askAtMs = 0;
  private wasOffline = new Map<string, boolean>();

  constructor(api: Api, map: string, host: HTMLElement, stage: Stage, cells: Cells) {
    this.api = api;
    this.map = map;
    this.host = host;
    this.leaders = new LeaderLines(host);
    this.stage = stage;
    this.cells = cells;
    this.picture = new RobotPicture(api, map);
    this.fromPose = new RobotMap(api, map, cells.isLevel);
    this.panel.onFollow = (robot) => this.follow(this.followed === robot ? null : robot);
  }

  get names(): string[] {
    return [...new Set([...this.branches.map(({ branch }) => branch), ...this.signs.keys()])].sort();
  }

  /** Newest log entry that the robot that is followed has fetched; 0: none ever; null: nobody is followed, or it keeps no map. */
  get lastSeq(): number | null {
    if (this.followed === null) return null;
    const branch = this.branches.find((one) => one.branch === this.followed);
    if (branch?.mode !== "high-end") return null;
    const { cursor } = branch;
    return cursor ? Number(cursor.split(".")[1]) : 0;
  }

  greet(robots: readonly RobotSign[]): void {
    for (const robot of robots) this.hear(robot);
    this.refresh();
  }

  hear(sign: RobotSign): void {
    if (sign.gone) this.signs.delete(sign.branch);
    else this.signs.set(sign.branch, sign);
    this.mark(sign);
    this.refresh();
    this.show();
    this.stage.draw();
  }

  /** Ask for lags soon; many askings make one. */
  refresh(): void {
    this.askAtMs = Math.min(this.askAtMs, performance.now() + SOON_MS);
  }

  /** Trails of all who measured, whether they are of the team still or not. */
  wereAt(book: LogBook): void {
    const places = book.places(TRAIL_MAX);
    for (const name of places.keys()) this.markOf(name);
    for (const [name, mark] of this.marks) mark.wasAt(places.get(name) ?? []);
    this.stage.draw();
  }

  follow(robot: string | null): void {
    this.followed = robot;
    const mark = robot === null ? null : this.marks.get(robot);
    if (mark?.position) {
      const eye = this.behind(mark.position, mark.ahead.setZ(0));
      this.stage.fly({ eye: eye.toArray() as Triple, target: mark.position.toArray() as Triple });
    }
    this.show();
    this.onFollow();
  }

  /** Place from which the eye sees a robot from behind, with nothing that is shown between them. */
  private behind(robot: Vector3, ahead: Vector3): Vector3 {
    const back = (ahead.lengthSq() > 0.01 ? ahead.normalize() : new Vector3(0, 1, 0)).multiplyScalar(-BEHIND_M).setZ(OVER_M);
    const wantedM = back.length();
    const freeToM = freeM(this.cells, robot, robot.clone().add(back));
    const awayM = freeToM < wantedM ? Math.max(freeToM - BEFORE_M, NEAREST_M) : wantedM;
    return robot.clone().addScaledVector(back, awayM / wantedM);
  }

  /** Places of robots that reported one. */
  get places(): { name: string; place: Triple; colour: string }[] {
    return [...this.marks].flatMap(([name, { position }]) => (position ? [{ name, place: position.toArray() as Triple, colour: robotColour(name, this.names) }] : []));
  }

  /** Place of the robot nearest to a place; null: no robot reported one. */
  nearest(place: Vector3): Vector3 | null {
    const places = [...this.marks.values()].flatMap(({ position }) => (position ? [position] : []));
    places.sort((a, b) => a.distanceTo(place) - b.distanceTo(place));
    return places[0]?.clone() ?? null;
  }

  /** A few times a second: what the map is coloured by, the newest log entry that is drawn, and shares that are half used. */
  tick(field: Field, head: number, full: readonly FullShare[]): void {
    this.full = full;
    const followed = this.followed === null ? undefined : this.signs.get(this.followed);
    this.picture.show(this.followed, followed?.view_s ?? null);
    this.fromPose.show(this.followed, followed?.status?.pose ?? null, field, head);
    if (performance.now() >= this.askAtMs && !document.hidden) {
      this.askAtMs = performance.now() + REFRESH_MS;
      void this.ask();
    }
    for (const [name, sign] of this.signs) {
      const offline = isOffline(sign.time_s);
      if (this.wasOffline.get(name) !== offline) {
        this.wasOffline.set(name, offline);
        this.mark(sign);
        this.stage.draw();
      }
    }
    this.show();
  }

  /** Labels next to the robots, where these are in the picture now; by name, so that a stack keeps its order. */
  place(): void {
    const { clientWidth, clientHeight } = this.stage.canvas;
    const seen: SeenLabel[] = [];
    for (const [name, mark] of [...this.marks].sort(([a], [b]) => (a < b ? -1 : 1))) {
      const label = this.labels.get(name)!;
      const at = mark.position?.clone().project(this.stage.camera);
      label.hidden = !at || at.z > 1 || Math.abs(at.x) > 1 || Math.abs(at.y) > 1;
      if (at && !label.hidden) seen.push({ name, label, x: ((at.x + 1) / 2) * clientWidth, y: ((1 - at.y) / 2) * clientHeight });
    }
    this.leaders.place(seen, clientWidth, clientHeight);
  }

  private show(): void {
    this.panel.show(this.branches, this.signs, this.names, this.followed, this.full);
  }

  private async ask(): Promise<void> {
    try {
      this.branches = await this.api.json<Branch[]>(`maps/${this.map}/branches`);
    } catch {
      return; // the bar says that there is no link
    }
    this.show();
    for (const sign of this.signs.values()) this.mark(sign);
    this.stage.draw();
  }

  private markOf(name: string): RobotMark {
    let mark = this.marks.get(name);
    if (!mark) {
      mark = new RobotMark(robotColour(name, this.names));
      this.marks.set(name, mark);
      this.group.add(mark.group);
      const dot = h("span", { class: "dot" });
      const label = h("span", { class: "label" }, dot, name);
      this.labels.set(name, label);
      this.host.append(label);
    }
    return mark;
  }

  private mark(sign: RobotSign): void {
    const offline = isOffline(sign.time_s);
    const mark = this.markOf(sign.branch);
    const before = mark.position?.clone();
    const colour = robotColour(sign.branch, this.names);
    mark.setColours(offline ? OFFLINE_COLOUR : colour, colour);
    mark.update(sign);
    const label = this.labels.get(sign.branch)!;
    label.classList.toggle("offline", offline);
    (label.firstElementChild as HTMLElement).style.background = colour;
    if (this.followed === sign.branch && before && mark.position) {
      const step = mark.position.clone().sub(before);
      const { eye, target } = this.stage.view;
      const moved = (point: Triple) => new Vector3(...point).add(step).toArray() as Triple;
      if (step.length() > 0.01) this.stage.place({ eye: moved(eye), target: moved(target) });
    }
  }
}
