/** Pictures of the map that the server draws, for browsers that cannot: no WebGL, or none that is let in. */

import type { Api } from "../api.ts";
import { fill, h, pictureOf } from "../dom.ts";
import type { Branch, MapInfo, Pose } from "../messages.ts";

const LAYERS = { colour: "Colour", temperature: "Temperature", probability: "Certainty", depth: "Distance", age: "Age" };
/** The same for a level layer, which has surfaces in the place of colours. */
const OF_LEVEL = { height: "Height", slope: "Slope", step: "Step", difficulty: "Difficulty", probability: "Certainty", depth: "Distance", age: "Age" };
const SIZE = { width: 640, height: 480, focal_px: 500 };
/** Farthest that the server looks, m. */
const RANGE_M = 50;

interface Viewpoint {
  readonly name: string;
  readonly pose: Pick<Pose, "t_map_rig" | "q_map_rig">;
}

export class StillPictures {
  readonly element = h("main", { class: "stills" });
  private readonly api: Api;
  private readonly info: MapInfo;
  private readonly picture = h("figure", {});
  private readonly choice = h("div", { class: "buttons" });
  private viewpoints: readonly Viewpoint[] = [];
  private from = 0;
  private readonly layers: Readonly<Record<string, string>>;
  private layer: string;
  private asked = 0;

  constructor(api: Api, info: MapInfo) {
    this.api = api;
    this.info = info;
    this.layers = info.geometry.height_step_um === undefined ? LAYERS : OF_LEVEL;
    this.layer = Object.keys(this.layers)[0]!;
    fill(
      this.element, h("h1", {}, "This browser cannot draw the map"),
      h("p", {}, "It has no WebGL 2: switch on hardware acceleration, or open this page in another browser. Until then the server draws pictures:"),
      this.choice, this.picture,
    );
    void this.load();
  }

  private async load(): Promise<void> {
    const branches = await this.api.json<Branch[]>(`maps/${this.info.name}/branches`).catch(() => []);
    const robots = branches.flatMap(({ branch, status }) => (status?.pose ? [{ name: `From ${branch}`, pose: status.pose }] : []));
    this.viewpoints = [...robots, ...above(this.info)];
    if (!this.viewpoints.length) return fill(this.picture, h("p", {}, "Nothing is in this map yet."));
    await this.show();
  }

  private async show(): Promise<void> {
    const mine = ++this.asked;
    const press = (label: string, on: boolean, run: () => void) =>
      h("button", { type: "button", "aria-pressed": String(on), onclick: () => (run(), void this.show()) }, label);
    fill(
      this.choice, ...this.viewpoints.map(({ name }, n) => press(name, n === this.from, () => (this.from = n))),
      ...Object.entries(this.layers).map(([layer, label]) => press(label, layer === this.layer, () => (this.layer = layer))),
    );
    fill(this.picture, h("p", { role: "status" }, "The server draws ..."));
    const { name, pose } = this.viewpoints[this.from];
    const places = [...pose.t_map_rig, ...pose.q_map_rig].map((value) => value.toFixed(4));
    const query = new URLSearchParams(Object.entries({ ...SIZE, layer: this.layer, range_m: RANGE_M }).map(([key, value]) => [key, String(value)]));
    // Heights have no scale that fits all sites: that of the map.
    if (this.layer === "height" && this.info.box_m) ["low", "high"].forEach((key, n) => query.set(key, this.info.box_m![n]![2].toFixed(2)));
    ["x", "y", "z", "qx", "qy", "qz", "qw"].forEach((key, n) => query.set(key, places[n]));
    let found: HTMLElement;
    try {
      const answer = await this.api.ask(`maps/${this.info.name}/main/render?${query.toString()}`);
      found = await pictureOf(await answer.blob(), `The map: ${name.toLowerCase()}`);
    } catch (error) {
      found = h("p", { class: "error" }, (error as Error).message);
    }
    if (mine === this.asked) fill(this.picture, found);
  }
}

/** From over the middle of the map, straight down, as far off as is seen. */
function above({ box_m }: MapInfo): Viewpoint[] {
  if (!box_m) return [];
  const [low, high] = box_m;
  const wide = Math.max((high[0] - low[0]) / SIZE.width, (high[1] - low[1]) / SIZE.height) * SIZE.focal_px;
  const z = Math.min(high[2] + wide, low[2] + RANGE_M - 1);
  return [{ name: "From above", pose: { t_map_rig: [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, z], q_map_rig: [1, 0, 0, 0] } }];
}
