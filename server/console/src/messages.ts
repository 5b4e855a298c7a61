/** The JSON that the server speaks: server/PROTOCOL.md sections 3 and 4.6. */

export interface Channel {
  kind: "colour" | "intensity" | "temperature" | "scalar";
  name: string;
  unit: string;
  step: number;
  zero: number;
}

export type Triple = [number, number, number];

export interface MapInfo {
  name: string;
  geometry: { voxel_edge_um: number; depth: number; channels: Channel[] };
  sensor_model: { p_hit: number; p_miss: number; p_min: number; p_max: number; p_occupied: number };
  cursor: string;
  cells: number;
  size_bytes: number;
  commits: number;
  branches: number;
  box_m: [Triple, Triple] | null;
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
