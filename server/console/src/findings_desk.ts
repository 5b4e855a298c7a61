/** Findings on the page: the list, the pins and the alarm over one state, flights to where a thing is seen, and marks. */

import { Vector3 } from "three";
import type { Api } from "./api.ts";
import { DISMISSED, findingsOf, markOfSpot, SEEN, wordOf, wordsAround, type Finding } from "./findings.ts";
import { Attachments } from "./attachments.ts";
import { csvOf, geoJsonOf } from "./findings_files.ts";
import { HotSpotList } from "./hot_spot_list.ts";
import type { CameraView, Look } from "./look.ts";
import { mapOf } from "./map_layers.ts";
import { MarkBook } from "./mark_book.ts";
import type { LiveEvent, MapInfo, MarkText, Triple } from "./messages.ts";
import { h } from "./dom.ts";
import type { Cells } from "./scene/cells.ts";
import type { Picker } from "./scene/picking.ts";
import { Pins } from "./scene/pins.ts";
import type { Stage } from "./scene/stage.ts";
import { isShown, visibleFrom } from "./scene/viewpoint.ts";
import { Alarm } from "./ui/alarm.ts";
import { FindingsPanel, type Act } from "./ui/findings_panel.ts";
import { openMark } from "./ui/mark_dialog.ts";
import { openReport, type ReportSource } from "./ui/report.ts";

/** A link's finding that does not come for so long is not there, ms. */
const SEEK_MS = 15_000;
const THRESHOLD_KEY = "cairn.hot";
const WARM_C = 30;
/** Flights to one thing: a nearer eye gets finer voxels, and what these show may stand in the way. */
const FLIGHTS_MAX = 4;
/** Distance from a thing within which the node in the middle of the picture counts as it, voxels. */
const NEAR_VOXELS = 2.5;

/** Effects of the desk on the rest of the page. */
export interface DeskActs {
  fly(view: CameraView): void;
  /** The look was changed. */
  look(): void;
  say(text: string): void;
  isOperator(): boolean;
  /** From where a commit was measured. */
  witness(commit: string): Triple | null;
  /** Show a link to a finding. */
  link(id: string): void;
  plans: ReportSource["plans"];
  /** The past moment that is shown, for each plan, and all that is to be said of it; empty: now. */
  moment(): { name: string; words: string };
}

export class FindingsDesk {
  readonly panel: FindingsPanel;
  readonly pins: Pins;
  readonly alarm = new Alarm();
  readonly marks: MarkBook;
  readonly spots: HotSpotList;
  all: readonly Finding[] = [];
  isMarking = false;
  chosen: string | null = null;
  /** Heights that were cut off before a finding beyond them was flown to; null: none were. */
  private cut: Pick<Look, "floorM" | "ceilingM" | "clip" | "isCeilingChosen"> | null = null;
  /** A flight whose end is still to be looked at. */
  private flight: { place: Vector3; witness: Vector3 | null; left: number } | null = null;
  /** Finding that a link names, until it is there. */
  private sought: { id: string; endMs: number } | null = null;
  private readonly attachments: Attachments;
  private said = "";
  private changed = true;
  private readonly info: MapInfo;
  private readonly stage: Stage;
  private readonly cells: Cells;
  private readonly picker: Picker;
  private readonly look: Look;
  private readonly acts: DeskActs;

  constructor(api: Api, info: MapInfo, scene: { stage: Stage; cells: Cells; picker: Picker }, look: Look, acts: DeskActs) {
    this.info = info;
    this.stage = scene.stage;
    this.cells = scene.cells;
    this.picker = scene.picker;
    this.look = look;
    this.acts = acts;
    const overC = Number(localStorage.getItem(THRESHOLD_KEY) ?? WARM_C);
    const map = mapOf(info.name); // marks and their files are the map's, also where one of its layers is shown
    this.attachments = new Attachments(api, map);
    this.panel = new FindingsPanel(overC, this.alarm.element, this.attachments);
    this.pins = new Pins(this.stage);
    this.marks = new MarkBook(api, map);
    this.spots = new HotSpotList(api, info, overC);
    this.marks.onChange = this.spots.onChange = () => this.update();
    this.panel.onFly = this.pins.onChoose = this.alarm.onFly = (id) => this.fly(id);
    this.panel.onAct = (act, id) => void this.act(act, id);
    this.panel.onMarking = () => (this.isMarking ? this.stopMarking() : this.startMarking());
    this.panel.onFile = (form) => this.save(form);
    this.panel.onReport = () =>
      void openReport({ api, info, attachments: this.attachments, findings: this.all, plans: (width, height) => this.acts.plans(width, height), moment: () => this.acts.moment() });
    this.panel.onThreshold = (value) => {
      localStorage.setItem(THRESHOLD_KEY, String(value));
      this.spots.setThreshold(value);
    };
    this.marks.refresh();
  }

