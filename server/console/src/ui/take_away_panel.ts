/** What is shown as a file, made by the server, and the lines that fetch the same in a terminal or in Python. */

import type { Api } from "../api.ts";
import { fill, h } from "../dom.ts";
import type { Look } from "../look.ts";
import type { ExportTicket, MapInfo } from "../messages.ts";
import { bytes, KELVIN_ZERO_C, metres, thousands } from "../units.ts";

const FORMS: [string, string, string][] = [
  ["ply", "PLY", "points for CloudCompare, MeshLab, Blender"],
  ["pcd", "PCD", "points for PCL, Open3D, ROS"],
  ["laz", "LAZ", "points for CloudCompare, PDAL, Potree and GIS, a fifth of the size"],
  ["npz", "NPZ", "one array of records for NumPy"],
  ["ot", "OctoMap .ot", "OctoMap's octree of occupied and free space, with probability and colour"],
  ["bt", "OctoMap .bt", "OctoMap's octree of occupied and free space, small"],
];
const OCTREES = ["ot", "bt"];

export class TakeAwayPanel {
  readonly element = h("section", { "aria-label": "Take away" });
  private readonly api: Api;
  private readonly info: MapInfo;
  private readonly look: Look;
  private readonly level = h("select", { "aria-label": "Level" });
  private readonly parts = h("p", { class: "hint" });
  private readonly said = h("p", { role: "status" });
  private readonly lines = h("div", {});
  private readonly octree = h("div", { class: "buttons" });
  private written = "";

  constructor(api: Api, info: MapInfo, look: Look) {
    this.api = api;
    this.info = info;
    this.look = look;
    const { depth, voxel_edge_um, height_step_um } = info.geometry;
    for (let n = depth; n >= Math.max(1, depth - 4); n--) {
      this.level.append(h("option", { value: String(n) }, `${n === depth ? "voxels" : "nodes"} of ${metres((voxel_edge_um / 1e6) * 2 ** (depth - n))}`));
    }
    this.level.addEventListener("change", () => this.show());
    // An octree has cubes.
    const forms = height_step_um === undefined ? FORMS : FORMS.filter(([form]) => !OCTREES.includes(form));
    const buttons = forms.map(([form, name, what]) =>
      h("button", { type: "button", title: what, onclick: (event: Event) => void this.save(event, () => this.part(form)) }, name),
    );
    fill(
      this.element,
      h("h2", {}, "Take away what is shown"), this.parts,
      h("div", { class: "buttons" }, this.level, ...buttons), this.said,
      h("p", { class: "hint" }, "The same in a terminal, or in Python; your token in the variable CAIRN_TOKEN:"), this.lines, this.octree,
    );
    this.choose(null);
    this.show();
  }

  /** The cell that was clicked: its exact evidence, as robots hold it. */
  choose(cell: string | null): void {
    fill(
      this.octree,
      cell === null
        ? h("span", { class: "hint" }, "Click the map for the octree of the cell there.")
        : h(
            "button", { type: "button", title: "exact evidence, as robots hold it", onclick: (event: Event) => void this.save(event, () => this.cell(cell)) },
            `Octree of cell ${cell}`,
          ),
    );
  }

  /** As the look is now. */
  show(): void {
    const asked = this.asked();
    const text = JSON.stringify(asked);
    if (text === this.written) return;
    this.written = text;
    const words = [
      asked.box ? "in the box" : "", asked.floor_m !== undefined ? `from ${metres(asked.floor_m)}` : "",
      asked.ceiling_m !== undefined ? `to ${metres(asked.ceiling_m)}` : "", asked.p ? `p at least ${asked.p}` : "",
      this.look.band ? bandText(this.look.band) : "",
    ].filter(Boolean);
    this.parts.textContent = words.length ? `Occupied, ${words.join(", ")}.` : "All that is occupied.";
    const { name } = this.info;
    const server = new URL(`maps/${name}`, document.baseURI).href;
    const option = (key: string, value: string | number) => key.endsWith("_k") ? ` --${key.slice(0, -2)}=${celsius(Number(value))}` : ` --${key.replace("_m", "")}=${value}`;
    const options = Object.entries(asked).map(([key, value]) => option(key, value)).join("");
    const fields = ["format=\"ply\"", ...Object.entries(asked).map(([key, value]) => `${key}=${JSON.stringify(value)}`)].join(", ");
    const origin = new URL(".", document.baseURI).href.replace(/\/$/, "");
    fill(
      this.lines,
      copied(`cairn map export ${server} --ply ${name}.ply${options}`),
      copied(
        "import os\nfrom pathlib import Path\n\nfrom cairn_client.http.api import MapApi\nfrom cairn_client.cli.maps.map_export import export_points\n" +
          "from cairn_map.files.export_request import ExportRequest\n\n" +
          `api = MapApi("${origin}", token=os.environ.get("CAIRN_TOKEN"))\n` +
          `export_points(api, "${name}", ExportRequest(${fields}), Path("${name}.ply"))`,
      ),
    );
  }

