/** One WebSocket that tells what changed, and comes back by itself: PROTOCOL.md section 4.6. */

import type { Api } from "./api.ts";
import type { LiveEvent } from "./messages.ts";

const PAUSE_MIN_MS = 500;
const PAUSE_MAX_MS = 10_000;
const NOT_ALLOWED = 4401;

export interface LinkState {
  readonly live: boolean;
  /** When it was last known to be alive, ms as of Date.now(); null: never. */
  readonly heardMs: number | null;
}

export class LiveLink {
  private socket: WebSocket | null = null;
  private seen: string | null = null;
  private heardMs: number | null = null;
  private beatS = 15;
  private pauseMs = PAUSE_MIN_MS;
  private timer = 0;
  private closed = false;
  private readonly api: Api;
  private readonly map: string;
  private readonly onEvent: (event: LiveEvent) => void;
  private readonly onState: (state: LinkState) => void;
  private readonly onRefused: () => void;

  constructor(
    api: Api, map: string, onEvent: (event: LiveEvent) => void, onState: (state: LinkState) => void,
    onRefused: () => void,
  ) {
    this.api = api;
    this.map = map;
    this.onEvent = onEvent;
    this.onState = onState;
    this.onRefused = onRefused;
    this.connect();
  }

  close(): void {
    this.closed = true;
    window.clearTimeout(this.timer);
    this.socket?.close();
  }

  private connect(): void {
    const url = new URL(`maps/${this.map}/live`, document.baseURI);
    url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
    if (this.seen) url.searchParams.set("after", this.seen);
    const protocols = ["cairn.live.v1"];
    if (this.api.token) protocols.push(`cairn.token.${base64url(this.api.token)}`);
    const socket = new WebSocket(url, protocols);
    this.socket = socket;
    socket.onmessage = (message) => {
      if (socket !== this.socket) return;
      const event = JSON.parse(message.data as string) as LiveEvent;
      this.heardMs = Date.now();
      this.pauseMs = PAUSE_MIN_MS;
      if (event.type === "hello") this.beatS = event.beat_s;
      this.watch();
      this.onState({ live: true, heardMs: this.heardMs });
      this.onEvent(event);
      // `cells`, `marks` and `log` of a step may come twice; what ends it moves on.
      if (!["cells", "marks", "log"].includes(event.type)) this.seen = event.id;
    };
    socket.onclose = (event) => this.lost(socket, event.code);
    this.watch();
  }

  /** After twice a beat without any event the link is dead, whatever the socket says. */
  private watch(): void {
    window.clearTimeout(this.timer);
    const { socket } = this;
    this.timer = window.setTimeout(() => socket && this.lost(socket, 0), 2000 * this.beatS);
  }

  private lost(socket: WebSocket, code: number): void {
    if (this.closed || socket !== this.socket) return;
    this.socket = null;
    socket.close();
    window.clearTimeout(this.timer);
    this.onState({ live: false, heardMs: this.heardMs });
    if (code === NOT_ALLOWED) {
      this.onRefused();
      return;
    }
    this.timer = window.setTimeout(() => this.connect(), this.pauseMs * (0.75 + Math.random() / 2));
    this.pauseMs = Math.min(2 * this.pauseMs, PAUSE_MAX_MS);
  }
}

function base64url(text: string): string {
  const binary = String.fromCharCode(...new TextEncoder().encode(text));
  return btoa(binary).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}