  hear(event: LiveEvent): void {
    if (event.type === "marks") this.marks.hear(event.marks, event.removed);
    else if (event.type === "cells") this.spots.refresh();
    else if (event.type === "hello" && !event.resumed) {
      this.marks.refresh();
      this.spots.refresh();
    }
  }

  /** A few times a second. */
  tick(): void {
    this.spots.tick();
    if (this.changed) {
      this.changed = false;
      this.all = findingsOf(this.spots.spots, this.marks.all);
      this.pins.show(this.all.filter(({ state }) => state !== "dismissed"), this.chosen);
      this.alarm.show(this.all);
    }
    this.panel.show({ findings: this.all, chosen: this.chosen, isOperator: this.acts.isOperator(), isMarking: this.isMarking, said: this.words() });
    this.land();
    this.find();
  }

  /** Choose a finding where one is: a reload, or Back; null: none. */
  choose(id: string | null): void {
    this.chosen = id;
    this.update();
  }

  /** Fly to the finding that a link names, as soon as it is known. */
  seek(id: string): void {
    this.sought = { id, endMs: performance.now() + SEEK_MS };
  }

  private find(): void {
    const { sought } = this;
    if (!sought || this.cells.firstPictureMs === null) return;
    const isThere = this.all.some(({ id }) => id === sought.id);
    if (!isThere && performance.now() < sought.endMs) return;
    this.sought = null;
    if (isThere) this.fly(sought.id);
    else this.acts.say("The finding that this link names is not in the map, or not any more.");
  }

  /** Findings that no person spoke of yet. */
  get fresh(): number {
    return this.all.filter(({ state }) => state === "new").length;
  }

  /** Fly to the finding of a number; false: there is none. */
  flyTo(number: number): void {
    const found = this.all.find((one) => one.number === number);
    if (found) this.fly(found.id);
  }

  /** The next click on the map names a place. */
  startMarking(): void {
    if (!this.acts.isOperator()) return this.acts.say("Marks take an operator's token.");
    this.isMarking = true;
    this.acts.say("Mark: click the place. Escape stops.");
  }

  stopMarking(): void {
    if (!this.isMarking) return;
    this.isMarking = false;
    this.acts.say("");
  }

  /** Name a place that was clicked. */
  mark(point: Vector3): void {
    this.stopMarking();
    this.ask("Mark this place", { kind: "mark", name: "", place_m: point.toArray() as Triple });
  }

  forget(): void {
    this.stopMarking();
    this.cutAgain();
    this.flight = null;
    this.choose(null);
  }

  dispose(): void {
    this.marks.close();
    this.alarm.close();
    this.pins.dispose();
  }

  private update(): void {
    this.changed = true;
  }

  private words(): string {
    const more = this.spots.total - this.spots.spots.length;
    return [this.said, this.spots.said, more > 0 ? `${more} cooler hot spots are not listed.` : "", this.marks.isCut ? "There are more marks than the page keeps." : ""]
      .filter(Boolean).join(" ");
  }

