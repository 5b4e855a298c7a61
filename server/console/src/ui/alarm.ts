/** The alarm for hot spots that no person has seen: a banner, the window's title, and a sound for those who want one. */

import { fill, h } from "../dom.ts";
import type { Finding } from "../findings.ts";

const KEPT = "cairn.alarm";
const TONE_HZ = 880;
const TONE_S = 0.35;

export class Alarm {
  /** Its settings. */
  readonly element: HTMLElement;
  readonly banner = h("div", { class: "alarm", role: "alert", hidden: true });
  onFly: (id: string) => void = () => {};
  /** Spots that are quiet on this screen; on all screens they are once an operator has seen them. */
  private readonly quiet = new Set<string>();
  private readonly rung = new Set<string>();
  private readonly from = h("input", { type: "number", step: "1", placeholder: "off", "aria-label": "Alarm from, in degrees Celsius; empty: off" });
  private readonly sound = h("input", { type: "checkbox" });
  private readonly title: string;
  private findings: readonly Finding[] = [];
  private shown = "";
  private audio: AudioContext | null = null;

  constructor() {
    this.title = document.title;
    const { from, sound } = JSON.parse(localStorage.getItem(KEPT) ?? "{}") as { from?: number | null; sound?: boolean };
    this.from.value = from == null ? "" : String(from);
    this.sound.checked = sound === true;
    for (const input of [this.from, this.sound]) {
      input.addEventListener("change", () => {
        localStorage.setItem(KEPT, JSON.stringify({ from: this.fromC, sound: this.sound.checked }));
        // Browsers let a page sound only after a person did something on it.
        if (this.sound.checked) this.ring();
        this.show(this.findings);
      });
    }
    this.element = h(
      "div", { class: "alarm-set" }, h("label", { class: "over" }, "Alarm from ", this.from, " °C"),
      h("label", { class: "check" }, this.sound, "Sound"),
    );
  }

  /** Ring for those that are new and warm enough, each once. */
  show(findings: readonly Finding[]): void {
    this.findings = findings;
    const { fromC } = this;
    const hot = fromC === null ? [] : findings.filter(({ id, state, celsius }) => state === "new" && celsius !== null && celsius >= fromC && !this.quiet.has(id));
    if (hot.some(({ id }) => !this.rung.has(id)) && this.sound.checked) this.ring();
    for (const { id } of hot) this.rung.add(id);
    document.title = hot.length ? `⚠ ${hot[0].celsius!.toFixed(0)} °C · ${this.title}` : this.title;
    const state = JSON.stringify(hot.map(({ id, celsius }) => [id, celsius]));
    if (state === this.shown) return;
    this.shown = state;
    this.banner.hidden = !hot.length;
    if (!hot.length) return;
    const [first] = hot;
    const more = hot.length > 1 ? ` and ${hot.length - 1} more` : "";
    fill(
      this.banner, h("strong", {}, `⚠ ${first.celsius!.toFixed(1)} °C`), h("span", {}, `finding ${first.number}${more}, not seen yet`),
      h("button", { type: "button", onclick: () => this.onFly(first.id) }, "Show"),
      h("button", { type: "button", title: "On this screen", onclick: () => this.silence(hot) }, "Quiet"),
    );
  }

  close(): void {
    document.title = this.title;
    void this.audio?.close();
  }

  private silence(hot: readonly Finding[]): void {
    for (const { id } of hot) this.quiet.add(id);
    this.show(this.findings);
  }

  private get fromC(): number | null {
    return Number.isFinite(this.from.valueAsNumber) ? this.from.valueAsNumber : null;
  }

  private ring(): void {
    this.audio ??= new AudioContext();
    void this.audio.resume();
    const tone = this.audio.createOscillator();
    const loud = this.audio.createGain();
    loud.gain.value = 0.2;
    tone.frequency.value = TONE_HZ;
    tone.connect(loud).connect(this.audio.destination);
    tone.start();
    tone.stop(this.audio.currentTime + TONE_S);
  }
}
