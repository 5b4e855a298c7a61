/** The operator's console: who, which map, and then the map. */

import "./style.css";
import { Api, ApiError } from "./api.ts";
import { Console } from "./console.ts";
import { fill, h } from "./dom.ts";
import { FIELDS, fromHash } from "./look.ts";
import type { MapInfo } from "./messages.ts";
import { listen, showKeys, type Key } from "./ui/keys.ts";
import { logIn } from "./ui/login.ts";
import { copied } from "./ui/take_away_panel.ts";
import { applyTheme, TopBar } from "./ui/top_bar.ts";

const RETRY_MS = 3000;
const api = new Api();
let open: Console | null = null;

async function mapsOf(): Promise<MapInfo[]> {
  for (;;) {
    try {
      return await api.json<MapInfo[]>("maps");
    } catch (error) {
      if (!(error instanceof ApiError)) throw error;
      if (error.wantsToken) {
        await logIn(api, api.token ? error.message : "");
        continue;
      }
      message("The server does not answer", error.message);
      await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
    }
  }
}

function message(title: string, ...lines: string[]): void {
  fill(document.body, h("main", { class: "message" }, h("h1", {}, title), ...lines.map((line) => h("p", {}, line))));
}

async function start(): Promise<void> {
  open?.dispose();
  open = null;
  const maps = await mapsOf();
  const { map, look, camera } = fromHash(location.hash);
  const info = maps.find(({ name }) => name === map) ?? maps.toSorted((a, b) => b.size_bytes - a.size_bytes)[0];
  if (!info) {
    message("No map yet", "Make one: cairn map create URL NAME. This page shows it when you reload.");
    return;
  }
  fill(document.body);
  document.title = `${info.name} · cairn`;
  const goTo = (name: string) => {
    history.replaceState(null, "", `#map=${name}`);
    void start();
  };
  const again = () => {
    api.logOut();
    void start();
  };
  const bar = new TopBar(maps, info.name, api.token !== null, { map: goTo, keys: () => showKeys(keys), share, logOut: again });
  document.body.append(bar.element);
  open = new Console(api, info, look, camera, bar, again);
  if (new URLSearchParams(location.search).has("test")) Object.assign(window, { cairn: { api, console: open } });
}

function share(): void {
  if (!open) return;
  history.replaceState(null, "", open.address);
  const close = h("button", { type: "button" }, "Close");
  const dialog = h("dialog", { class: "share", "aria-label": "Share" }, h("h2", {}, "This very view"), copied(open.address), close);
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}

const NUMBERED = ["1", "2", "3", "4", "5", "6", "7", "8", "9"];
const keys: Key[] = [
  ...FIELDS.map(({ field, label }, n) => ({ keys: [`Shift+${n + 1}`], what: `Colour by ${label.toLowerCase()}`, run: () => open?.setField(field) })),
  { keys: ["h", "f"], what: "All of the map", run: () => open?.camera.home() },
  { keys: ["t"], what: "From above", run: () => open?.camera.top() },
  { keys: ["w"], what: "Inside, at a person's height", run: () => open?.camera.walk() },
  { keys: ["x"], what: "The hottest place shown", run: () => open?.camera.hottest() },
  { keys: NUMBERED, what: "Fly to the finding of that number", run: (key) => open?.findings.flyTo(Number(key)) },
  { keys: ["n"], what: "Mark: the next click names a place", run: () => open?.findings.startMarking() },
  { keys: ["["], what: "Ceiling down 10 cm", run: () => open?.step(false) },
  { keys: ["]"], what: "Ceiling up 10 cm", run: () => open?.step(true) },
  { keys: ["m"], what: "Measure: clicks set points", run: () => open?.measure.switch() },
  { keys: ["g"], what: "Borders of cells", run: () => open?.toggleGrid() },
  { keys: ["Enter", " "], what: "Ask what is in the middle of the picture", run: () => askMiddle() },
  { keys: ["ArrowLeft"], what: "Turn left", run: () => open?.stage.turn(1, 0) },
  { keys: ["ArrowRight"], what: "Turn right", run: () => open?.stage.turn(-1, 0) },
  { keys: ["ArrowUp"], what: "Turn up", run: () => open?.stage.turn(0, -1) },
  { keys: ["ArrowDown"], what: "Turn down", run: () => open?.stage.turn(0, 1) },
  { keys: ["+"], what: "Nearer", run: () => open?.stage.nearer(0.8) },
  { keys: ["-"], what: "Farther", run: () => open?.stage.nearer(1.25) },
  { keys: ["Escape"], what: "Follow nobody, ask of nothing", run: () => open?.forget() },
  { keys: ["?"], what: "This list", run: () => showKeys(keys) },
];

function askMiddle(): void {
  if (!open) return;
  const { clientWidth, clientHeight } = open.stage.canvas;
  open.ask(clientWidth / 2, clientHeight / 2);
}

applyTheme();
listen(keys);
// A shared link that is opened where the page already is.
window.addEventListener("hashchange", () => void start());
void start();
