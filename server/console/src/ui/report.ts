/** Report: what a commander gets on paper or as a file: plans, findings, pictures, robots, and what proves the map later.
 *
 * A page of its own over the console, which the browser prints; style.css has what goes on paper. */

import { INDEX_PAGE, type Api } from "../api.ts";
import { attachmentOf, type Attachments } from "../attachments.ts";
import { facts, fill, h } from "../dom.ts";
import type { Finding } from "../findings.ts";
import { robotOf } from "../log_book.ts";
import { authorOf } from "../mark_book.ts";
import { digestOfMap, type MapDigest } from "../map_digest.ts";
import type { Branch, MapInfo } from "../messages.ts";
import { serverNowS } from "../server_time.ts";
import { metres, thousands } from "../units.ts";
import { pageZone, zoneNames, zoneOf, type Zone } from "../zone.ts";

const ZONE_KEY = "cairn.zone";
/** Of a plan and of a picture on paper, px; and pictures of a report at most. */
const PLAN = { width: 1400, height: 900 };
const PICTURE_PX = 640;
const PICTURES_MAX = 60;

export interface ReportSource {
  readonly api: Api;
  readonly info: MapInfo;
  readonly attachments: Attachments;
  readonly findings: readonly Finding[];
  plans(width: number, height: number): { name: string; canvas: HTMLCanvasElement; said: string }[];
  /** The past moment that plans show, for each of them, and all that is to be said of it; empty: now. */
  moment(): { name: string; words: string };
}

/** Put the report over the page; Escape, or its button, shuts it. */
export async function openReport(source: ReportSource): Promise<void> {
  const { api, info } = source;
  const body = h("div", { class: "sheet" }, h("p", { role: "status" }, "The report is made …"));
  const zones = h("select", { id: "zone" }, ...zoneNames().map((name) => h("option", { value: name }, name)));
  zones.value = localStorage.getItem(ZONE_KEY) ?? pageZone().name;
  const print = h("button", { type: "button", class: "main", disabled: true, onclick: () => window.print() }, "Print, or save as PDF");
  const close = h("button", { type: "button" }, "Close");
  const dialog = h(
    "dialog", { class: "report", "aria-label": "Report" },
    h("div", { class: "buttons controls" }, h("label", { for: "zone" }, "Times in"), zones, print, close), body,
  );
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  const madeS = serverNowS();
  try {
    const [digest, branches, pictures] = await Promise.all([
      digestOfMap(api, info.name), api.json<Branch[]>(`maps/${info.name}/branches`), picturesOf(source),
    ]);
    // Cursor and digest are always of now.
    const moment = source.moment();
    const plans = source.plans(PLAN.width, PLAN.height).map(({ name, canvas, said }) =>
      h("figure", { class: "storey" }, h("figcaption", {}, `${[name, moment.name].filter(Boolean).join(", ")}: ${said}`), canvas));
    const comment = h("textarea", { rows: "3", "aria-label": "Remarks, which are printed", placeholder: "Remarks, which are printed" });
    const write = () => {
      const zone = zoneOf(zones.value);
      fill(
        body, h("h1", {}, `Report of the map ${info.name}`), head(info, digest, zone.format(madeS), moment.words), comment,
        h("h2", {}, "Plans"), ...plans, h("h2", {}, "Findings"), table(source.findings, zone),
        pictures.length > 0 && h("h2", {}, "Pictures"), ...pictures, h("h2", {}, "Robots"), team(branches, zone), h("h2", {}, "Proof"), proof(info, digest),
      );
    };
    zones.addEventListener("change", () => {
      localStorage.setItem(ZONE_KEY, zones.value);
      write();
    });
    write();
    print.disabled = false;
  } catch (error) {
    fill(body, h("p", { class: "error", role: "alert" }, (error as Error).message));
  }
}

function head({ geometry }: MapInfo, { cursor, digest, cells, commits }: MapDigest, made: string, past: string): HTMLElement {
  return facts([
    ["made", made], ["server", new URL(".", document.baseURI).href], ["cursor", h("code", {}, cursor)],
    ["digest", digest ? h("code", {}, digest) : "none: the map changed while it was read"],
    ["map", `${thousands(cells)} cells, ${thousands(commits)} commits, voxels of ${metres(geometry.voxel_edge_um / 1e6)}`],
    ...(past ? [["plans", `${past} Cursor and digest are of now.`] as [string, string]] : []),
  ]);
}

