/** Decodes views off the page's own thread. */

import { packed } from "./pack.ts";
import { decodeView } from "./view.ts";

export interface Decoded {
  readonly id: number;
  readonly bytes?: Uint8Array;
  readonly error?: string;
}

self.onmessage = (event: MessageEvent<{ id: number; data: Uint8Array; isLevel: boolean }>) => {
  const { id, data, isLevel } = event.data;
  try {
    const bytes = packed(decodeView(data), isLevel);
    self.postMessage({ id, bytes } satisfies Decoded, { transfer: [bytes.buffer] });
  } catch (error) {
    self.postMessage({ id, error: String(error) } satisfies Decoded);
  }
};
