/** What waits for an operator, above all else in its column; not there while nothing does. */

import { digitsOf, type Duties, type FullShare } from "../duties.ts";
import { fill, h } from "../dom.ts";
import { robotOf } from "../log_book.ts";
import type { AskingRobot } from "../messages.ts";
import { clock } from "../units.ts";

export class DutyPanel {
  readonly element = h("section", { class: "duties", "aria-label": "For an operator", "aria-live": "polite", hidden: true });
  onAsking: (asking: AskingRobot) => void = () => {};
  onFull: (robot: string) => void = () => {};
  private shown = "";

  show({ keys, refused, full }: Duties): void {
    const state = JSON.stringify([keys.asking.map(({ author, since_s }) => [author, since_s, refused.has(author)]), full]);
    // A button is not replaced between press and release, which would be no click.
    if (state === this.shown || this.element.querySelector("button:active")) return;
    this.shown = state;
    const active = (document.activeElement as HTMLElement | null)?.dataset.duty;
    const asking = keys.asking.toSorted((a, b) => Number(refused.has(a.author)) - Number(refused.has(b.author)) || a.since_s - b.since_s);
    this.element.hidden = !asking.length && !full.length;
    fill(
      this.element, h("h2", {}, "For an operator"),
      h("ul", {}, ...asking.map((each) => this.asks(each, refused.has(each.author))), ...full.map((each) => this.isFull(each))),
    );
    if (active) this.element.querySelector<HTMLElement>(`[data-duty="${active}"]`)?.focus();
  }

  private asks(asking: AskingRobot, isRefused: boolean): HTMLElement {
    const robot = robotOf(asking.author);
    return h(
      "li", { class: isRefused ? "duty refused" : "duty" },
      h("p", {}, h("strong", {}, robot), isRefused ? " is refused" : " asks to be let in"),
      h("p", { class: "hint" }, "key ", h("code", {}, `${digitsOf(asking.author).slice(0, 9)} …`)),
      h("p", { class: "hint" }, `since ${clock(asking.since_s).slice(0, 16)} UTC`),
      h("button", { type: "button", "data-duty": asking.author, onclick: () => this.onAsking(asking) }, isRefused ? "Look again …" : "Compare …"),
    );
  }

  private isFull({ robot, said }: FullShare): HTMLElement {
    const isMap = robot === null && said.startsWith("robots ");
    return h(
      "li", { class: "duty" },
      h("p", {}, h("strong", {}, robot ?? (isMap ? "map" : "reserve")), " uses more than half"),
      h("p", { class: "hint" }, said),
      robot && h("button", { type: "button", "data-duty": `shares ${robot}`, onclick: () => this.onFull(robot) }, "Shares …"),
    );
  }
}
