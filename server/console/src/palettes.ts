/** Palettes that the colour-blind can read, as textures and as CSS gradients. */

import { ClampToEdgeWrapping, DataTexture, LinearFilter, RGBAFormat, UnsignedByteType } from "three";

/** Stops at equal distances; matplotlib's (CC0), inferno and cividis without their darkest, which a dark ground would swallow. */
const STOPS = {
  inferno: [
    "220c4a", "4a0c6b", "781c6d", "a52c60", "cf4446", "ed6925", "fb9b06", "f7d13d", "fcffa4",
  ],
  cividis: [
    "123570", "3b496c", "575d6d", "707173", "8a8779", "a59c74", "c3b369", "e1cc55", "fee838",
  ],
  viridis: [
    "440154", "482878", "3e4989", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b", "fde725",
  ],
} as const;
export type Palette = keyof typeof STOPS;

/** Above the upper end of any palette, and below the lower one: in none of them, and unlike either ground. */
export const OVER = "#ff6ad5";
export const UNDER = "#2a3f86";

function rgb(hex: string): number[] {
  return [0, 2, 4].map((at) => parseInt(hex.slice(at, at + 2), 16));
}

export function textureOf(palette: Palette): DataTexture {
  const stops = STOPS[palette].map(rgb);
  const data = new Uint8Array(256 * 4);
  for (let n = 0; n < 256; n++) {
    const at = (n / 255) * (stops.length - 1);
    const low = Math.min(Math.floor(at), stops.length - 2);
    for (let c = 0; c < 3; c++) data[4 * n + c] = stops[low][c] + (stops[low + 1][c] - stops[low][c]) * (at - low);
    data[4 * n + 3] = 255;
  }
  const texture = new DataTexture(data, 256, 1, RGBAFormat, UnsignedByteType);
  texture.magFilter = texture.minFilter = LinearFilter;
  texture.wrapS = texture.wrapT = ClampToEdgeWrapping;
  texture.needsUpdate = true;
  return texture;
}

/** The stops as colours, for a legend that is drawn. */
export function stopsOf(palette: Palette): string[] {
  return STOPS[palette].map((hex) => `#${hex}`);
}

/** Colours of robots: Okabe and Ito's, which everybody can tell apart, less black. */
const ROBOTS = ["#56b4e9", "#e69f00", "#009e73", "#cc79a7", "#f0e442", "#d55e00", "#0072b2"];

/** Of operators, and of robots that left. */
const NOBODY = "#8b949e";

export function robotColour(name: string, names: readonly string[]): string {
  const at = names.indexOf(name);
  return at < 0 ? NOBODY : ROBOTS[at % ROBOTS.length];
}

/** #rrggbb as parts of 1. */
export function rgbOf(hex: string): [number, number, number] {
  return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255) as [number, number, number];
}
