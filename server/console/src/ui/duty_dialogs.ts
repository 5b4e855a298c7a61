/** An operator's word for a robot's other key, and an administrator's that a robot begins again: looked at, then said. */

import type { Api } from "../api.ts";
import { digitsOf, percent, type Duties } from "../duties.ts";
import { facts, fill, h } from "../dom.ts";
import { robotOf } from "../log_book.ts";
import type { AskingRobot, RobotClosed } from "../messages.ts";
import { serverNowS } from "../server_time.ts";
import { ago, clock, counted } from "../units.ts";

/** The key of a robot that asks, next to those that its name is bound to; closes when it is decided or put off. */
export function openAsking(duties: Duties, asking: AskingRobot): void {
  const robot = robotOf(asking.author);
  const known = duties.keys.admitted.filter(({ author }) => robotOf(author) === robot && author !== asking.author);
  const others = duties.keys.asking.filter(({ author }) => robotOf(author) === robot && author !== asking.author).length;
  const said = h("div", { class: "said", "aria-live": "polite" });
  const admit = h("button", { type: "button", class: "danger" }, "Admit this key");
  const refuse = h("button", { type: "button" }, "Refuse");
  const dialog = shown(
    `Is this ${robot}?`,
    facts([
      ["robot", h("strong", {}, robot)],
      ["key that asks", h("code", {}, digitsOf(asking.author))],
      ["since", clock(asking.since_s)],
      ["last", ago(Math.max(serverNowS() - asking.asked_s, 0))],
      ["came by", `token ${asking.by}`],
      ["known by", known.length ? h("ul", {}, ...known.map(({ author, since_s }) => h("li", {}, h("code", {}, digitsOf(author)), ` since ${clock(since_s)}`))) : "no key"],
    ]),
    others ? h("p", { class: "error" }, `${counted(others, "other key asks", "other keys ask")} for this name, too.`) : null,
    h("p", {}, "Compare all 16 digits with the robot's own: ", h("code", {}, "cairn robot status DIR"), " on the robot shows them after its name."),
    h("p", { class: "hint" }, `Who has a key that is admitted may write as ${robot} from then on. Until it is admitted the robot maps on and keeps its commits.`),
    said, [admit, refuse],
  );
  admit.addEventListener("click", async () => {
    admit.disabled = refuse.disabled = true;
    try {
      await duties.admit(asking);
      fill(said, h("p", { class: "done" }, `Done: this key may speak for ${robot}. The robot comes by itself when it tries again.`));
    } catch (error) {
      admit.disabled = refuse.disabled = false;
      fill(said, h("p", { class: "error" }, (error as Error).message));
    }
  });
  refuse.addEventListener("click", () => {
    refuse.disabled = true;
    duties.refuse(asking);
    fill(said, h("p", { class: "done" }, `Refused: nothing by this key comes into the map. If it is no robot of yours, end the token ${asking.by}.`));
  });
  dialog.showModal();
}

/** What a robot uses of its shares, and closing it. */
export function openFull(api: Api, map: string, duties: Duties, robot: string): void {
  const use = duties.uses.find((one) => one.robot === robot);
  if (!use) return;
  const said = h("div", { class: "said", "aria-live": "polite" });
  const close = h("button", { type: "button", class: "danger" }, `Close ${robot}`);
  const dialog = shown(
    `Shares of ${robot}`,
    facts([
      ["incarnations", String(use.incarnations)],
      ["intervals", String(use.intervals)],
      ...Object.entries(use.used).map(([bound, part]): [string, string] => [`of its ${bound}`, bound === "sums" && part === 0 ? "at most half" : percent(part)]),
    ]),
    h("p", {}, "A robot whose share is full is refused, and no other one. Taking commits of it out gives its sums back."),
    h("p", { class: "hint" }, `Closing takes nothing out of the map: the incarnations that ${robot} has now take no new commits, and its shares are whole again. ` +
      "A robot that is still at work goes on by itself with a new one. It takes an administrator's token, and cannot be undone."),
    said, [close],
  );
  close.addEventListener("click", async () => {
    close.disabled = true;
    try {
      const { incarnations } = await api.post<RobotClosed>(`maps/${map}/robots/${robot}/close`, {});
      fill(said, h("p", { class: "done" }, `Done: ${counted(incarnations, "incarnation", "incarnations")} closed; its next commits count from nothing.`));
      duties.refresh();
    } catch (error) {
      close.disabled = false;
      fill(said, h("p", { class: "error" }, (error as Error).message));
    }
  });
  dialog.showModal();
}

/** A dialog on the page, not open yet, with a button that leads back after its others. */
function shown(title: string, ...parts: (HTMLElement | HTMLElement[] | null)[]): HTMLDialogElement {
  const back = h("button", { type: "button", onclick: () => dialog.close() }, "Back");
  const rows = parts.map((part) => (Array.isArray(part) ? h("div", { class: "buttons" }, ...part, back) : part));
  const dialog = h("dialog", { "aria-label": title }, h("h2", {}, title), ...rows);
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  return dialog;
}