  private asked(): { box?: string; floor_m?: number; ceiling_m?: number; p?: number; hotter_k?: number; colder_k?: number; depth?: number } {
    const { clip, floorM, ceilingM, minP, band } = this.look;
    const depth = Number(this.level.value);
    return {
      ...(clip ? { box: clip.flat().join(",") } : {}),
      ...(floorM !== null ? { floor_m: floorM } : {}), ...(ceilingM !== null ? { ceiling_m: ceilingM } : {}),
      ...(minP > 0 ? { p: minP } : {}), ...(band ? { hotter_k: kelvin(band[0]) } : {}), ...(band && band[1] !== null ? { colder_k: kelvin(band[1]) } : {}),
      ...(depth < this.info.geometry.depth ? { depth } : {}),
    };
  }

  /** What is shown: the browser saves it as it comes, from a link with a ticket, so that no part of it is in the page. */
  private async part(form: string): Promise<string> {
    const path = `maps/${this.info.name}/main/export`;
    const file = `${this.info.name}.${form}`;
    const asked = { ...this.asked(), format: form };
    const { ticket, points, size_bytes } = await this.api.post<ExportTicket>(`${path}/tickets`, asked);
    const query = new URLSearchParams(Object.entries({ ...asked, ticket }).map(([key, value]) => [key, String(value)]));
    h("a", { href: `${path}?${query.toString()}`, download: file }).click();
    return `${file}: ${thousands(points)} points${size_bytes === null ? "" : `, ${bytes(size_bytes)}`}`;
  }

  /** One cell's bytes: few enough to be fetched by the page. */
  private async cell(cell: string): Promise<string> {
    const { name } = this.info;
    const blob = await (await this.api.ask(`maps/${name}/main/cells/${cell}`)).blob();
    const file = `${name}_${cell}.cairn`;
    const url = URL.createObjectURL(blob);
    h("a", { href: url, download: file }).click();
    window.setTimeout(() => URL.revokeObjectURL(url), 60_000);
    return `${file}: ${bytes(blob.size)}`;
  }

  private async save(event: Event, fetched: () => Promise<string>): Promise<void> {
    const button = event.currentTarget as HTMLButtonElement;
    button.disabled = true;
    this.said.className = "hint";
    const startMs = performance.now();
    const tell = () => (this.said.textContent = `The server makes the file … ${Math.round((performance.now() - startMs) / 1000)} s`);
    tell();
    const timer = window.setInterval(tell, 1000);
    try {
      const done = await fetched();
      window.clearInterval(timer);
      this.said.textContent = done;
    } catch (error) {
      this.said.className = "error";
      this.said.textContent = (error as Error).message;
    } finally {
      window.clearInterval(timer);
      button.disabled = false;
    }
  }
}

/** Of degrees Celsius, to a hundredth: as fine as temperatures are told. */
const kelvin = (value: number) => Math.max(0, Math.round((value + KELVIN_ZERO_C) * 100) / 100);
const celsius = (value: number) => Math.round((value - KELVIN_ZERO_C) * 100) / 100;

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

function bandText([from, to]: [number, number | null]): string {
  return to === null ? `${from} °C and more` : `${from} to ${to} °C`;
}
