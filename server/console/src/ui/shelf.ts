/** Shelf: which of the panels is open, so that the map keeps the screen.
 *
 *     wide screen   tools are buttons on the map's edge; each opens one card over the map, "All tools" a column next to it
 *     phone         one sheet over the map's lower half (or its right one, where the screen is low), with tabs under it
 */

import { fill, h } from "../dom.ts";

/** Sections of the tools; `all`: the column, `none`: no tool. */
export type Tool = "none" | "look" | "voxel" | "measure" | "export" | "all";
export type Tab = "map" | "findings" | "robots" | "tools" | "time";

/** Screens whose panels are a sheet: style.css has the same. */
export const PHONE = "(max-width: 860px), (max-height: 480px)";
const KEY = "cairn.tools";
const TOOLS: [Tool, string, string][] = [
  ["look", "Look", "Slice, certainty, isotherms"], ["measure", "Measure", "Lengths, profiles, areas, volumes (M)"],
  ["export", "Export", "Files of what is shown, and the commands for them"], ["all", "All", "All tools in a column next to the map"],
];
const TABS: [Tab, string][] = [["map", "Map"], ["findings", "Findings"], ["robots", "Robots"], ["tools", "Tools"], ["time", "Time"]];

export class Shelf {
  /** Buttons on the map's edge. */
  readonly tools = h("nav", { class: "shelf", "aria-label": "Tools" });
  /** Tabs under the sheet of a phone. */
  readonly tabs = h("nav", { class: "tabs", "aria-label": "Panels" });
  onPlan: () => void = () => {};
  private tool: Tool;
  private tab: Tab = "map";
  private readonly element: HTMLElement;
  private readonly sections: ReadonlyMap<Tool, HTMLElement>;
  private readonly size = h("button", { type: "button", class: "size", title: "A larger or a smaller sheet" });
  private readonly phone = matchMedia(PHONE);
  private readonly rearrange = () => this.arrange();

  /** `element` holds the panels, and its attributes say which are seen; `sections` are the tools among them. */
  constructor(element: HTMLElement, sections: ReadonlyMap<Tool, HTMLElement>) {
    this.element = element;
    this.sections = sections;
    const plan = h("button", { type: "button", title: "The storey from straight above (P)", onclick: () => this.onPlan() }, "Plan");
    this.tool = localStorage.getItem(KEY) === "all" ? "all" : "none";
    const tools = TOOLS.map(([tool, name, title]) =>
      h("button", { type: "button", "data-tool": tool, title, onclick: () => this.press(tool) }, name));
    const tabs = TABS.map(([tab, name]) => h("button", { type: "button", "data-tab": tab, onclick: () => this.turnTo(tab) }, name));
    this.size.addEventListener("click", () => {
      this.element.toggleAttribute("data-full");
      this.arrange();
    });
    fill(this.tools, plan, ...tools);
    fill(this.tabs, ...tabs, this.size);
    this.phone.addEventListener("change", this.rearrange);
    this.arrange();
  }

  /** Show a tool's section, if it is not seen. */
  open(tool: Tool): void {
    if (this.tool !== "all") this.tool = tool;
    if (this.phone.matches) this.tab = "tools";
    this.arrange();
  }

  /** Put a tool's card away; a column stays. */
  shut(tool: Tool): void {
    if (this.tool !== tool || tool === "all") return;
    this.tool = "none";
    if (this.phone.matches && this.tab === "tools") this.tab = "map";
    this.arrange();
  }

  /** Words on a tab: how much is new behind it. */
  count(tab: Tab, said: string): void {
    const name = TABS.find(([one]) => one === tab)![1];
    const text = said ? `${name} ${said}` : name;
    const button = this.tabs.querySelector(`[data-tab="${tab}"]`)!;
    if (button.textContent !== text) button.textContent = text;
  }

  dispose(): void {
    this.phone.removeEventListener("change", this.rearrange);
  }

  private press(tool: Tool): void {
    this.tool = this.tool === tool ? "none" : tool;
    localStorage.setItem(KEY, this.tool === "all" ? "all" : "none");
    this.arrange();
  }

  /** The tab that is shown already shuts the sheet. */
  private turnTo(tab: Tab): void {
    this.tab = this.tab === tab ? "map" : tab;
    if (this.tab !== "tools" && this.tool !== "all") this.tool = "none";
    this.arrange();
  }

  private arrange(): void {
    const { element, phone } = this;
    element.dataset.tool = phone.matches ? "none" : this.tool;
    element.dataset.tab = this.tab;
    if (this.tab === "map") element.removeAttribute("data-full");
    const isAll = this.tool === "all" || (phone.matches && this.tool === "none");
    for (const [tool, section] of this.sections) section.hidden = !isAll && tool !== this.tool;
    for (const button of this.tools.querySelectorAll("button")) button.setAttribute("aria-pressed", String(button.dataset.tool === this.tool));
    for (const button of this.tabs.querySelectorAll<HTMLElement>("[data-tab]")) {
      button.setAttribute("aria-pressed", String(button.dataset.tab === this.tab));
    }
    this.size.hidden = this.tab === "map";
    this.size.textContent = element.hasAttribute("data-full") ? "▾" : "▴";
    this.size.setAttribute("aria-label", element.hasAttribute("data-full") ? "Smaller sheet" : "Larger sheet");
  }
}
