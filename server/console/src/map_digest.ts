/** Digest of a whole map in one state: what a report states, so that anyone who has the map may prove later what it was made of. */

import type { Api } from "./api.ts";
import type { CellEntry, MapInfo } from "./messages.ts";
import { sha256 } from "./sha256.ts";

const TRIES = 3;

export interface MapDigest {
  readonly cursor: string;
  /** null: the map changed while it was read. */
  readonly digest: string | null;
  readonly cells: number;
  /** Commits at the cursor. */
  readonly commits: number;
}

/** SHA-256 over a line of each cell, in the order of the index: its number and its own digest. */
export function digestOf(cells: readonly Pick<CellEntry, "cell" | "digest">[]): string {
  return sha256(new TextEncoder().encode(cells.map(({ cell, digest }) => `${cell.join(",")} ${digest}\n`).join("")));
}

/** The digest of the map's newest state: an index of many pages counts only if nothing came meanwhile. */
export async function digestOfMap(api: Api, map: string): Promise<MapDigest> {
  for (let left = TRIES; ; left--) {
    const { cursor, entries } = await api.cells(map);
    const { cursor: after, commits } = await api.json<MapInfo>(`maps/${map}`);
    if (after === cursor) return { cursor, digest: digestOf(entries), cells: entries.length, commits };
    if (left === 1) return { cursor: after, digest: null, cells: entries.length, commits };
  }
}
