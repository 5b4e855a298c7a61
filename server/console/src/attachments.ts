/** Pictures of marks: bytes that strangers sent, shown only as the pixels that the browser decodes of them.
 *
 *     GET .../attachments/{sha}  -->  the SHA-256 is looked at  -->  decoded as a bitmap  -->  painted on a canvas
 *
 * The bytes never become an address, an element or a page: PROTOCOL.md section 4.19 and decision 035. */

import type { Api } from "./api.ts";
import { h } from "./dom.ts";
import type { Mark } from "./messages.ts";
import { sizeOf } from "./picture_size.ts";
import { sha256 } from "./sha256.ts";

/** Pictures larger than this are not decoded: bytes of a file, and pixels that it says it has. */
const LARGEST_BYTES = 2 ** 24;
const LARGEST_PX = 40e6;
/** Pixels of the longer side that are painted. */
const LONGEST_PX = 1024;
const TOO_LARGE = "The picture is larger than the page shows.";
const UNREADABLE = "What is attached cannot be read as a picture.";
const IMAGES = ["image/png", "image/jpeg", "image/webp"];
/** Pictures that are kept. */
const KEPT = 30;

interface Attachment {
  readonly sha256: string;
  readonly size_bytes: number;
}

/** What a mark names; null: nothing, or not in the form of one. */
export function attachmentOf({ attachment }: Mark): Attachment | null {
  const { sha256, size_bytes } = (attachment ?? {}) as Partial<Attachment>;
  return typeof sha256 === "string" && /^[0-9a-f]{64}$/.test(sha256) && typeof size_bytes === "number" ? { sha256, size_bytes } : null;
}

export class Attachments {
  private readonly kept = new Map<string, Promise<ImageBitmap>>();
  private readonly api: Api;
  private readonly map: string;

  constructor(api: Api, map: string) {
    this.api = api;
    this.map = map;
  }

  /** The picture of a mark at most so wide, px; rejects with what is wrong, in words. */
  async picture(mark: Mark, wide: number): Promise<HTMLCanvasElement> {
    const found = attachmentOf(mark);
    if (!found) throw new Error("This mark has no picture.");
    const bitmap = await this.bitmap(found);
    const scale = Math.min(wide / bitmap.width, 1);
    const canvas = h("canvas", {
      width: Math.max(Math.round(bitmap.width * scale), 1), height: Math.max(Math.round(bitmap.height * scale), 1), role: "img", "aria-label": `Picture of ${mark.name}`,
    });
    canvas.getContext("2d")!.drawImage(bitmap, 0, 0, canvas.width, canvas.height);
    return canvas;
  }

  private bitmap(found: Attachment): Promise<ImageBitmap> {
    const before = this.kept.get(found.sha256);
    if (before) return before;
    const made = this.load(found);
    this.kept.set(found.sha256, made);
    // What failed is asked for again: a robot may bring it later.
    made.catch(() => this.kept.delete(found.sha256));
    if (this.kept.size > KEPT) this.kept.delete(this.kept.keys().next().value!);
    return made;
  }

  private async load({ sha256: digest, size_bytes }: Attachment): Promise<ImageBitmap> {
    if (size_bytes > LARGEST_BYTES) throw new Error(TOO_LARGE);
    const answer = await this.api.ask(`maps/${this.map}/main/attachments/${digest}`);
    const bytes = new Uint8Array(await answer.arrayBuffer());
    if (sha256(bytes) !== digest) throw new Error("What came is not the picture that the mark names.");
    const type = (answer.headers.get("Content-Type") ?? "").split(";")[0].trim();
    if (!IMAGES.includes(type)) throw new Error("What is attached is not a picture that the page shows.");
    // A few kilobytes may decode to gigabytes.
    const size = sizeOf(bytes);
    if (!size) throw new Error(UNREADABLE);
    if (size.width * size.height > LARGEST_PX) throw new Error(TOO_LARGE);
    try {
      const whole = await createImageBitmap(new Blob([bytes], { type }));
      const scale = Math.min(LONGEST_PX / Math.max(whole.width, whole.height), 1);
      if (scale === 1) return whole;
      const small = await createImageBitmap(whole, { resizeWidth: Math.ceil(whole.width * scale), resizeHeight: Math.ceil(whole.height * scale) });
      whole.close();
      return small;
    } catch {
      throw new Error(UNREADABLE);
    }
  }
}
