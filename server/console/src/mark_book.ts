/** The marks of a map as the page knows them: a set by key, kept by live events, and what operators do to it.
 *
 *     first page of all  -->  what came and what went since  -->  the same set as the server's
 *
 * A mark never moves: an edit is another mark whose commit took the old one out. */

import type { Api } from "./api.ts";
import { robotOf } from "./log_book.ts";
import type { MarkEntry, MarkPage, MarkText, Triple } from "./messages.ts";

const PAGE = 1000;
/** Marks that are kept, some 1 kB each: the server takes more of all robots together than a picture can show. */
const KEPT = 20_000;
const AGAIN_MS = 3000;

export class MarkBook {
  onChange: () => void = () => {};
  /** There are more marks than the page keeps. */
  isCut = false;
  private readonly marks = new Map<string, MarkEntry>();
  private cursor: string | null = null;
  private reading: Promise<void> | null = null;
  private again = false;
  /** Marks that events brought while a page, which may be older, was on its way. */
  private heard: (() => void)[] = [];
  private timer = 0;
  private readonly api: Api;
  private readonly map: string;

  constructor(api: Api, map: string) {
    this.api = api;
    this.map = map;
  }

  /** All marks, the newest first. */
  get all(): MarkEntry[] {
    return [...this.marks.values()].sort((a, b) => b.mark.time_ms - a.mark.time_ms || (a.key < b.key ? -1 : 1));
  }

  /** Ask for what is new, or for all; many callings make one question, and one after it. */
  refresh(): void {
    if (this.reading) {
      this.again = true;
      return;
    }
    this.reading = this.read().then(
      () => undefined,
      () => void (this.timer = window.setTimeout(() => this.refresh(), AGAIN_MS)),
    );
    void this.reading.then(() => {
      this.reading = null;
      for (const apply of this.heard.splice(0)) apply();
      this.onChange();
      if (!this.again) return;
      this.again = false;
      this.refresh();
    });
  }

  /** Marks that came, and commits whose marks went. */
  hear(marks: readonly MarkEntry[] | "many", removed: readonly string[]): void {
    if (marks === "many") return this.refresh();
    const apply = () => this.take(marks, removed);
    if (this.reading) {
      this.heard.push(apply);
      return;
    }
    apply();
    this.onChange();
  }

  /** Make a mark; with a key, put it in the place of that one. Rejects with what the server says. */
  async put(mark: MarkText, of: string | null = null): Promise<void> {
    await this.api.post(`maps/${this.map}/main/marks`, { mark, ...(of === null ? {} : { of }) });
  }

  /** Take a mark out. */
  async remove(of: string): Promise<void> {
    await this.api.post(`maps/${this.map}/main/marks`, { of });
  }

  close(): void {
    window.clearTimeout(this.timer);
    this.onChange = () => {};
  }

  private async read(): Promise<void> {
    for (let more = true; more; ) {
      const after: string = this.cursor === null ? "" : `&after=${this.cursor}`;
      const page = await this.api.json<MarkPage>(`maps/${this.map}/main/marks?limit=${PAGE}${after}`);
      if (page.from_start) this.marks.clear();
      this.take(page.marks, page.removed);
      this.cursor = page.cursor;
      more = page.more && this.marks.size < KEPT;
      this.isCut = page.more && !more;
    }
  }

  private take(marks: readonly MarkEntry[], removed: readonly string[]): void {
    const gone = new Set(removed);
    for (const key of [...this.marks.keys()]) if (gone.has(commitOf(key))) this.marks.delete(key);
    for (const entry of marks) if (this.marks.size < KEPT || this.marks.has(entry.key)) this.marks.set(entry.key, entry);
  }
}

function commitOf(key: string): string {
  return key.slice(0, key.lastIndexOf(":"));
}

/** Author of a mark: the person or robot that an operator's commit names, else the robot of its commit. */
export function authorOf({ key, mark }: MarkEntry): string {
  return mark.by || robotOf(key);
}

export function placeOf({ mark }: MarkEntry): Triple {
  return mark.place_mm.map((each) => each / 1000) as Triple;
}

/** Lowest and highest corner of a mark's box, m. */
export function boxOf({ mark }: MarkEntry): [Triple, Triple] {
  const half = (mark.extent_mm ?? [0, 0, 0]).map((each) => each / 2000);
  const place = mark.place_mm.map((each) => each / 1000);
  return [place.map((each, n) => each - half[n]) as Triple, place.map((each, n) => each + half[n]) as Triple];
}
