/** Keys, and the list of them. */

import { h } from "../dom.ts";

export interface Key {
  readonly keys: readonly string[];
  readonly what: string;
  readonly run: (key: string) => void;
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
    // With Shift digits are other signs, of which the keyboard's country decides.
    const name = event.shiftKey && /^Digit\d$/.test(event.code) ? `Shift+${event.code.slice(5)}` : event.key;
    const found = keys.find((key) => key.keys.includes(name));
    if (!found) return;
    event.preventDefault();
    found.run(name);
  });
}

export function showKeys(keys: readonly Key[]): void {
  const rows = keys.map((key) => h("tr", {}, h("th", {}, ...named(key.keys)), h("td", {}, key.what)));
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

/** Many keys in a row are told by the first and the last. */
function named(keys: readonly string[]): (HTMLElement | string)[] {
  const shown = keys.map((name) => h("kbd", {}, name === " " ? "Space" : name));
  return shown.length > 4 ? [shown[0], "to ", shown[shown.length - 1]] : shown;
}
