/** The team: who is where, how far behind, and when each was last heard of. */

import { fill, h } from "../dom.ts";
import type { FullShare } from "../duties.ts";
import type { Branch, RobotSign } from "../messages.ts";
import { robotColour } from "../palettes.ts";
import { serverNowS } from "../server_time.ts";
import { ago, bytes } from "../units.ts";

/** Who was not heard of for so long counts as offline, s. */
export const OFFLINE_S = 60;

export function isOffline(lastSeenS: number): boolean {
  return serverNowS() - lastSeenS > OFFLINE_S;
}

export class TeamPanel {
  readonly element = h("section", { "aria-label": "Robots" });
  onFollow: (robot: string) => void = () => {};
  private readonly list = h("ul", { class: "robots" });
  private shown = "";

  constructor() {
    this.element.append(h("h2", {}, "Robots"), this.list);
  }

  show(
    branches: readonly Branch[], signs: ReadonlyMap<string, RobotSign>, names: readonly string[], followed: string | null,
    full: readonly FullShare[],
  ): void {
    const rows = branches.map((branch) => {
      const sign = signs.get(branch.branch);
      const lastSeenS = Math.max(branch.last_seen_s, sign?.time_s ?? 0);
      const status = sign?.status ?? branch.status;
      const offline = isOffline(lastSeenS);
      const pose = status?.pose ?? null;
      return {
        name: branch.branch, offline, mode: branch.mode, seen: ago(serverNowS() - lastSeenS), lag: lagOf(branch),
        missing: followed === branch.branch && branch.mode === "high-end" && branch.behind !== 0 ? "amber borders: cells it has not fetched since they changed" : "",
        waiting: status?.waiting ? `${status.waiting} commits (${bytes(status.waiting_bytes)}) still on board` : "",
        battery: status?.battery == null ? "" : `battery ${Math.round(status.battery * 100)} %`,
        note: status?.note ?? "", hasPose: pose !== null, followed: followed === branch.branch,
        full: full.find(({ robot }) => robot === branch.branch)?.said ?? "",
        sigma: pose?.sigma_m ? `pose ± ${pose.sigma_m.toFixed(2)} m` : "",
      };
    });
    const state = JSON.stringify(rows);
    if (state === this.shown) return;
    this.shown = state;
    const active = (document.activeElement as HTMLElement | null)?.dataset.robot;
    fill(this.list, ...rows.map((row) => this.row(row, names)), rows.length ? null : h("li", { class: "hint" }, "None registered."));
    if (active) this.list.querySelector<HTMLElement>(`[data-robot="${active}"]`)?.focus();
  }

  private row(
    row: { name: string; offline: boolean; mode: string; seen: string; lag: string; missing: string; waiting: string; battery: string;
      note: string; hasPose: boolean; followed: boolean; full: string; sigma: string },
    names: readonly string[],
  ): HTMLElement {
    const dot = h("span", { class: "dot", "aria-hidden": "true" });
    dot.style.background = robotColour(row.name, names);
    const button = h(
      "button",
      {
        type: "button", "data-robot": row.name, "aria-pressed": String(row.followed), disabled: !row.hasPose,
        title: row.hasPose ? `Follow ${row.name}` : `${row.name} never told where it is`,
        onclick: () => this.onFollow(row.name),
      },
      dot, h("strong", {}, row.name), h("span", { class: "mode" }, row.mode),
      h("span", { class: row.offline ? "state off" : "state on" }, row.offline ? "offline" : "online"),
    );
    const lines = [row.lag, `seen ${row.seen}`, row.missing, row.waiting, [row.sigma, row.battery].filter(Boolean).join(" · "), row.note];
    const said = lines.filter(Boolean).map((line) => h("p", {}, line));
    const full = row.full && h("p", { class: "full" }, `uses more than half of its share: ${row.full}`);
    return h("li", { class: row.offline ? "robot offline" : "robot" }, button, full || null, ...said);
  }
}

function lagOf({ behind, behind_bytes, mode }: Branch): string {
  if (behind === null) return mode === "low-end" ? "keeps no map" : "never fetched";
  if (behind === 0) return "level with the map";
  const size = behind_bytes === null ? "" : ` (${bytes(behind_bytes)})`;
  return `${behind} commit${behind === 1 ? "" : "s"}${size} behind`;
}
