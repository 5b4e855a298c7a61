/** Facts about the voxel that was clicked: first those of the picture, then the server's own numbers. */

import type { Api } from "../api.ts";
import { classColours, classOf } from "../class_colours.ts";
import { facts, fill, h } from "../dom.ts";
import { robotOf } from "../log_book.ts";
import type { Look } from "../look.ts";
import { classesOf } from "../map_layers.ts";
import type { Channel, MapInfo, Triple } from "../messages.ts";
import type { Cells } from "../scene/cells.ts";
import type { Ground } from "../scene/ground.ts";
import { readingOf, type Picked } from "../scene/picking.ts";
import { serverNowS } from "../server_time.ts";
import { ago, celsius, clock, counted, metres } from "../units.ts";

export interface ChannelReading {
  name: string;
  kind: Channel["kind"];
  unit: string;
  weight: number;
  mean: number[];
  sigma: number | null;
  /** Of a channel of classes: the one with the most votes, and whether it leads by less than two. */
  class_name?: string;
  unsure?: boolean;
  /** Time of the newest samples, in seconds; left out: unknown. */
  measured_s?: number;
}

/** Answer to GET .../main/voxels/{voxel}. */
export interface VoxelAnswer {
  voxel: Triple;
  cell: Triple;
  centre_m: Triple;
  hits: number;
  misses: number;
  probability: number | null;
  channels: ChannelReading[];
  lm: number;
  cursor: string;
  commits: { id: string; hits: number; misses: number; captured_s: [number, number] | null }[];
  more: boolean;
  gone: boolean;
}

export class VoxelPanel {
  readonly element = h("section", { "aria-label": "Voxel", "aria-live": "polite" });
  private readonly api: Api;
  private readonly info: MapInfo;
  private readonly look: Look;
  /** Whose commit a log entry folded; null: not known here. */
  private readonly robotAt: (seq: number) => string | null;
  private asked = 0;

  constructor(api: Api, info: MapInfo, look: Look, robotAt: (seq: number) => string | null) {
    this.api = api;
    this.info = info;
    this.look = look;
    this.robotAt = robotAt;
    this.clear();
  }

  clear(): void {
    this.asked++;
    fill(this.element, h("h2", {}, "Voxel"), h("p", { class: "hint" }, "Click the map to ask what is there."));
  }

  /** `floorM`: what heights are told over, m in the map. */
  async show(picked: Picked, { cells, ground }: { cells: Cells; ground: Ground }, floorM: number | null): Promise<void> {
    const mine = ++this.asked;
    const classes = classesOf(this.info.geometry.channels);
    const coarse = cells.isLevel ? ofGround(picked, ground) : ofNode(picked, floorM, classes);
    if (!picked.isVoxel) {
      const what = cells.isLevel ? "The mean" : classes.length ? "The most votes" : "The hottest";
      fill(this.element, h("h2", {}, "Voxel"), coarse, h("p", { class: "hint" }, `${what} in a block ${metres(picked.edgeM)} wide: come closer to ask of one voxel, and who saw it.`));
      return;
    }
    const side = 2 ** cells.depthMax;
    const voxel = picked.node.map((place, axis) => place + picked.cell.cell[axis] * side) as Triple;
    fill(this.element, h("h2", {}, "Voxel"), coarse, h("p", { class: "hint" }, "Asking the server …"));
    try {
      const { atS } = this.look;
      const answer = await this.api.json<VoxelAnswer>(`maps/${this.info.name}/main/voxels/${voxel.join(",")}${atS === null ? "" : `?time=${atS}`}`);
      if (mine === this.asked) fill(this.element, h("h2", {}, "Voxel"), cells.isLevel ? coarse : reading(answer, floorM, classes), exact(answer), whence(answer, this.robotAt(answer.lm)));
    } catch (error) {
      if (mine === this.asked) fill(this.element, h("h2", {}, "Voxel"), coarse, h("p", { class: "error" }, (error as Error).message));
    }
  }
}

/** The reading first, as one tells it to another. */
function headline(said: string, rgb: number[] | null, z: number, floorM: number | null): HTMLElement {
  return h("p", { class: "reading" }, h("strong", {}, said), rgb && swatch(rgb), floorM !== null && `${metres(z - floorM, 1)} over the floor`);
}

const heatText = (kelvin: number | null) => (kelvin === null ? "No temperature" : celsius(kelvin));
const classText = (name: string, isUnsure: boolean) => `${name}${isUnsure ? " (unsure)" : ""}`;

/** A level's surface: its height, and what hinders a vehicle there. */
function ofGround(picked: Picked, ground: Ground): HTMLElement {
  const { heightM, difficulty, slopeDeg, stepM } = ground.reading(picked.cell, picked.row);
  const known = (value: number | null, text: (value: number) => string) => (value === null ? "not known" : text(value));
  const numbers = facts([
    ["difficulty", known(difficulty, (value) => `${value.toFixed(2)}${value > 1 ? ": a usual vehicle does not pass" : ""}`)],
    ["slope", known(slopeDeg, (value) => `${value.toFixed(1)}°`)],
    ["largest step", known(stepM, (value) => metres(value))],
    ["middle", picked.centre.toArray().slice(0, 2).map((value) => value.toFixed(2)).join(", ") + " m"],
    ["cell", picked.cell.key],
  ]);
  return h("div", {}, headline(heightM === null ? "An obstacle" : `Ground at ${metres(heightM)}`, null, 0, null), numbers);
}

