/** Taking commits out again: what, then what that would name, then for good. */

import { ApiError, type Api } from "../api.ts";
import { facts, fill, h } from "../dom.ts";
import { robotOf } from "../log_book.ts";
import type { LogEntry, Retracted, RetractRequest } from "../messages.ts";
import { whoTookOut, type TakenOut } from "../timeline.ts";
import { bytes, clock, counted } from "../units.ts";

const OPERATOR = "operator";

/** Who looks, and what is known of the commit. */
export interface Looking {
  readonly mayRetract: boolean;
  /** When, by whom and why it was taken out; null: it is in the map. */
  readonly out: TakenOut | null;
  /** Show in the map what a retract would change, in words, too; null: nothing any more. */
  preview(body: RetractRequest | null): Promise<string>;
}

/** Open on one commit; closes when it is done or given up. Who may not retract only looks, and nothing is taken out twice. */
export function openCommit(api: Api, map: string, entry: LogEntry, { mayRetract, out, preview: inMap }: Looking): void {
  const robot = robotOf(entry.id);
  const isRetract = entry.cells === 0 && entry.retracts.length > 0;
  const may = mayRetract && !out && entry.kind === "+" && robot !== OPERATOR;
  const [, last] = entry.captured_s ?? [0, 0];
  const what = h(
    "select", { id: "what" },
    h("option", { value: "one" }, "this commit"),
    h("option", { value: "later", disabled: !entry.captured_s }, `this and all later ones of ${robot}`),
    h("option", { value: "all" }, `all commits of ${robot}`),
  );
  const note = h("input", { id: "note", maxlength: "1024", placeholder: "why, for those who read the log" });
  const said = h("div", { class: "said", "aria-live": "polite" });
  const preview = h("button", { type: "button" }, "Show what that takes out");
  const confirm = h("button", { type: "button", class: "danger", disabled: true }, "Take out for good");
  const close = h("button", { type: "button" }, "Close");
  const asks = [h("label", { for: "what" }, "What"), what, h("label", { for: "note" }, "Note"), note];
  const dialog = h(
    "dialog", { class: "retract", "aria-label": `Commit ${entry.id}` },
    h("h2", {}, isRetract ? "Retract by " : "Commit of ", robot),
    out && outFacts(out),
    facts([
      ["id", h("code", {}, entry.id)],
      ["log entry", String(entry.seq)],
      ["seen", entry.captured_s ? clock(last) : "unknown"],
      ["came", entry.pushed_s ? clock(entry.pushed_s) : "unknown"],
      ["size", `${bytes(entry.size_bytes)} in ${counted(entry.cells, "cell", "cells")}`],
      ["came by", entry.via ? `token ${entry.via}` : robot === OPERATOR ? "an operator" : "its robot"],
      ...(entry.note ? [["note", entry.note] as [string, string]] : []),
    ]),
    ...(isRetract ? [h("h3", {}, "It takes out"), listOf(entry.retracts)] : []),
    ...(may
      ? [
          h("h3", {}, "Take out of the map"),
          h("p", { class: "hint" }, "The map is then as if it had never been pushed, here and on every robot. It cannot be undone."),
          ...asks, said,
        ]
      : []),
    h("div", { class: "buttons" }, ...(may ? [preview, confirm] : []), close),
  );
  const request = (): RetractRequest => ({
    ...(what.value === "one" ? { commits: [entry.id] } : { robot }),
    ...(what.value === "later" && entry.captured_s ? { captured_after_s: entry.captured_s[0] } : {}),
    note: note.value,
    preview: true,
  });
  const send = async (body: RetractRequest): Promise<Retracted | null> => {
    try {
      return await api.post<Retracted>(`maps/${map}/retracts`, body);
    } catch (error) {
      confirm.disabled = true;
      fill(said, h("p", { class: "error" }, (error as Error).message));
      return null;
    }
  };
  // What is confirmed is what was shown, whatever was pushed meanwhile.
  let shown: string[] = [];
  const forget = () => {
    confirm.disabled = true;
    fill(said);
    void inMap(null);
  };
  what.addEventListener("change", forget);
  preview.addEventListener("click", async () => {
    const found = await send(request());
    if (!found) return;
    shown = found.commits;
    confirm.disabled = false;
    confirm.textContent = `Take ${found.commits.length} out for good`;
    const changes = h("p", { role: "status" }, "Looking what it changes …");
    fill(said, h("p", {}, `${counted(found.commits.length, "commit", "commits")}:`), listOf(found.commits), changes);
    stepAside(dialog);
    changes.textContent = await inMap({ commits: shown, preview: true }).catch(uncoloured);
  });
  confirm.addEventListener("click", async () => {
    confirm.disabled = preview.disabled = true;
    const done = await send({ commits: shown, note: note.value, preview: false });
    preview.disabled = false;
    void inMap(null);
    if (!done) return;
    for (const part of [...asks, preview, confirm]) part.remove();
    fill(said, h("p", { class: "done" }, `Done: ${done.commits.length} taken out by ${done.id ?? ""}. The map follows in a moment.`));
  });
  close.addEventListener("click", () => dialog.close());
  const escape = (event: KeyboardEvent) => event.key === "Escape" && dialog.close();
  document.addEventListener("keydown", escape);
  dialog.addEventListener("close", () => {
    if (dialog.open) return; // it stepped aside
    document.removeEventListener("keydown", escape);
    dialog.remove();
    if (may) void inMap(null);
  });
  document.body.append(dialog);
  dialog.showModal();
}

/** Reason for which the map shows no preview of a retract. */
function uncoloured(error: Error): string {
  if (error instanceof ApiError && error.kind === "too_large") return "It changes more voxels than the map can colour. Nothing is taken out yet.";
  return error.message;
}

/** What an operator must know first: that it is out already, and why. */
function outFacts(out: TakenOut): HTMLElement {
  const { whenS, by, note } = out;
  return h(
    "div", { class: "out" }, h("strong", {}, "Taken out of the map"),
    facts([["when", whenS === null ? "unknown" : clock(whenS)], ["by", by === null ? "unknown" : h("span", {}, whoTookOut(out), " in ", h("code", {}, by))], ["why", note || "no note"]]),
  );
}

function listOf(ids: readonly string[]): HTMLElement {
  return h("ul", {}, ...ids.map((id) => h("li", {}, h("code", {}, id))));
}

/** Let the map be seen, and turned, while it shows what would go. */
function stepAside(dialog: HTMLDialogElement): void {
  if (dialog.classList.contains("aside")) return;
  const focused = document.activeElement as HTMLElement | null;
  dialog.classList.add("aside");
  dialog.close();
  dialog.show();
  focused?.focus();
}
