/** A mark in words: name, kind and note, for a place that was clicked, or of a mark that is changed. */

import { fill, h } from "../dom.ts";
import type { MarkText } from "../messages.ts";

/** Kinds that are offered; any other word in the form of these may be typed. */
const KINDS = ["mark", "hot_spot", "person", "door", "danger", "machine", "note"];
const KIND = "[a-z][a-z0-9_]{0,31}";

/** Open on what the mark says at first; `save` rejects with what the server says. */
export function openMark(title: string, first: MarkText, save: (mark: MarkText) => Promise<void>): void {
  const name = h("input", { id: "mark-name", maxlength: "64", required: true, value: first.name, autofocus: true });
  const kinds = h("datalist", { id: "mark-kinds" }, ...KINDS.map((kind) => h("option", { value: kind })));
  const kind = h("input", { id: "mark-kind", required: true, pattern: KIND, value: first.kind, title: "small letters, digits and _, such as hot_spot" });
  kind.setAttribute("list", "mark-kinds");
  const note = h("textarea", { id: "mark-note", maxlength: "1024", rows: "3" }, first.note ?? "");
  const said = h("div", { class: "said", "aria-live": "polite" });
  const keep = h("button", { type: "submit" }, "Save");
  const back = h("button", { type: "button" }, "Back");
  const place = first.place_m.map((value) => value.toFixed(2)).join(", ");
  const form = h(
    "form", { method: "dialog" },
    h("p", { class: "hint" }, `At ${place} m. All who see the map will see it.`),
    h("label", { for: "mark-name" }, "Name"), name, h("label", { for: "mark-kind" }, "Kind"), kind, kinds,
    h("label", { for: "mark-note" }, "Note"), note, said, h("div", { class: "buttons" }, keep, back),
  );
  const dialog = h("dialog", { class: "mark", "aria-label": title }, h("h2", {}, title), form);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    keep.disabled = true;
    fill(said);
    save({ ...first, name: name.value.trim(), kind: kind.value, note: note.value }).then(
      () => dialog.close(),
      (error: unknown) => {
        keep.disabled = false;
        fill(said, h("p", { class: "error" }, (error as Error).message));
      },
    );
  });
  back.addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}
