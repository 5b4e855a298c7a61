/** The list of findings: where each is, who says so, and what an operator may do about it. */

import { attachmentOf, type Attachments } from "../attachments.ts";
import { fill, h } from "../dom.ts";
import { factsOf, type Finding } from "../findings.ts";
import type { Mark } from "../messages.ts";

/** Rows of the list; more are in the files. */
const ROWS_MAX = 100;
/** Twice the width that it is shown in. */
const PICTURE_PX = 400;
const STATES: Record<Finding["state"], string> = { new: "new", seen: "seen", dismissed: "dismissed", mark: "mark" };

export interface FindingsShown {
  readonly findings: readonly Finding[];
  /** Chosen finding. */
  readonly chosen: string | null;
  readonly isOperator: boolean;
  readonly isMarking: boolean;
  /** What is to be said of the list; empty: nothing. */
  readonly said: string;
}

export type Act = "seen" | "dismiss" | "again" | "mark" | "edit" | "remove" | "link";

export class FindingsPanel {
  readonly element = h("section", { class: "findings", "aria-label": "Findings" });
  onFly: (id: string) => void = () => {};
  onAct: (act: Act, id: string) => void = () => {};
  onMarking: () => void = () => {};
  onThreshold: (overC: number) => void = () => {};
  onReport: () => void = () => {};
  onFile: (form: "csv" | "geojson") => void = () => {};
  private readonly head = h("h2", {});
  private readonly list = h("ol", { class: "finds" });
  private readonly said = h("p", { class: "hint", role: "status" });
  private readonly marking = h("button", { type: "button", "aria-pressed": "false", title: "The next click on the map names a place (N)" }, "Mark place");
  private readonly all = h("input", { type: "checkbox" });
  private readonly over: HTMLInputElement;
  private last: FindingsShown | null = null;
  private written = "";

  private readonly attachments: Attachments;

  constructor(overC: number, alarm: HTMLElement, attachments: Attachments) {
    this.attachments = attachments;
    this.over = h("input", { type: "number", step: "1", value: String(overC), "aria-label": "Hot spots from, in degrees Celsius" });
    this.over.addEventListener("change", () => {
      if (Number.isFinite(this.over.valueAsNumber)) this.onThreshold(this.over.valueAsNumber);
      else this.over.value = String(overC);
    });
    this.marking.addEventListener("click", () => this.onMarking());
    this.all.addEventListener("change", () => this.last && this.show(this.last));
    const file = (form: "csv" | "geojson", name: string) =>
      h("button", { type: "button", title: "All findings, in metres of the map", onclick: () => this.onFile(form) }, name);
    const report = h("button", { type: "button", title: "Plans, findings, pictures and what proves them, to be printed", onclick: () => this.onReport() }, "Report");
    fill(
      this.element, this.head, this.list, this.said,
      h("div", { class: "buttons" }, this.marking, file("csv", "CSV"), file("geojson", "GeoJSON"), report),
      h("details", {}, h("summary", {}, "What counts, and alarm"),
        h("label", { class: "over" }, "Hot spots from ", this.over, " °C"),
        h("label", { class: "check" }, this.all, "Show dismissed"), alarm),
    );
  }

  show(shown: FindingsShown): void {
    this.last = shown;
    const { findings, isOperator, isMarking, said } = shown;
    const rows = findings.filter(({ state }) => this.all.checked || state !== "dismissed");
    const written = JSON.stringify([rows.slice(0, ROWS_MAX), rows.length, shown.chosen, isOperator, isMarking, said, findings.length]);
    // A button is not replaced between press and release, which would be no click.
    if (written === this.written || this.list.querySelector("button:active")) return;
    this.written = written;
    const fresh = findings.filter(({ state }) => state === "new").length;
    fill(this.head, fresh ? `Findings, ${fresh} new` : "Findings");
    const active = (document.activeElement as HTMLElement | null)?.dataset.find;
    fill(this.list, ...rows.slice(0, ROWS_MAX).map((one) => this.row(one, shown)));
    if (active) this.list.querySelector<HTMLElement>(`[data-find="${CSS.escape(active)}"]`)?.focus();
    const dismissed = findings.length - rows.length;
    const words = [
      said, rows.length ? "" : "No hot spots, and no marks.",
      rows.length > ROWS_MAX ? `${rows.length - ROWS_MAX} more are in the files.` : "", dismissed ? `${dismissed} dismissed.` : "",
      isMarking ? "Click the place on the map; Escape stops." : "",
    ];
    this.said.textContent = words.filter(Boolean).join(" ");
    this.marking.hidden = !isOperator;
    this.marking.setAttribute("aria-pressed", String(isMarking));
  }

  private row(one: Finding, { chosen, isOperator }: FindingsShown): HTMLElement {
    const { id, number, state, title, celsius, entry, spot } = one;
    const overM = spot?.over_floor_m ?? null;
    const isChosen = id === chosen;
    const button = h(
      "button",
      { type: "button", class: "find", "data-find": id, "aria-pressed": String(isChosen), title: number < 10 ? `Fly there (${number})` : "Fly there", onclick: () => this.onFly(id) },
      h("b", { class: "no" }, String(number)), h("strong", {}, celsius === null ? title : `${celsius.toFixed(1)} °C`),
      overM === null ? null : h("span", { class: "hint", title: "Height over the floor" }, `at ${overM.toFixed(1)} m`), h("span", { class: "state", "data-state": state }, STATES[state]),
    );
    if (!isChosen) return h("li", {}, button);
    const act = (what: Act, name: string) => h("button", { type: "button", "data-find": `${what} ${id}`, onclick: () => this.onAct(what, id) }, name);
    const link = act("link", "Link");
    const acts = !isOperator ? []
      : state === "mark" ? [act("edit", "Edit …"), act("remove", "Take out")]
      : [
          ...(state === "seen" ? [] : [act("seen", "Seen")]), ...(state === "dismissed" ? [] : [act("dismiss", "Dismiss")]),
          ...(state === "new" ? [] : [act("again", "Make new again")]), act("mark", "Mark …"),
        ];
    return h(
      "li", {}, button,
      celsius !== null && state === "mark" ? h("p", {}, title) : null, h("p", { class: "hint" }, factsOf(one)),
      entry?.mark.note ? h("p", { class: "note" }, entry.mark.note) : null,
      entry && state === "mark" && attachmentOf(entry.mark) ? this.picture(entry.mark) : null, h("div", { class: "buttons" }, ...acts, link),
    );
  }

  /** The picture of a mark, once it is there; until then, and if it cannot be shown, words. */
  private picture(mark: Mark): HTMLElement {
    const place = h("figure", { class: "attached" }, h("p", { class: "hint" }, "The picture is on its way …"));
    this.attachments.picture(mark, PICTURE_PX).then(
      (picture) => fill(place, picture),
      (error: unknown) => fill(place, h("p", { class: "hint" }, (error as Error).message)),
    );
    return place;
  }
}
