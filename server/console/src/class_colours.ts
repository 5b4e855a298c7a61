/** Colours by which classes are drawn: `class_colours` of cairn_map/evidence/channels.py, and paler where a class hardly leads. */

type Rgb = readonly [number, number, number];

const GOLDEN_TURN = 0.6180339887498949;
/** Brightness of three classes in turn. */
const SHADES = [0.95, 0.75, 0.55];
const SATURATION = 0.8;
const OTHER_GREY = 150;
/** Parts of grey in the colour of a class that leads by less than two votes, next to one of its own. */
const PALE_PARTS = 2;

/** Red, green and blue, 0 to 255, of each class; the last one is `other`. */
export function classColours(count: number): Rgb[] {
  return Array.from({ length: count }, (_, n) => (n === count - 1 ? [OTHER_GREY, OTHER_GREY, OTHER_GREY] : hue((n * GOLDEN_TURN) % 1, SHADES[n % SHADES.length]!)));
}

/** The colour of a class that leads by less than two votes. */
export function unsureColour([red, green, blue]: Rgb): Rgb {
  const pale = (part: number) => Math.round((part + PALE_PARTS * OTHER_GREY) / (1 + PALE_PARTS));
  return [pale(red), pale(green), pale(blue)];
}

/** Number of the class in whose colour, or paler one, something is drawn, and whether it is unsure; null: in none. */
export function classOf(rgb: Rgb, count: number): { number: number; isUnsure: boolean } | null {
  const is = (one: Rgb) => one.every((part, n) => part === rgb[n]);
  const colours = classColours(count);
  const number = colours.findIndex(is);
  if (number >= 0) return { number, isUnsure: false };
  const pale = colours.findIndex((one) => is(unsureColour(one)));
  return pale < 0 ? null : { number: pale, isUnsure: true };
}

function hue(turn: number, bright: number): Rgb {
  const part = (n: number) => {
    const k = (n + 6 * turn) % 6;
    return Math.round(255 * bright * (1 - SATURATION * Math.max(0, Math.min(k, 4 - k, 1))));
  };
  return [part(5), part(3), part(1)];
}
