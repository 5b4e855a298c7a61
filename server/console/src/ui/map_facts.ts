/** What the map is made of, and the zone in which its times are told. */

import { h } from "../dom.ts";
import type { MapInfo } from "../messages.ts";
import { metres } from "../units.ts";
import { pageZone, setPageZone, zoneNames } from "../zone.ts";

export function mapFacts({ geometry, sensor_model }: MapInfo): HTMLElement {
  const edge = geometry.voxel_edge_um / 1e6;
  const lines = [
    `voxels of ${metres(edge)}${geometry.height_step_um === undefined ? "" : ` and ${metres(geometry.height_step_um / 1e6)} height`}`,
    `cells of ${metres(edge * 2 ** geometry.depth)}`,
    `shown: p above ${sensor_model.p_occupied}`,
    geometry.channels.map(({ name }) => name).join(", ") || "no channels",
  ];
  const zones = h("select", {}, ...zoneNames().map((name) => h("option", { value: name, selected: name === pageZone().name }, name)));
  zones.addEventListener("change", () => {
    setPageZone(zones.value);
    location.reload(); // all that is written is written again; the address keeps the view
  });
  return h(
    "section", { class: "map-facts", "aria-label": "Map" }, h("h2", {}, "Map"), ...lines.map((line) => h("p", { class: "hint" }, line)),
    h("label", { class: "hint" }, "times in ", zones),
  );
}
