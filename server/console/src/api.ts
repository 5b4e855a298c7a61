/** Requests to the one server that this page came from, with the token that the operator gave. */

import type { CellEntry, CellIndex, Triple } from "./messages.ts";
import { noteServerDate, noteTrust } from "./server_time.ts";

const TOKEN_KEY = "cairn.token";
export const INDEX_PAGE = 10_000;

/** What the server refused, in its own words; `kind` is the code of PROTOCOL.md section 5. */
export class ApiError extends Error {
  readonly status: number;
  readonly kind: string;

  constructor(status: number, kind: string, message: string) {
    super(message);
    this.status = status;
    this.kind = kind;
  }

  get wantsToken(): boolean {
    return this.status === 401;
  }
}

export interface CellAnswer {
  /** null: as it was. */
  readonly data: Uint8Array | null;
  readonly etag: string;
}

/** Views of many cells, by their numbers, all at one octree depth. */
export interface ReadyViews {
  readonly depth: number;
  readonly cells: Map<string, CellAnswer>;
}

export const NONE_READY: ReadyViews = { depth: 0, cells: new Map() };
/** A link that brings them no sooner shows more with each cell by itself, the largest first. */
const READY_MS = 1500;

export class Api {
  token: string | null = sessionStorage.getItem(TOKEN_KEY) ?? localStorage.getItem(TOKEN_KEY);
  /** Bytes of answers' bodies, for the figures at the foot of the page. */
  received = 0;

  /** Keep the token for this tab, or on this computer. */
  logIn(token: string, stays: boolean): void {
    this.token = token;
    (stays ? localStorage : sessionStorage).setItem(TOKEN_KEY, token);
  }

  logOut(): void {
    this.token = null;
    sessionStorage.removeItem(TOKEN_KEY);
    localStorage.removeItem(TOKEN_KEY);
  }

  async json<T>(path: string): Promise<T> {
    return (await this.ask(path)).json() as Promise<T>;
  }

  async post<T>(path: string, body: unknown): Promise<T> {
    const headers = { "Content-Type": "application/json" };
    return (await this.ask(path, { method: "POST", body: JSON.stringify(body), headers })).json() as Promise<T>;
  }

  /** All cells that were ever touched, and the state that the first page is of; `besides`: more to ask of each. */
  async cells(map: string, besides = ""): Promise<{ cursor: string; entries: CellEntry[] }> {
    const entries: CellEntry[] = [];
    let cursor: string | null = null;
    for (let after = ""; ; ) {
      const page = await this.json<CellIndex>(`maps/${map}/main/cells?limit=${INDEX_PAGE}${besides}${after}`);
      cursor ??= page.header.to;
      entries.push(...page.cells);
      if (page.cells.length < INDEX_PAGE) return { cursor, entries };
      after = `&after=${page.cells[page.cells.length - 1].cell.join(",")}`;
    }
  }

  /** What one cell looks like at an octree depth, or looked at a time, if it is not what `etag` names. */
  async view(map: string, cell: string, depth: number, { etag, atS }: { etag: string | null; atS: number | null }): Promise<CellAnswer> {
    const headers: Record<string, string> = etag ? { "If-None-Match": etag } : {};
    const at = atS === null ? "" : `&at=${atS}`;
    const answer = await this.ask(`maps/${map}/main/cells/${cell}.view?depth=${depth}${at}`, { headers, cache: "no-store" });
    const data = answer.status === 304 ? null : new Uint8Array(await answer.arrayBuffer());
    this.received += data?.length ?? 0;
    return { data, etag: answer.headers.get("ETag") ?? "" };
  }

  /** What the server has ready of all cells, if that comes soon: PROTOCOL.md section 4.3. */
  async readyViews(map: string): Promise<ReadyViews> {
    const answer = await this.ask(`maps/${map}/main/views`, { cache: "no-store", signal: AbortSignal.timeout(READY_MS) });
    const body = new Uint8Array(await answer.arrayBuffer());
    this.received += body.length;
    const cells = new Map<string, CellAnswer>();
    const numbers = new DataView(body.buffer);
    let at = 0;
    const next = () => {
      const begin = at + 4;
      at = begin + numbers.getUint32(at, true);
      return body.slice(begin, at);
    };
    while (at < body.length) {
      const { cell, etag } = JSON.parse(new TextDecoder().decode(next())) as { cell: Triple; etag: string };
      cells.set(cell.join(","), { data: next(), etag });
    }
    return { depth: Number(answer.headers.get("Cairn-View-Depth")), cells };
  }

  async ask(path: string, options: RequestInit = {}): Promise<Response> {
    const headers = new Headers(options.headers);
    // A client of maps with epochs hears the server's time, too, while the server trusts it, and one of layers their names.
    headers.set("Cairn-Format", "5");
    if (this.token) headers.set("Authorization", `Bearer ${this.token}`);
    let answer: Response;
    try {
      answer = await fetch(path, { ...options, headers });
    } catch {
      throw new ApiError(0, "unreachable", "The server does not answer. The page goes on by itself when it does.");
    }
    noteServerDate(answer.headers.get("Date"));
    if (answer.ok) noteTrust(answer.headers.get("Cairn-Time"));
    if (answer.ok || answer.status === 304) return answer;
    const problem = (await answer.json().catch(() => ({}))) as { kind?: string; detail?: string };
    throw new ApiError(answer.status, problem.kind ?? "unknown", problem.detail ?? answer.statusText);
  }
}
