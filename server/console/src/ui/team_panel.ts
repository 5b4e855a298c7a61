/** Robots' board: one line each, the troubled first, so that thirty fit; more of the one that is followed.
 *
 *     what is heard of a robot  -->  its trouble, in a word  -->  the order of the lines, and the count over them */

import { fill, h } from "../dom.ts";
import type { FullShare } from "../duties.ts";
import type { Branch, RobotSign } from "../messages.ts";
import { HELP } from "../news.ts";
import { robotColour } from "../palettes.ts";
import { serverNowS } from "../server_time.ts";
import { ago, bytes } from "../units.ts";

/** Who was not heard of for so long counts as offline, s. */
export const OFFLINE_S = 60;

export function isOffline(lastSeenS: number): boolean {
  return serverNowS() - lastSeenS > OFFLINE_S;
}

/** Teams so small have all that is known of each under its line. */
const DETAILED = 4;
/** Below this a battery is trouble; and a robot is late that is so many commits behind. */
const LOW_BATTERY = 0.2;
const LATE_COMMITS = 20;
/** Gravest first; `said`: what is written in the line. */
const TROUBLES = ["stuck", "offline", "battery", "late", "waiting"] as const;
type Trouble = (typeof TROUBLES)[number];

interface Row {
  readonly name: string;
  readonly offline: boolean;
  readonly mode: string;
  readonly seen: string;
  readonly lag: string;
  readonly missing: string;
  readonly waiting: string;
  readonly battery: number | null;
  readonly note: string;
  readonly hasPose: boolean;
  readonly followed: boolean;
  readonly full: string;
  readonly sigma: string;
  readonly trouble: Trouble | null;
}

export class TeamPanel {
  readonly element = h("section", { class: "team", "aria-label": "Robots" });
  onFollow: (robot: string) => void = () => {};
  private readonly summary = h("p", { class: "hint", role: "status" });
  private readonly list = h("ul", { class: "robots" });
  private shown = "";

  constructor() {
    this.element.append(h("h2", {}, "Robots"), this.summary, this.list);
  }

  show(
    branches: readonly Branch[], signs: ReadonlyMap<string, RobotSign>, names: readonly string[], followed: string | null,
    full: readonly FullShare[],
  ): void {
    const rows = branches.map((branch) => rowOf(branch, signs.get(branch.branch), followed, full)).sort(bySeverity);
    const isDetailed = rows.length <= DETAILED;
    const state = JSON.stringify(rows.map((row) => (isDetailed || row.followed ? row : shortOf(row))));
    // A button is not replaced between press and release, which would be no click.
    if (state === this.shown || this.list.querySelector("button:active")) return;
    this.shown = state;
    this.summary.textContent = rows.length > 1 ? summaryOf(rows) : "";
    const active = (document.activeElement as HTMLElement | null)?.dataset.robot;
    fill(this.list, ...rows.map((row) => this.row(row, names, isDetailed || row.followed)), rows.length ? null : h("li", { class: "hint" }, "None registered."));
    if (active) this.list.querySelector<HTMLElement>(`[data-robot="${active}"]`)?.focus();
  }

  private row(row: Row, names: readonly string[], isDetailed: boolean): HTMLElement {
    const dot = h("span", { class: "dot", "aria-hidden": "true" });
    dot.style.background = robotColour(row.name, names);
    const state = row.trouble && !row.offline ? wordOf(row) : row.offline ? "offline" : "online";
    const button = h(
      "button",
      {
        type: "button", "data-robot": row.name, "aria-pressed": String(row.followed), disabled: !row.hasPose,
        title: row.hasPose ? `Follow ${row.name}` : `${row.name} never told where it is`,
        onclick: () => this.onFollow(row.name),
      },
      dot, h("strong", {}, row.name), isDetailed && h("span", { class: "mode" }, row.mode), !isDetailed && row.note && h("span", { class: "mode said" }, row.note),
      h("span", { class: row.offline ? "state off" : row.trouble ? "state bad" : "state on" }, state),
    );
    const battery = row.battery === null ? "" : `battery ${Math.round(row.battery * 100)} %`;
    const lines = isDetailed ? [row.lag, `seen ${row.seen}`, row.missing, row.waiting, [row.sigma, battery].filter(Boolean).join(" · "), row.note] : [];
    const said = lines.filter(Boolean).map((line) => h("p", {}, line));
    const full = row.full && h("p", { class: "full" }, `uses more than half of its share: ${row.full}`);
    return h("li", { class: row.offline ? "robot offline" : "robot" }, button, full || null, ...said);
  }
}

