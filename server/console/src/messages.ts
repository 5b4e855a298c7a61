/** The JSON that the server speaks: server/PROTOCOL.md sections 3 and 4.6. */

export interface Channel {
  kind: "colour" | "intensity" | "temperature" | "scalar" | "classes";
  name: string;
  unit: string;
  step: number;
  zero: number;
  /** Names of the classes that it counts, the last one `other`; of the kind `classes` alone. */
  classes?: string[];
}

/** Grid of a map. */
export interface Geometry {
  voxel_edge_um: number;
  depth: number;
  channels: Channel[];
  /** Height of a flat voxel: the map is a level. Left out: voxels are cubes. */
  height_step_um?: number;
}

export type Triple = [number, number, number];

export interface MapInfo {
  name: string;
  geometry: Geometry;
  sensor_model: { p_hit: number; p_miss: number; p_min: number; p_max: number; p_occupied: number };
  cursor: string;
  cells: number;
  size_bytes: number;
  commits: number;
  branches: number;
  box_m: [Triple, Triple] | null;
  /** Left out: the map is one sum for all times. */
  epoch_s?: number;
}

export interface CellEntry {
  cell: Triple;
  size_bytes: number;
  digest: string;
  lm: number;
  voxels: number;
  /** Asked for: newest entry whose evidence is still in it; null: not known. */
  held_lm?: number | null;
}

export interface CellIndex {
  header: { to: string };
  cells: CellEntry[];
}

export interface Pose {
  time_s: number;
  t_map_rig: Triple;
  q_map_rig: [number, number, number, number];
  sigma_m?: number;
  sigma_rad?: number;
}

export interface RobotStatus {
  time_s: number;
  pose: Pose | null;
  mode: string | null;
  waiting: number;
  waiting_bytes: number;
  battery: number | null;
  note: string;
}

export interface RobotSign {
  branch: string;
  mode: string;
  time_s: number;
  cursor: string | null;
  status: RobotStatus | null;
  view_s: number | null;
  gone: boolean;
}

export interface Branch {
  branch: string;
  mode: string;
  sensors: string[];
  cursor: string | null;
  behind: number | null;
  behind_bytes: number | null;
  last_seen_s: number;
  status: RobotStatus | null;
  view_s: number | null;
}

export interface LogEntry {
  seq: number;
  kind: "+" | "-";
  id: string;
  size_bytes: number;
  cells: number;
  captured_s: [number, number] | null;
  retracts: string[];
  place_m: Triple | null;
  via: string | null;
  /** Of its author. */
  note?: string;
  /** When the server received it. */
  pushed_s?: number;
}

export interface RetractRequest {
  commits?: string[];
  robot?: string;
  captured_after_s?: number;
  captured_before_s?: number;
  note?: string;
  preview: boolean;
}

export interface Retracted {
  id: string | null;
  commits: string[];
}

export interface ExportTicket {
  ticket: string;
  points: number;
  size_bytes: number | null;
}

export type LiveEvent =
  | { type: "hello"; id: string; map: string; cursor: string; resumed: boolean; robots: RobotSign[]; beat_s: number }
  | { type: "cells"; id: string; cells: [number, number, number, number][] | "many" }
  | { type: "marks"; id: string; marks: MarkEntry[] | "many"; removed: string[] }
  | { type: "log"; id: string; entries: LogEntry[]; left_out: number }
  | { type: "head"; id: string; cursor: string }
  | { type: "robot"; id: string; robot: RobotSign }
  | { type: "beat"; id: string; time_s: number };

/** Keys that robots' names are bound to, and robots that were refused for theirs: PROTOCOL.md section 4.11. */
export interface RobotKeys {
  admitted: { author: string; since_s: number; by: string; may_return: boolean }[];
  asking: AskingRobot[];
}

export interface AskingRobot {
  /** `robot.key`: 16 hex digits stand for the key. */
  author: string;
  since_s: number;
  asked_s: number;
  by: string;
}

/** What a robot uses of its shares of the map's bounds; null: the reserve. */
export interface RobotUse {
  robot: string | null;
  incarnations: number;
  intervals: number;
  used: Record<string, number>;
}

export interface RobotClosed {
  robot: string;
  incarnations: number;
  intervals: number;
}

/** Connected voxels above a temperature: PROTOCOL.md section 4.15. */
export interface HotSpot {
  voxel: Triple;
  point_m: Triple;
  celsius: number;
  sigma: number;
  weight: number;
  hits: number;
  misses: number;
  confirmed: boolean;
  voxels: number;
  low_m: Triple;
  high_m: Triple;
  over_floor_m: number | null;
  measured_s?: number;
  commit: string | null;
  captured_s: [number, number] | null;
}

export interface HotSpots {
  cursor: string;
  complete: boolean;
  total: number;
  spots: HotSpot[];
}

/** A place with a name, as its author wrote it: PROTOCOL.md section 4.17; what equals its default may be left out. */
export interface Mark {
  kind: string;
  name: string;
  place_mm: Triple;
  extent_mm?: Triple;
  note?: string;
  time_ms: number;
  by?: string;
  /** Size and digest of a file, which the page passes on as it is. */
  attachment?: unknown;
}

export interface MarkEntry {
  /** `robot.incarnation.n:number` */
  key: string;
  mark: Mark;
  amends?: string[];
}

export interface MarkPage {
  cursor: string;
  from_start: boolean;
  more: boolean;
  marks: MarkEntry[];
  removed: string[];
}

/** A mark as a person states it; the server adds who and when. */
export interface MarkText {
  kind: string;
  name: string;
  place_m: Triple;
  extent_m?: Triple;
  note?: string;
  attachment?: unknown;
}
