/** Cells as they were, decoded: so that going to and fro in time asks and decodes once.
 *
 * Most cells are the same at neighbouring moments, and share their bytes then. */

/** All bytes that are kept together. */
const BYTES_MAX = 96 << 20;

export class PastViews {
  private readonly views = new Map<string, Uint8Array>();
  /** Bytes of each cell and depth that came last: equal ones are not kept twice. */
  private readonly last = new Map<string, Uint8Array>();
  private readonly shares = new Map<Uint8Array, number>();
  private sizeBytes = 0;

  has(place: string, state: string): boolean {
    return this.views.has(`${place}/${state}`);
  }

  get(place: string, state: string): Uint8Array | undefined {
    const name = `${place}/${state}`;
    const found = this.views.get(name);
    if (found) {
      this.views.delete(name);
      this.views.set(name, found);
    }
    return found;
  }

  /** `place`: cell and depth; `state`: its last change and the moment. Returns the bytes that are kept. */
  put(place: string, state: string, bytes: Uint8Array): Uint8Array {
    const before = this.last.get(place);
    const kept = before && isSame(before, bytes) ? before : bytes;
    this.last.set(place, kept);
    this.take(kept, 1);
    const name = `${place}/${state}`;
    const replaced = this.views.get(name);
    this.views.set(name, kept);
    if (replaced) this.take(replaced, -1);
    while (this.sizeBytes > BYTES_MAX && this.views.size > 1) {
      const [oldest, old] = this.views.entries().next().value!;
      this.views.delete(oldest);
      this.take(old, -1);
    }
    return kept;
  }

  /** Count one share of some bytes more, or one less. */
  private take(bytes: Uint8Array, by: 1 | -1): void {
    const before = this.shares.get(bytes) ?? 0;
    if (before === 0) this.sizeBytes += bytes.length;
    if (before + by > 0) return void this.shares.set(bytes, before + by);
    this.shares.delete(bytes);
    this.sizeBytes -= bytes.length;
  }

  forget(): void {
    this.views.clear();
    this.shares.clear();
    this.last.clear();
    this.sizeBytes = 0;
  }
}

function isSame(a: Uint8Array, b: Uint8Array): boolean {
  if (a === b) return true;
  if (a.length !== b.length) return false;
  for (let n = 0; n < a.length; n++) if (a[n] !== b[n]) return false;
  return true;
}
