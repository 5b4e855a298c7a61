/** A link to pass on, in a dialog from which it is copied. */

import { h } from "../dom.ts";
import { copied } from "./take_away_panel.ts";

export function showLink(title: string, address: string): void {
  const close = h("button", { type: "button" }, "Close");
  const dialog = h("dialog", { class: "share", "aria-label": "Share" }, h("h2", {}, title), copied(address), close);
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}
