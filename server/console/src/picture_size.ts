/** Width and height that a PNG, JPEG or WebP file states in its head: read before anything of it is decoded.
 *
 *     PNG   IHDR is the first chunk                     RFC 2083 section 4.1.1
 *     JPEG  the first frame header, SOF0 to SOF15       ITU-T T.81 section B.2.2
 *     WebP  VP8X, VP8L or VP8 is the first chunk        RFC 9649 sections 2.7, 3.4; RFC 6386 section 9.1
 *
 * Decoders take no second size from these files: they refuse a second frame header, and frames larger than the canvas. */

export interface PictureSize {
  readonly width: number;
  readonly height: number;
}

const PNG = [0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a];
/** Markers from C0 to CF that head no frame: Huffman tables, a reserved one, arithmetic conditioning. */
const NO_FRAMES = [0xc4, 0xc8, 0xcc];
const START_OF_SCAN = 0xda;
const END_OF_IMAGE = 0xd9;

/** The size in px, both at least 1; null: no picture of these three kinds, or its head is cut off. */
export function sizeOf(bytes: Uint8Array): PictureSize | null {
  const data = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const text = (at: number) => String.fromCharCode(...bytes.subarray(at, at + 4));
  let found: PictureSize | null = null;
  try {
    if (PNG.every((byte, n) => bytes[n] === byte) && text(12) === "IHDR") found = { width: data.getUint32(16), height: data.getUint32(20) };
    else if (bytes[0] === 0xff && bytes[1] === 0xd8) found = sizeOfJpeg(data);
    else if (text(0) === "RIFF" && text(8) === "WEBP") found = sizeOfWebp(data, text(12));
  } catch (error) {
    if (!(error instanceof RangeError)) throw error; // it ends within its head
  }
  return found && found.width > 0 && found.height > 0 ? found : null;
}

/** Segment after segment, each as long as it says. */
function sizeOfJpeg(data: DataView): PictureSize | null {
  let at = 2;
  for (;;) {
    if (data.getUint8(at) !== 0xff) return null;
    while (data.getUint8(at) === 0xff) at++; // filling bytes may come before a marker
    const marker = data.getUint8(at++);
    if (marker === START_OF_SCAN || marker === END_OF_IMAGE) return null;
    if (marker === 0x01 || (marker >= 0xd0 && marker <= 0xd7)) continue; // these have no length
    if (marker >= 0xc0 && marker <= 0xcf && !NO_FRAMES.includes(marker)) return { height: data.getUint16(at + 3), width: data.getUint16(at + 5) };
    const length = data.getUint16(at);
    if (length < 2) return null;
    at += length;
  }
}

function sizeOfWebp(data: DataView, chunk: string): PictureSize | null {
  const of24 = (at: number) => data.getUint16(at, true) + 0x10000 * data.getUint8(at + 2);
  if (chunk === "VP8X") return { width: of24(24) + 1, height: of24(27) + 1 };
  if (chunk === "VP8L") {
    const bits = data.getUint32(21, true);
    return { width: (bits & 0x3fff) + 1, height: ((bits >>> 14) & 0x3fff) + 1 };
  }
  // Two bits above each size scale it up, which decoders leave out.
  return chunk === "VP8 " ? { width: data.getUint16(26, true) & 0x3fff, height: data.getUint16(28, true) & 0x3fff } : null;
}