function table(findings: readonly Finding[], zone: Zone): HTMLElement {
  const shown = findings.filter(({ state }) => state !== "dismissed");
  if (!shown.length) return h("p", {}, "No hot spots, and no marks.");
  const heads = ["No.", "What", "Temperature", "x, y, z in the map, m", "Over the floor", "State", "By", "When", "Note"];
  const rows = shown.map(({ number, title, celsius, place, spot, state, entry }) => {
    const timeS = entry ? entry.mark.time_ms / 1000 : (spot?.captured_s?.[1] ?? spot?.measured_s);
    return [
      String(number), title, celsius === null ? "" : `${celsius.toFixed(1)} °C${spot ? ` ± ${spot.sigma.toFixed(1)}` : ""}`,
      place.map((each) => each.toFixed(2)).join(", "), spot?.over_floor_m == null ? "" : metres(spot.over_floor_m, 1),
      spot && !spot.confirmed ? `${state}, perhaps a ghost` : state, entry ? authorOf(entry) : (spot?.commit ? robotOf(spot.commit) : ""),
      timeS === undefined ? "" : zone.format(timeS), entry?.mark.note ?? "",
    ];
  });
  const cells = (row: string[], tag: "th" | "td") => h("tr", {}, ...row.map((text) => h(tag, {}, text)));
  const dismissed = findings.length - shown.length;
  return h(
    "div", {}, h("table", {}, h("thead", {}, cells(heads, "th")), h("tbody", {}, ...rows.map((row) => cells(row, "td")))),
    dismissed > 0 && h("p", {}, `${dismissed} more were dismissed by operators.`),
  );
}

/** Pictures of marks, as figures with the finding's number; what cannot be shown is said. */
async function picturesOf({ findings, attachments }: ReportSource): Promise<HTMLElement[]> {
  const with_ = findings.flatMap(({ number, entry, state }) => (entry && state === "mark" && attachmentOf(entry.mark) ? [{ number, mark: entry.mark }] : []));
  const figures: HTMLElement[] = [];
  // One after another: each may be large while it is decoded.
  for (const { number, mark } of with_.slice(0, PICTURES_MAX)) {
    const picture = await attachments.picture(mark, PICTURE_PX).catch((error: unknown) => h("p", {}, (error as Error).message));
    figures.push(h("figure", { class: "picture" }, picture, h("figcaption", {}, `${number}: ${mark.name}`)));
  }
  return figures;
}

function team(branches: readonly Branch[], zone: Zone): HTMLElement {
  if (!branches.length) return h("p", {}, "None registered.");
  return h("ul", {}, ...branches.map(({ branch, last_seen_s, status }) =>
    h("li", {}, h("strong", {}, branch), `, seen ${zone.format(last_seen_s)}${status?.note ? `: ${status.note}` : ""}`)));
}

function proof({ name }: MapInfo, { cursor, digest }: MapDigest): HTMLElement {
  const url = new URL(`maps/${name}/main/cells?limit=${INDEX_PAGE}`, document.baseURI).href;
  // Page after page: an empty one ends the index.
  const command = [
    "last=",
    `while page=$(curl -sSf -H 'Cairn-Format: 4' -H "Authorization: Bearer $CAIRN_TOKEN" "${url}$last") &&`,
    `    lines=$(printf %s "$page" | jq -r '.cells[] | "\\(.cell | join(",")) \\(.digest)"') && [ -n "$lines" ]`,
    `do printf '%s\\n' "$lines"; last="&after=$(printf '%s\\n' "$lines" | tail -n 1 | cut -d ' ' -f 1)"; done | sha256sum`,
  ].join("\n");
  return h(
    "div", {},
    h("p", {}, digest ? `The digest is the SHA-256 over a line of each cell, its number and its digest, at the cursor ${cursor}. A server whose map is at this cursor, also one made of a backup, gives the same:`
      : "Make the report again while no robot sends, for a digest."),
    digest && h("pre", { tabindex: "0" }, command),
  );
}