  /** Fly to where a finding is seen, and choose it. */
  fly(id: string): void {
    const found = this.all.find((one) => one.id === id);
    if (!found) return;
    this.cutAgain();
    const place = new Vector3(...found.place);
    const where = `Finding ${found.number}: ${found.celsius === null ? found.title : `${found.celsius.toFixed(1)} °C`} at ${place.toArray().map((value) => value.toFixed(2)).join(", ")} m`;
    const hidden = !isShown(place);
    const { floorM, ceilingM, clip, isCeilingChosen } = this.look;
    if (hidden) {
      // What was cut off for a better view hides what is looked for.
      this.look.floorM = this.look.ceilingM = this.look.clip = null;
      this.look.isCeilingChosen = true; // else roofs are cut off again by themselves
      this.acts.look();
    }
    const from = found.spot?.commit ? this.acts.witness(found.spot.commit) : null;
    this.flight = { place, witness: from && new Vector3(...from), left: FLIGHTS_MAX };
    this.acts.fly(this.view(this.flight));
    this.cut = hidden ? { floorM, ceilingM, clip, isCeilingChosen } : null;
    this.choose(id); // after the flight began: Back leads to where it was not chosen
    this.acts.say(hidden ? `${where}. It was cut off: all heights are shown now.` : where);
  }

  /** Cut off again what a flight to a finding had shown, unless heights were cut elsewhere meanwhile. */
  cutAgain(): void {
    const { cut, look } = this;
    this.cut = null;
    if (!cut || look.floorM !== null || look.ceilingM !== null || look.clip) return;
    Object.assign(look, cut);
    this.acts.look();
  }

  private view(flight: { place: Vector3; witness: Vector3 | null; left: number }): CameraView {
    flight.left--;
    return visibleFrom(this.cells, flight.place, this.stage.camera.position, flight.witness);
  }

  /** Where a flight has ended and finer voxels have come, look whether they hide what it was for, and go elsewhere then. */
  private land(): void {
    const { flight } = this;
    if (!flight || this.stage.isFlying || this.cells.waiting || this.cells.needsPlan) return;
    if (!flight.left || this.stage.view.target.some((value, n) => Math.abs(value - flight.place.getComponent(n)) > 0.01)) {
      this.flight = null; // the eye was turned meanwhile
      return;
    }
    const { clientWidth, clientHeight } = this.stage.canvas;
    const met = this.picker.at(clientWidth / 2, clientHeight / 2);
    const nearM = (NEAR_VOXELS * this.info.geometry.voxel_edge_um) / 1e6;
    if (!met || met.point.distanceTo(flight.place) <= Math.max(nearM, met.edgeM)) this.flight = null;
    else this.stage.flyOn(this.view(flight));
  }

  private async act(act: Act, id: string): Promise<void> {
    const found = this.all.find((one) => one.id === id);
    if (!found) return;
    const { spot, entry } = found;
    try {
      if (act === "link") this.acts.link(id);
      else if (act === "mark" && spot) this.ask("Mark this hot spot", markOfSpot(spot), entry?.key ?? null);
      else if (act === "edit" && entry) {
        const { kind, name, place_mm, extent_mm, note, attachment } = entry.mark;
        const metres = (each: Triple) => each.map((value) => value / 1000) as Triple;
        const text = { kind, name, note: note ?? "", place_m: metres(place_mm), extent_m: metres(extent_mm ?? [0, 0, 0]) };
        this.ask("Edit this mark", attachment ? { ...text, attachment } : text, entry.key);
      } else if (act === "remove" && entry) await this.marks.remove(entry.key);
      else if (act === "again" && spot) for (const { key } of wordsAround(spot, this.marks.all)) await this.marks.remove(key);
      else if ((act === "seen" || act === "dismiss") && spot) await this.marks.put(wordOf(spot, act === "seen" ? SEEN : DISMISSED), entry?.key ?? null);
      this.said = "";
    } catch (error) {
      this.said = (error as Error).message;
    }
    this.update();
  }

  private ask(title: string, first: MarkText, of: string | null = null): void {
    openMark(title, first, (mark) => this.marks.put(mark, of));
  }

  private save(form: "csv" | "geojson"): void {
    const { name } = this.info;
    const [text, type] = form === "csv" ? [csvOf(this.all), "text/csv"] : [geoJsonOf(this.all, name), "application/geo+json"];
    const url = URL.createObjectURL(new Blob([text], { type }));
    h("a", { href: url, download: `${name}_findings.${form}` }).click();
    window.setTimeout(() => URL.revokeObjectURL(url), 60_000);
  }
}
