/** News since the page was opened: a few lines, each of which leads to its place. */

import { fill, h } from "../dom.ts";
import type { NewsItem } from "../news.ts";
import { clockTime } from "../units.ts";

export class NewsPanel {
  readonly element: HTMLElement;
  onGo: (item: NewsItem) => void = () => {};
  private readonly list = h("ol", { class: "lines" });
  private shown: readonly NewsItem[] = [];

  constructor() {
    const log = h("div", { role: "log", "aria-label": "What changed" }, this.list);
    this.element = h("section", { class: "news", "aria-label": "News", hidden: true }, h("h2", {}, "News"), log);
  }

  show(items: readonly NewsItem[]): void {
    // A button is not replaced between press and release, which would be no click.
    if (items === this.shown || this.list.querySelector("button:active")) return;
    this.shown = items;
    this.element.hidden = !items.length;
    fill(this.list, ...items.map((item) => h("li", {}, this.line(item))));
  }

  private line(item: NewsItem): HTMLElement {
    const words = [h("span", { class: "hint" }, clockTime(item.timeS)), ` ${item.text}`];
    if (!item.place) return h("p", {}, ...words);
    return h("button", { type: "button", title: "Fly there", onclick: () => this.onGo(item) }, ...words);
  }
}