function rowOf(branch: Branch, sign: RobotSign | undefined, followed: string | null, full: readonly FullShare[]): Row {
  const lastSeenS = Math.max(branch.last_seen_s, sign?.time_s ?? 0);
  const status = sign?.status ?? branch.status;
  const offline = isOffline(lastSeenS);
  const pose = status?.pose ?? null;
  const note = status?.note ?? "";
  const battery = status?.battery ?? null;
  const trouble: Trouble | null = HELP.test(note) ? "stuck" : offline ? "offline" : battery !== null && battery < LOW_BATTERY ? "battery"
    : (branch.behind ?? 0) > LATE_COMMITS ? "late" : status?.waiting ? "waiting" : null;
  return {
    name: branch.branch, offline, mode: branch.mode, seen: ago(serverNowS() - lastSeenS), lag: lagOf(branch), battery, note, trouble,
    missing: followed === branch.branch && branch.mode === "high-end" && branch.behind !== 0 ? "amber borders: cells it has not fetched since they changed" : "",
    waiting: status?.waiting ? `${status.waiting} commits (${bytes(status.waiting_bytes)}) still on board` : "",
    hasPose: pose !== null, followed: followed === branch.branch,
    full: full.find(({ robot }) => robot === branch.branch)?.said ?? "",
    sigma: pose?.sigma_m ? `pose ± ${pose.sigma_m.toFixed(2)} m` : "",
  };
}

/** A row without what one line has no room for, such as when it was seen, which changes each second. */
function shortOf(row: Row): Row {
  return { ...row, seen: "", lag: "", missing: "", waiting: "", sigma: "", battery: row.trouble === "battery" ? row.battery : null };
}

/** The gravest trouble first, and among equals by name: a line moves only when a state changes. */
function bySeverity(a: Row, b: Row): number {
  const rank = ({ trouble }: Row) => (trouble === null ? TROUBLES.length : TROUBLES.indexOf(trouble));
  return rank(a) - rank(b) || (a.name < b.name ? -1 : 1);
}

/** What is written at the end of a troubled robot's line. */
function wordOf({ trouble, battery }: Row): string {
  if (trouble === "stuck") return "! help";
  return trouble === "battery" ? `${Math.round((battery ?? 0) * 100)} % left` : trouble === "waiting" ? "sending" : (trouble ?? "");
}

function summaryOf(rows: readonly Row[]): string {
  const count = (is: (row: Row) => boolean) => rows.filter(is).length;
  const parts: [number, string][] = [
    [count(({ offline }) => !offline), "online"], [count(({ offline }) => offline), "offline"], [count(({ trouble }) => trouble === "stuck"), "need help"],
    [count(({ trouble }) => trouble === "battery"), "low on battery"], [count(({ trouble }) => trouble === "late"), "late"],
  ];
  return parts.filter(([number]) => number).map(([number, word]) => `${number} ${word}`).join(", ");
}

function lagOf({ behind, behind_bytes, mode }: Branch): string {
  if (behind === null) return mode === "low-end" ? "keeps no map" : "never fetched";
  if (behind === 0) return "level with the map";
  const size = behind_bytes === null ? "" : ` (${bytes(behind_bytes)})`;
  return `${behind} commit${behind === 1 ? "" : "s"}${size} behind`;
}
