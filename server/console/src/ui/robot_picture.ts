/** What the robot that is followed sees: the last picture that it showed the server. */

import type { Api } from "../api.ts";
import { fill, h } from "../dom.ts";
import { ago } from "../units.ts";

export class RobotPicture {
  readonly element = h("figure", { class: "seen", hidden: true });
  private readonly api: Api;
  private readonly map: string;
  private shown = "";
  private url: string | null = null;

  constructor(api: Api, map: string) {
    this.api = api;
    this.map = map;
  }

  /** Show a robot's picture of a time; null: none is followed, or it has none. */
  show(robot: string | null, viewS: number | null): void {
    const wanted = robot === null || viewS === null ? "" : `${robot} ${viewS}`;
    if (wanted === this.shown) return;
    this.shown = wanted;
    if (robot === null || viewS === null) this.clear();
    else void this.load(robot, viewS, wanted);
  }

  private async load(robot: string, viewS: number, wanted: string): Promise<void> {
    try {
      const blob = await (await this.api.ask(`maps/${this.map}/branches/${robot}/view`)).blob();
      if (wanted !== this.shown) return;
      this.clear();
      this.url = URL.createObjectURL(blob);
      const said = `${robot} saw this ${ago(Date.now() / 1000 - viewS)}`;
      fill(this.element, h("img", { src: this.url, alt: `What ${robot} sees` }), h("figcaption", {}, said));
      this.element.hidden = false;
    } catch {
      this.shown = ""; // asked again with the next sign of it
    }
  }

  private clear(): void {
    this.element.hidden = true;
    if (this.url) URL.revokeObjectURL(this.url);
    this.url = null;
  }
}
