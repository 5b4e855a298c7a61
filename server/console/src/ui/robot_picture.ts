/** What the robot that is followed sees: the last picture that it showed the server. */

import type { Api } from "../api.ts";
import { fill, h, pictureOf } from "../dom.ts";
import { serverNowS } from "../server_time.ts";
import { ago } from "../units.ts";

/** For a picture to come; then the next one is asked for. */
const WAIT_MS = 15_000;

export class RobotPicture {
  readonly element = h("figure", { class: "seen", hidden: true });
  private readonly caption = h("figcaption", {});
  private readonly api: Api;
  private readonly map: string;
  private robot: string | null = null;
  /** Time of the picture that was asked for last, and of the one that is shown. */
  private askedS: number | null = null;
  private shownS: number | null = null;
  private busy = false;

  constructor(api: Api, map: string) {
    this.api = api;
    this.map = map;
  }

  /** Show a robot's picture of a time; null: none is followed, or it has none. One is fetched at a time, however many come. */
  show(robot: string | null, viewS: number | null): void {
    if (robot !== this.robot || viewS === null) this.clear();
    this.robot = robot;
    if (robot === null || viewS === null) return;
    this.say();
    if (viewS === this.askedS || this.busy) return;
    this.askedS = viewS;
    void this.load(robot, viewS);
  }

  private async load(robot: string, viewS: number): Promise<void> {
    this.busy = true;
    try {
      const answer = await this.api.ask(`maps/${this.map}/branches/${robot}/view`, { signal: AbortSignal.timeout(WAIT_MS) });
      const picture = await pictureOf(await answer.blob(), `What ${robot} sees`);
      if (robot !== this.robot || this.askedS === null) return;
      this.shownS = viewS;
      this.say();
      fill(this.element, picture, this.caption);
      this.element.hidden = false;
    } catch {
      // Asked again with the next one.
    } finally {
      this.busy = false;
    }
  }

  /** How old what is shown is by now. */
  private say(): void {
    if (this.shownS === null) return;
    const said = `${this.robot} saw this ${ago(serverNowS() - this.shownS)}`;
    if (this.caption.textContent !== said) this.caption.textContent = said;
  }

  private clear(): void {
    this.element.hidden = true;
    this.askedS = this.shownS = null;
  }
}
