/** Layers of a map as the page names them: MAP.LAYER in paths, and what kind of layer each is. */

import type { Channel, Geometry, MapInfo, Triple } from "./messages.ts";
import { metres } from "./units.ts";

/** The layer that a map begins with, which has no name in paths. */
const FIRST = "evidence";

/** Map that a layer is of. */
export function mapOf(name: string): string {
  return name.split(".")[0]!;
}

/** A layer's name, the size of its voxels, and what it holds, for a list of them. */
export function layerText({ name, geometry }: MapInfo): string {
  const layer = name.slice(mapOf(name).length + 1) || FIRST;
  const edge = metres(geometry.voxel_edge_um / 1e6);
  if (geometry.height_step_um !== undefined) return `${layer}: level, ${edge}`;
  const count = classesOf(geometry.channels).length;
  return count ? `${layer}: ${count} classes, ${edge}` : `${layer}: ${edge}`;
}

/** Size of a voxel, m. */
export function voxelSizeOf({ voxel_edge_um, height_step_um }: Geometry): Triple {
  return [voxel_edge_um / 1e6, voxel_edge_um / 1e6, (height_step_um ?? voxel_edge_um) / 1e6];
}

/** Names of the classes in whose colours a map is drawn: it counts them, and has no colour camera. */
export function classesOf(channels: readonly Channel[]): readonly string[] {
  if (channels.some(({ kind }) => kind === "colour")) return [];
  return channels.find(({ kind }) => kind === "classes")?.classes ?? [];
}
