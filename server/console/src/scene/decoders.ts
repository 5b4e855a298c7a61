/** Workers that decode views, so that the page never stops for it. */

import type { Decoded } from "../decode/worker.ts";

type Waiting = { resolve: (bytes: Uint8Array) => void; reject: (error: Error) => void };

export class Decoders {
  private readonly workers: Worker[];
  private readonly waiting = new Map<number, Waiting>();
  private next = 0;
  private readonly isLevel: boolean;

  /** `isLevel`: views are of a level. */
  constructor(isLevel: boolean, count = Math.max(1, Math.min(3, (navigator.hardwareConcurrency || 2) - 1))) {
    this.isLevel = isLevel;
    this.workers = Array.from({ length: count }, () => {
      const worker = new Worker(new URL("../decode/worker.ts", import.meta.url), { type: "module" });
      worker.onmessage = (event: MessageEvent<Decoded>) => this.done(event.data);
      return worker;
    });
  }

  decode(data: Uint8Array): Promise<Uint8Array> {
    const id = this.next++;
    return new Promise((resolve, reject) => {
      this.waiting.set(id, { resolve, reject });
      this.workers[id % this.workers.length].postMessage({ id, data, isLevel: this.isLevel }, [data.buffer]);
    });
  }

  close(): void {
    for (const worker of this.workers) worker.terminate();
  }

  private done({ id, bytes, error }: Decoded): void {
    const asked = this.waiting.get(id);
    this.waiting.delete(id);
    if (bytes) asked?.resolve(bytes);
    else asked?.reject(new Error(error));
  }
}
