/** The map as the robot that is followed would see it: drawn by the server from the robot's pose. */

import type { Api } from "../api.ts";
import { fill, h, pictureOf } from "../dom.ts";
import type { Field } from "../look.ts";
import type { Pose } from "../messages.ts";

/** Time from one picture to the next, ms: a robot reports its pose several times a second, and the server draws for others, too. */
const PAUSE_MS = 1500;
/** After a picture that could not be made: the server may have been busy. */
const AGAIN_MS = 5000;
const WAIT_MS = 20_000;
/** Layer of the server's pictures for each field. */
const LAYERS: Partial<Record<Field, string>> = {
  colour: "colour", temperature: "temperature", probability: "probability", height: "depth", age: "age", robot: "colour",
};
/** The same for a level layer, which has neither colours nor temperatures. */
const LEVEL_LAYERS: Partial<Record<Field, string>> = {
  height: "height", slope: "slope", step: "step", difficulty: "difficulty", probability: "probability", age: "age",
};
const SIZE = { width: "320", height: "240", focal_px: "250" };

export class RobotMap {
  readonly element = h("figure", { class: "seen", hidden: true });
  private readonly api: Api;
  private readonly map: string;
  private readonly layers: Partial<Record<Field, string>>;
  private robot: string | null = null;
  /** Picture that was asked for last. */
  private asked = "";
  private busy = false;
  private nextMs = 0;

  constructor(api: Api, map: string, isLevel: boolean) {
    this.api = api;
    this.map = map;
    this.layers = isLevel ? LEVEL_LAYERS : LAYERS;
  }

  /** Show the map at log entry `head` from a robot's pose, in the colours of a field; null: no robot is followed. */
  show(robot: string | null, pose: Pose | null, field: Field, head: number): void {
    if (robot !== this.robot || pose === null) this.clear();
    this.robot = robot;
    const layer = this.layers[field];
    if (robot === null || pose === null || layer === undefined) return;
    const [x, y, z] = pose.t_map_rig;
    const [qx, qy, qz, qw] = pose.q_map_rig;
    const places = Object.entries({ x, y, z, qx, qy, qz, qw }).map(([name, value]) => [name, value.toFixed(4)]);
    const query = new URLSearchParams([...places, ...Object.entries({ ...SIZE, layer })]).toString();
    const wanted = `${robot} ${head} ${query}`;
    if (wanted === this.asked || this.busy || performance.now() < this.nextMs) return;
    this.nextMs = performance.now() + PAUSE_MS;
    this.asked = wanted;
    void this.load(robot, query);
  }

  /** One at a time: a robot that moves on must not leave each picture behind before it is drawn. */
  private async load(robot: string, query: string): Promise<void> {
    this.busy = true;
    if (this.element.hidden) fill(this.element, h("p", { class: "hint", role: "status" }, `The server draws the map from ${robot}'s pose …`));
    this.element.hidden = false;
    let picture: HTMLElement;
    let failed = false;
    try {
      const answer = await this.api.ask(`maps/${this.map}/main/render?${query}`, { signal: AbortSignal.timeout(WAIT_MS) });
      picture = await pictureOf(await answer.blob(), `The map as ${robot} would see it`);
    } catch (error) {
      failed = true;
      picture = h("p", { class: "error" }, (error as Error).message);
      this.nextMs = performance.now() + AGAIN_MS;
    } finally {
      this.busy = false;
    }
    if (robot !== this.robot || this.asked === "") return;
    if (failed) this.asked = "failed";
    fill(this.element, picture, h("figcaption", {}, `The map from ${robot}'s pose`));
    this.element.hidden = false;
  }

  private clear(): void {
    this.element.hidden = true;
    this.asked = "";
  }
}
