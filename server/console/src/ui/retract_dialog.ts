/** Taking commits out again: what, then what that would name, then for good. */

import type { Api } from "../api.ts";
import { facts, fill, h } from "../dom.ts";
import { robotOf } from "../log_book.ts";
import type { LogEntry, Retracted, RetractRequest } from "../messages.ts";
import { bytes, clock } from "../units.ts";

/** Open on one commit; closes when it is done or given up. Who may not retract only looks. */
export function openCommit(api: Api, map: string, entry: LogEntry, mayRetract: boolean): void {
  const robot = robotOf(entry.id);
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
  const dialog = h(
    "dialog", { class: "retract", "aria-label": `Commit ${entry.id}` },
    h("h2", {}, "Commit of ", robot),
    facts([
      ["id", h("code", {}, entry.id)],
      ["log entry", String(entry.seq)],
      ["seen", entry.captured_s ? clock(last) : "unknown"],
      ["size", `${bytes(entry.size_bytes)} in ${entry.cells} cells`],
      ["came by", entry.via ?? "its robot"],
    ]),
    ...(mayRetract
      ? [
          h("h3", {}, "Take out of the map"),
          h("p", { class: "hint" }, "The map is then as if it had never been pushed, here and on every robot. It cannot be undone."),
          h("label", { for: "what" }, "What"), what,
          h("label", { for: "note" }, "Note"), note, said,
        ]
      : []),
    h("div", { class: "buttons" }, ...(mayRetract ? [preview, confirm] : []), close),
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
  what.addEventListener("change", () => {
    confirm.disabled = true;
    fill(said);
  });
  preview.addEventListener("click", async () => {
    const found = await send(request());
    if (!found) return;
    shown = found.commits;
    confirm.disabled = false;
    confirm.textContent = `Take ${found.commits.length} out for good`;
    fill(said, h("p", {}, `${found.commits.length} commit${found.commits.length === 1 ? "" : "s"}:`), h("ul", {}, ...found.commits.map((id) => h("li", {}, h("code", {}, id)))));
  });
  confirm.addEventListener("click", async () => {
    confirm.disabled = preview.disabled = true;
    const done = await send({ commits: shown, note: note.value, preview: false });
    if (done) fill(said, h("p", { class: "done" }, `Done: ${done.commits.length} taken out by ${done.id ?? ""}. The map follows in a moment.`));
  });
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}
