/** Keys, and the list of them. */

import { h } from "../dom.ts";

export interface Key {
  readonly keys: readonly string[];
  readonly what: string;
  readonly run: () => void;
}

/** Keys count wherever no text is typed. */
export function listen(keys: readonly Key[]): void {
  window.addEventListener("keydown", (event) => {
    const target = event.target as HTMLElement;
    const types = target.matches("input:not([type=checkbox]):not([type=range]), select, textarea");
    // What has the focus comes first: a button is pressed, a slider moved.
    const own = event.key === "Enter" || event.key === " " ? "button, input, [role=button], pre" : "input";
    if ((event.key.length > 1 || event.key === " ") && event.key !== "Escape" && target.matches(own)) return;
    if (event.ctrlKey || event.metaKey || event.altKey || types || document.querySelector("dialog[open]")) return;
    const found = keys.find((key) => key.keys.includes(event.key));
    if (!found) return;
    event.preventDefault();
    found.run();
  });
}

export function showKeys(keys: readonly Key[]): void {
  const rows = keys.map((key) => h("tr", {}, h("th", {}, ...key.keys.map((name) => h("kbd", {}, name === " " ? "Space" : name))), h("td", {}, key.what)));
  const close = h("button", { type: "button" }, "Close");
  const dialog = h(
    "dialog", { class: "keys", "aria-label": "Keys" }, h("h2", {}, "Keys"), h("table", {}, h("tbody", {}, ...rows)),
    h("p", { class: "hint" }, "Drag turns, right drag or two fingers move, the wheel or a pinch zooms to where it points."), close,
  );
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}
