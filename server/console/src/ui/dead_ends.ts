/** Pages where there is no map to show: what is so, and what to do about it. */

import { fill, h } from "../dom.ts";
import type { MapInfo } from "../messages.ts";
import { bytes, counted } from "../units.ts";
import { copied } from "./take_away_panel.ts";

const RETRY_MS = 3000;

/** Until the server is asked again. */
export function pause(): Promise<void> {
  return new Promise((resolve) => setTimeout(resolve, RETRY_MS));
}

/** Address of a map of this server, as commands take it. */
export function addressOf(map: string): string {
  return new URL(`maps/${map}`, document.baseURI).href;
}

/** A page of words; the same words again leave it as it is, with what was selected in it. */
export function message(title: string, ...lines: (string | HTMLElement)[]): void {
  const page = h("main", { class: "message" }, h("h1", {}, title), ...lines.map((line) => (typeof line === "string" ? h("p", {}, line) : line)));
  const before = document.querySelector("main.message");
  if (before?.textContent !== page.textContent) fill(document.body, page);
}

export function noMap(): void {
  message(
    "No map yet", "This server holds no map that you may see. An administrator makes one:", copied(`cairn map create ${addressOf("lab")}`),
    "This page shows it as soon as it is there.",
  );
}

export function unknownMap(name: string, maps: readonly MapInfo[]): void {
  const links = maps.map((map) => h("li", {}, h("a", { href: `#map=${map.name}` }, map.name), `, ${counted(map.cells, "cell", "cells")}, ${bytes(map.size_bytes)}`));
  message(
    `No map ${name} here`, "It is not on this server, was deleted, or is not yours to see. Ask whoever sent you the link.",
    ...(maps.length ? ["Maps that are here:", h("ul", {}, ...links)] : []), "This page shows it if it comes.",
  );
}

/** A map that holds nothing yet. */
export function emptyMap(name: string): HTMLElement {
  return h(
    "section", { class: "empty", "aria-label": "Empty map" }, h("h2", {}, "Nothing is in this map yet"),
    h("p", {}, "The page shows what robots find as soon as they bring it. A robot's recording is mapped so:"),
    copied(`cairn robot replay RECORDING --map ${addressOf(name)}`),
  );
}
