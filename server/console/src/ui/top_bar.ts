/** Which map, coloured by what, and whether it is live. */

import { fill, h } from "../dom.ts";
import type { LinkState } from "../live.ts";
import { fieldsOf, type Field } from "../look.ts";
import { layerText, mapOf } from "../map_layers.ts";
import type { MapInfo } from "../messages.ts";
import { isClockTrusted } from "../server_time.ts";
import { ago, bytes, counted } from "../units.ts";

const THEME_KEY = "cairn.theme";

export class TopBar {
  readonly element: HTMLElement;
  onField: (field: Field) => void = () => {};
  onTheme: () => void = () => {};
  private readonly fields: HTMLElement;
  /** The same where there is no room for buttons. */
  private readonly field: HTMLSelectElement;
  private readonly link = h("span", { class: "link", role: "status" });

  constructor(maps: readonly MapInfo[], { name: map, geometry }: MapInfo, loggedIn: boolean, on: { map: (name: string) => void; keys: () => void; share: () => void; logOut: () => void }) {
    const chooser = (label: string, options: readonly [string, string][], chosen: string) => {
      const made = h("select", { "aria-label": label }, ...options.map(([name, text]) => h("option", { value: name, selected: name === chosen }, text)));
      made.addEventListener("change", () => on.map(made.value));
      return made;
    };
    const own = mapOf(map);
    const layers = maps.filter(({ name }) => mapOf(name) === own);
    const names = [...new Set(maps.map(({ name }) => mapOf(name)))];
    const choice = chooser("Map", names.map((name) => [name, choiceOf(name, maps)]), own);
    const layer = layers.length > 1 ? chooser("Layer", layers.map((one) => [one.name, layerText(one)]), map) : null;
    const fields = fieldsOf(geometry);
    this.fields = h(
      "div", { class: "segments", role: "group", "aria-label": "Colour by" },
      ...fields.map(({ field, label }) =>
        h("button", { type: "button", "data-field": field, onclick: () => this.onField(field) }, label),
      ),
    );
    this.field = h("select", { class: "field", "aria-label": "Colour by" }, ...fields.map(({ field, label }) => h("option", { value: field }, label)));
    this.field.addEventListener("change", () => this.onField(this.field.value as Field));
    const more = h("button", { type: "button", class: "more", title: "Share, theme, keys, log out", "aria-expanded": "false" }, "⋯");
    const button = (label: string, title: string, run: () => void) => h("button", { type: "button", title, onclick: run }, label);
    this.element = h(
      "header", { class: "bar" },
      h("h1", { class: "brand" }, "cairn"), choice, layer, this.fields, this.field, h("span", { class: "space" }), this.link, more,
      h(
        "span", { class: "rare" },
        button("Share", "A link that shows another person the same", on.share),
        button("Theme", "Dark or light", () => {
          toggleTheme();
          this.onTheme();
        }),
        button("?", "Keys", on.keys),
        loggedIn ? button("Log out", "Forget the token", on.logOut) : null,
      ),
    );
    more.addEventListener("click", () => more.setAttribute("aria-expanded", String(this.element.toggleAttribute("data-more"))));
  }

  showField(field: Field): void {
    this.field.value = field;
    for (const button of this.fields.querySelectorAll("button")) {
      button.setAttribute("aria-pressed", String(button.dataset.field === field));
    }
  }

  showLink({ live, heardMs }: LinkState, waiting: number, error: string | null): void {
    const age = heardMs === null ? null : (Date.now() - heardMs) / 1000;
    const [state, said] =
      error !== null && live ? ["late", `Trouble: ${error}`]
      : live && !isClockTrusted() ? ["late", "Live; the server's clock is not trusted: measurements may wait"]
      : live ? (waiting > 0 ? ["busy", `Live, loading ${waiting} cells`] : ["live", "Live"])
      : age === null ? ["busy", "Connecting …"]
      : ["lost", `No link: the map is as it was ${ago(age)}`];
    if (this.link.dataset.state === state && this.link.textContent === said) return;
    this.link.dataset.state = state;
    fill(this.link, said);
  }
}

/** A map by what tells it from others; one of which this token sees a layer alone has its name. */
function choiceOf(map: string, maps: readonly MapInfo[]): string {
  const info = maps.find(({ name }) => name === map);
  return info ? `${map} · ${counted(info.cells, "cell", "cells")}, ${bytes(info.size_bytes)}, ${counted(info.branches, "robot", "robots")}` : map;
}

/** Dark or light: as the system says, or as was chosen here. */
export function applyTheme(): "dark" | "light" {
  const system = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
  const theme = (localStorage.getItem(THEME_KEY) ?? system) as "dark" | "light";
  document.documentElement.dataset.theme = theme;
  return theme;
}

function toggleTheme(): void {
  localStorage.setItem(THEME_KEY, applyTheme() === "dark" ? "light" : "dark");
  applyTheme();
}
