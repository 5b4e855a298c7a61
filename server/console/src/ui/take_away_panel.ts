/** Files of the cell that was clicked, and the lines that fetch all of the map in a terminal or in Python. */

import type { Api } from "../api.ts";
import { fill, h } from "../dom.ts";

const FORMS: [string, string, string][] = [
  ["", "octree", "exact evidence, as robots hold it"],
  [".ply", "PLY", "points for CloudCompare, MeshLab, Blender"],
  [".npz", "NPZ", "arrays for NumPy, free space included"],
];

export class TakeAwayPanel {
  readonly element = h("section", { "aria-label": "Take away" });
  private readonly api: Api;
  private readonly map: string;

  constructor(api: Api, map: string) {
    this.api = api;
    this.map = map;
    this.show(null);
  }

  show(cell: string | null): void {
    const origin = new URL(".", document.baseURI).href.replace(/\/$/, "");
    const server = new URL(`maps/${this.map}`, document.baseURI).href;
    const buttons = FORMS.map(([suffix, name, what]) =>
      h("button", { type: "button", title: what, onclick: (event: Event) => void this.save(cell!, suffix, event) }, name),
    );
    fill(
      this.element,
      h("h2", {}, "Take away"),
      cell === null ? h("p", { class: "hint" }, "Click the map: the cell there can be saved.") : h("div", { class: "buttons" }, h("span", {}, `cell ${cell}`), ...buttons),
      h("p", { class: "hint" }, "All of the map in a terminal, one cell in Python:"),
      copied(`cairn map export ${server} --ply ${this.map}.ply`),
      copied(`from cairn_client.api import MapApi\nMapApi("${origin}").cell("${this.map}", (${cell ?? "0,0,0"})).body  # bytes of the cell file`),
    );
  }

  private async save(cell: string, suffix: string, event: Event): Promise<void> {
    const button = event.currentTarget as HTMLButtonElement;
    button.disabled = true;
    try {
      const answer = await this.api.ask(`maps/${this.map}/main/cells/${cell}${suffix}`);
      const url = URL.createObjectURL(await answer.blob());
      const link = h("a", { href: url, download: `${this.map}_${cell}${suffix || ".cairn"}` });
      link.click();
      URL.revokeObjectURL(url);
    } catch (error) {
      this.element.append(h("p", { class: "error", role: "alert" }, (error as Error).message));
    } finally {
      button.disabled = false;
    }
  }
}

/** Text with a button that copies it; plain http has no clipboard, so there it is only selected. */
export function copied(text: string): HTMLElement {
  const shown = h("pre", { tabindex: "0" }, text);
  const button = h("button", { type: "button", class: "copy" }, "Copy");
  button.addEventListener("click", () => {
    const selection = getSelection();
    selection?.selectAllChildren(shown);
    const done = () => (button.textContent = "Copied");
    if (navigator.clipboard) void navigator.clipboard.writeText(text).then(done);
    else if (document.execCommand("copy")) done();
    else button.textContent = "Press Ctrl-C";
    window.setTimeout(() => (button.textContent = "Copy"), 2000);
  });
  return h("div", { class: "copied" }, shown, button);
}