function swatch(rgb: number[]): HTMLElement {
  const found = h("span", { class: "swatch", "aria-hidden": "true" });
  found.style.background = `rgb(${rgb.map(Math.round).join(" ")})`;
  return found;
}

/** The reading of what was clicked, whatever its size, and the numbers behind it. */
function ofNode({ cell, row, centre, edgeM, node, depth }: Picked, floorM: number | null, classes: readonly string[]): HTMLElement {
  const { probability, rgb, meanK, hottestK } = readingOf(cell, row);
  const named = rgb && classes.length ? classOf(rgb, classes.length) : null;
  const said = classes.length ? (named ? classText(classes[named.number]!, named.isUnsure) : "No class") : heatText(hottestK);
  const numbers = facts([
    ["colour", rgb ? h("span", {}, swatch(rgb), ` ${rgb.join(", ")}`) : "none measured"],
    ["temperature", meanK === null ? "none measured" : `${celsius(meanK)} mean, ${celsius(hottestK!)} hottest`],
    ["probability", `${probability.toFixed(2)} (its highest voxel)`],
    ["centre", centre.toArray().map((value) => value.toFixed(2)).join(", ") + " m"],
    ["cell", cell.key],
    ["node", `${node.join(",")} at depth ${depth}, ${metres(edgeM)} wide`],
  ]);
  return h("div", {}, headline(said, rgb, centre.z, floorM), numbers);
}

function reading({ channels, centre_m }: VoxelAnswer, floorM: number | null, classes: readonly string[]): HTMLElement {
  const of = (kind: Channel["kind"]) => channels.find((channel) => channel.kind === kind && channel.weight > 0);
  const named = of("classes");
  if (!classes.length) return headline(heatText(of("temperature")?.mean[0] ?? null), of("colour")?.mean ?? null, centre_m[2], floorM);
  const said = named?.class_name === undefined ? "No class" : classText(named.class_name, named.unsure === true);
  return headline(said, named ? [...classColours(classes.length)[classes.indexOf(named.class_name!)]!] : null, centre_m[2], floorM);
}

function exact(answer: VoxelAnswer): HTMLElement {
  const seen = answer.hits + answer.misses;
  return facts([
    ["voxel", answer.voxel.join(",")],
    ["cell", answer.cell.join(",")],
    ["centre", answer.centre_m.map((value) => value.toFixed(3)).join(", ") + " m"],
    ["probability", answer.probability === null ? "unknown" : answer.probability.toFixed(4)],
    ["seen", `${answer.hits} of ${seen} scans hit it`],
    ...answer.channels.map(({ name, kind, unit, mean, sigma, weight, measured_s, class_name, unsure }): [string, Node | string] => {
      if (!weight) return [name, "none measured"];
      const when = measured_s === undefined ? "" : `, ${clock(measured_s)}, ${ago(serverNowS() - measured_s)}`;
      const whence = `(${counted(weight, "sample", "samples")}${when})`;
      if (kind === "colour") return [name, h("span", {}, swatch(mean), ` ${mean.map((value) => value.toFixed(1)).join(", ")} ${whence}`)];
      if (class_name !== undefined) return [name, `${classText(class_name, unsure === true)} ${whence.replace("sample", "vote")}`];
      const spread = sigma === null ? "" : ` ± ${sigma.toFixed(2)} ${unit === "K" ? "°C" : unit}`;
      const value = unit === "K" ? celsius(mean[0], 2) : `${mean[0].toFixed(2)} ${unit}`;
      return [name, `${value}${spread} ${whence}`];
    }),
  ]);
}

function whence(answer: VoxelAnswer, last: string | null): HTMLElement {
  const rows = answer.commits.map(({ id, hits, misses, captured_s }) => {
    const when = captured_s ? `${clock(captured_s[1])} (${ago(serverNowS() - captured_s[1])})` : "at an unknown time";
    return h("li", {}, h("strong", {}, robotOf(id)), ` ${counted(hits, "hit", "hits")}, ${counted(misses, "miss", "misses")}; ${when}`, h("code", {}, id));
  });
  const left = [
    `Log entry ${answer.lm}${last ? ` of ${last}` : ""} changed this cell last.`,
    answer.gone ? "Commits before are not kept any more: of them only the sum is known." : "",
    answer.more ? "Only the newest 32 commits of this cell were looked at." : "",
  ].filter(Boolean);
  return h(
    "div", { class: "whence" }, h("h3", {}, "Who saw it"), h("ul", {}, ...rows), ...left.map((line) => h("p", { class: "hint" }, line)),
  );
}
