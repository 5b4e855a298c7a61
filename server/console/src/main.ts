/** The operator's console: who, which map, and then the map. */

import "./style.css";
import { Api, ApiError } from "./api.ts";
import { Console } from "./console.ts";
import { fill } from "./dom.ts";
import { FIELDS, fromHash } from "./look.ts";
import type { MapInfo } from "./messages.ts";
import { hasWebGl } from "./scene/stage.ts";
import { message, noMap, pause, unknownMap } from "./ui/dead_ends.ts";
import { listen, showKeys, type Key } from "./ui/keys.ts";
import { logIn } from "./ui/login.ts";
import { StillPictures } from "./ui/still_pictures.ts";
import { showLink } from "./ui/link_dialog.ts";
import { applyTheme, TopBar } from "./ui/top_bar.ts";

const api = new Api();
let open: Console | null = null;
/** Number of the newest start: an older one that still waits gives up. */
let starts = 0;

async function mapsOf(why: string): Promise<MapInfo[]> {
  for (;;) {
    try {
      return await api.json<MapInfo[]>("maps");
    } catch (error) {
      if (!(error instanceof ApiError)) throw error;
      if (error.wantsToken) {
        await logIn(api, api.token ? error.message : why);
        continue;
      }
      message("The server does not answer", error.message, "If it stays so, see that this computer is in the server's network, and that the server runs.");
      await pause();
    }
  }
}

/** Open what the address names; `why` is said to whoever must log in again. */
async function start(why = ""): Promise<void> {
  const mine = ++starts;
  open?.dispose();
  open = null;
  for (;;) {
    const maps = await mapsOf(why);
    if (mine !== starts) return;
    const { map } = fromHash(location.hash);
    const info = map === null ? maps.toSorted((a, b) => b.size_bytes - a.size_bytes)[0] : maps.find(({ name }) => name === map);
    if (info) return show(maps, info);
    if (map === null) noMap();
    else unknownMap(map, maps);
    await pause();
    if (mine !== starts) return;
  }
}

function show(maps: MapInfo[], info: MapInfo): void {
  const { look, camera, find } = fromHash(location.hash);
  fill(document.body);
  document.title = `${info.name} · cairn`;
  const again = (why: string) => {
    api.logOut();
    void start(why);
  };
  const goTo = (name: string) => (location.hash = `map=${name}`);
  const bar = new TopBar(maps, info, api.token !== null, { map: goTo, keys: () => showKeys(keys), share, logOut: () => again("") });
  document.body.append(bar.element);
  if (!hasWebGl()) return void document.body.append(new StillPictures(api, info).element);
  const mine = starts;
  // Many requests may be refused at once; the first one asks who is there.
  const refused = () => mine === starts && again("You are logged out: this token ended, or was revoked. With another one the page goes on where it was.");
  open = new Console(api, info, look, camera, bar, refused);
  if (camera) open.findings.choose(find);
  else if (find) open.findings.seek(find);
  if (new URLSearchParams(location.search).has("test")) Object.assign(window, { cairn: { api, console: open } });
}

function share(): void {
  const address = open?.address ?? location.href;
  history.replaceState(null, "", address);
  showLink("This very view", address);
}

const NUMBERED = ["1", "2", "3", "4", "5", "6", "7", "8", "9"];
const keys: Key[] = [
  ...FIELDS.map(({ field, label }, n) => ({ keys: [`Shift+${n + 1}`], what: `Colour by ${label.toLowerCase()}`, run: () => open?.setField(field) })),
  { keys: ["h", "f"], what: "All of the map", run: () => open?.camera.home() },
  { keys: ["t"], what: "From above", run: () => open?.camera.top() },
  { keys: ["p"], what: "Plan of the storey, or back to the map", run: () => open?.plan.switch() },
  { keys: ["w"], what: "Walk: inside, at a person's height; then a step ahead", run: () => open?.walk(0, 1) },
  { keys: ["s"], what: "Who walks: a step back", run: () => open?.walk(0, -1) },
  { keys: ["a"], what: "Who walks: a step to the left", run: () => open?.walk(-1, 0) },
  { keys: ["d"], what: "Who walks: a step to the right", run: () => open?.walk(1, 0) },
  { keys: ["x"], what: "The hottest place shown", run: () => open?.camera.hottest() },
  { keys: NUMBERED, what: "Fly to the finding of that number", run: (key) => open?.findings.flyTo(Number(key)) },
  { keys: ["n"], what: "Mark: the next click names a place", run: () => open?.findings.startMarking() },
  { keys: ["["], what: "Ceiling down 10 cm", run: () => open?.step(false) },
  { keys: ["]"], what: "Ceiling up 10 cm", run: () => open?.step(true) },
  { keys: ["c"], what: "Ceiling off or on", run: () => open?.toggleCeiling() },
  { keys: [","], what: "Back in time by one commit", run: () => open?.time.step(-1) },
  { keys: ["."], what: "On in time by one commit, at last to now", run: () => open?.time.step(1) },
  { keys: ["b"], what: "Compare two moments, or end that", run: () => open?.time.compare() },
  { keys: ["m"], what: "Measure: clicks set points", run: () => open?.measure.switch() },
  { keys: ["g"], what: "Borders of cells", run: () => open?.toggleGrid() },
  { keys: ["Enter", " "], what: "Ask what is in the middle of the picture", run: () => askMiddle() },
  { keys: ["ArrowLeft"], what: "Turn left", run: () => open?.turn(-1, 0) },
  { keys: ["ArrowRight"], what: "Turn right", run: () => open?.turn(1, 0) },
  { keys: ["ArrowUp"], what: "Turn up", run: () => open?.turn(0, -1) },
  { keys: ["ArrowDown"], what: "Turn down", run: () => open?.turn(0, 1) },
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
// A shared link that is opened where the page already is, or Back after a flight.
function follow(): void {
  const { map, look, camera, find } = fromHash(location.hash);
  if (!open || open.name !== map || !(find || camera)) return void start();
  open.take(look, camera);
  if (camera) open.findings.choose(find);
  else if (find) open.findings.seek(find);
}
window.addEventListener("hashchange", follow);
// Back right after a flight leads to the address that is still kept, which is no change of it.
window.addEventListener("popstate", () => {
  if (open?.isAt(location.href)) follow();
});
void start();
