/** What waits for an operator: robots that ask to be let in, and shares of the map's bounds that are half used.
 *
 * Both are asked for now and then, as no live event tells of them, and not while the page is hidden. Who may only read is refused once, and then no more
 * is asked, nor shown. */

import { ApiError, type Api } from "./api.ts";
import type { AskingRobot, RobotKeys, RobotUse } from "./messages.ts";

const REFRESH_MS = 60_000;
/** Part of a share above which it is pointed out, and robots that a map has places for: PROTOCOL.md section 6. */
const ALARM_PART = 0.5;
const PLACES = 256;
const REFUSED_KEY = "cairn.refused.";

/** A share that is more than half used. */
export interface FullShare {
  /** null: the reserve, or what all robots share. */
  readonly robot: string | null;
  readonly said: string;
}

export class Duties {
  keys: RobotKeys = { admitted: [], asking: [] };
  uses: readonly RobotUse[] = [];
  /** Keys that were refused on this computer. */
  readonly refused: Set<string>;
  private isMine = true;
  /** The server let an operator see what waits for operators. */
  private isProven = false;
  private isAsking = false;
  private askAtMs = 0;
  private readonly api: Api;
  private readonly map: string;

  constructor(api: Api, map: string) {
    this.api = api;
    this.map = map;
    this.refused = new Set(JSON.parse(localStorage.getItem(REFUSED_KEY + map) ?? "[]") as string[]);
  }

  /** A few times a second. */
  tick(): void {
    if (!this.isMine || this.isAsking || document.hidden || performance.now() < this.askAtMs) return;
    this.askAtMs = performance.now() + REFRESH_MS;
    void this.ask();
  }

  /** Ask at the next tick: something was done. */
  refresh(): void {
    this.askAtMs = 0;
  }

  /** Whether who looks may mark, dismiss and retract; until the server has said so, no. */
  get isOperator(): boolean {
    return this.isMine && this.isProven;
  }

  /** The shares that are more than half used, one line for each robot. */
  get full(): FullShare[] {
    const found = this.uses.flatMap(({ robot, used }) => {
      const parts = Object.entries(used).filter(([, part]) => part > ALARM_PART);
      return parts.length ? [{ robot, said: parts.map(([bound, part]) => `${bound} ${percent(part)}`).join(", ") }] : [];
    });
    const robots = this.uses.filter(({ robot }) => robot !== null).length;
    if (robots > ALARM_PART * PLACES) found.push({ robot: null, said: `robots ${robots} of ${PLACES}` });
    return found;
  }

  /** Admit the key of a robot that asks, for good; rejects with what the server says. */
  async admit({ author }: AskingRobot): Promise<void> {
    await this.api.ask(`maps/${this.map}/keys/${author}`, { method: "PUT" });
    this.refused.delete(author);
    this.keep();
    this.refresh();
  }

  /** Leave a robot refused, which it is anyway, and point at it no more on this computer. */
  refuse({ author }: AskingRobot): void {
    this.refused.add(author);
    this.keep();
  }

  private async ask(): Promise<void> {
    this.isAsking = true;
    try {
      this.keys = await this.api.json<RobotKeys>(`maps/${this.map}/keys`);
      this.isProven = true;
      this.uses = await this.api.json<RobotUse[]>(`maps/${this.map}/robots`);
    } catch (error) {
      if (error instanceof ApiError && error.status === 403) this.isMine = false;
      // Of a link that is gone the bar tells.
    } finally {
      this.isAsking = false;
    }
  }

  /** What was refused and still asks: no more than the server lists. */
  private keep(): void {
    const asking = new Set(this.keys.asking.map(({ author }) => author));
    for (const author of this.refused) if (!asking.has(author)) this.refused.delete(author);
    localStorage.setItem(REFUSED_KEY + this.map, JSON.stringify([...this.refused]));
  }
}

export function percent(part: number): string {
  return `${Math.round(100 * part)} %`;
}

/** The 16 digits that stand for a key, four by four, as people compare them. */
export function digitsOf(author: string): string {
  return author.slice(author.indexOf(".") + 1).replace(/.{4}(?=.)/g, "$& ");
}
