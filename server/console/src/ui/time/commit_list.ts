/** Commits that lie too close on the axis to be told apart: a list of all of them. */

import { fill, h } from "../../dom.ts";
import type { Commit } from "../../timeline.ts";
import { nameOf } from "./commit_mark.ts";

const PAGE = 200;

interface ListActs {
  choose(commit: Commit): void;
  /** Spread them over the axis. */
  zoom(): void;
}

export function openList(commits: readonly Commit[], acts: ListActs): void {
  const list = h("ul", { class: "commits" });
  const part = h("div", { class: "buttons" });
  const close = h("button", { type: "button" }, "Close");
  const zoom = h("button", { type: "button" }, "Zoom in on these");
  const robot = commits[0]!.robot;
  const dialog = h(
    "dialog", { "aria-label": `Commits of ${robot}` }, h("h2", {}, `${commits.length} commits of ${robot}`), list, part,
    h("div", { class: "buttons" }, zoom, close),
  );
  const show = (from: number) => {
    const rows = commits.slice(from, from + PAGE).map((commit) => {
      const row = h("button", { type: "button" }, nameOf(commit));
      row.addEventListener("click", () => {
        dialog.close();
        acts.choose(commit);
      });
      return h("li", {}, row);
    });
    fill(list, ...rows);
    list.scrollTop = 0;
    const turn = (text: string, to: number, can: boolean) => can && h("button", { type: "button", onclick: () => show(to) }, text);
    fill(part, turn(`Before ${from + 1}`, from - PAGE, from > 0), turn(`After ${from + PAGE}`, from + PAGE, from + PAGE < commits.length));
  };
  show(0);
  zoom.addEventListener("click", () => {
    dialog.close();
    acts.zoom();
  });
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}
