/** The look as the graphics card takes it: uniforms, and the legend that tells them. Nothing is fetched for it. */

import { ageUnit, type LogBook } from "./log_book.ts";
import { FIELDS, type Look } from "./look.ts";
import { classesOf } from "./map_layers.ts";
import type { MapInfo, Triple } from "./messages.ts";
import { textureOf, type Palette } from "./palettes.ts";
import type { Cells } from "./scene/cells.ts";
import { boxes, FIELD_CODES, squares, uniforms } from "./scene/materials.ts";
import type { Spread } from "./scene/spread.ts";
import type { Stage } from "./scene/stage.ts";
import { rangeOf } from "./scene/statistics.ts";
import { Legend, type Told, type Values } from "./ui/legend.ts";
import type { PlanInk } from "./ui/plan_picture.ts";
import { applyTheme } from "./ui/top_bar.ts";
import { KELVIN_ZERO_C } from "./units.ts";

const FAR_M = 1e9;

export class Appearance {
  readonly legend = new Legend();
  private readonly look: Look;
  private readonly stage: Stage;
  private readonly cells: Cells;
  private readonly book: LogBook;
  private readonly spread: Spread;
  /** Names of the classes that colours stand for; none: colours are those of cameras. */
  private readonly classes: readonly string[];
  /** Height that is told as 0, m in the map. */
  zeroM = 0;
  private readonly palettes = new Map<Palette, ReturnType<typeof textureOf>>();

  constructor(info: MapInfo, look: Look, stage: Stage, cells: Cells, book: LogBook, spread: Spread) {
    this.classes = classesOf(info.geometry.channels);
    uniforms.uLevelM.value = cells.isLevel ? cells.sizeAt(cells.depthMax).z : 0;
    this.look = look;
    this.stage = stage;
    this.cells = cells;
    this.book = book;
    this.spread = spread;
    look.boxes ??= !stage.isSoftware;
  }

  /** Everything as the look says. */
  apply(robots: readonly string[]): void {
    const { look } = this;
    const { palette } = FIELDS.find(({ field }) => field === look.field)!;
    uniforms.uField.value = FIELD_CODES[look.field];
    if (palette) {
      if (!this.palettes.has(palette)) this.palettes.set(palette, textureOf(palette));
      uniforms.uPalette.value = this.palettes.get(palette)!;
    }
    const [low, high] = look.clip ?? [[-FAR_M, -FAR_M, -FAR_M], [FAR_M, FAR_M, FAR_M]];
    uniforms.uLow.value.set(low[0], low[1], Math.max(low[2], look.floorM ?? -FAR_M));
    uniforms.uHigh.value.set(high[0], high[1], Math.min(high[2], look.ceilingM ?? FAR_M));
    uniforms.uMinP.value = look.minP;
    if (look.band) uniforms.uBand.value.set(look.band[0] + KELVIN_ZERO_C, look.band[1] === null ? FAR_M : look.band[1] + KELVIN_ZERO_C);
    else uniforms.uBand.value.set(1, 0);
    this.cells.setMaterial(look.boxes ? boxes : squares);
    this.refreshRange(robots);
    this.stage.draw();
  }

  /** Ends of the palette as locked, or as what is shown has them. */
  refreshRange(robots: readonly string[]): void {
    const { look } = this;
    const { uLow, uHigh, uRange } = uniforms;
    const zero = look.field === "temperature" ? KELVIN_ZERO_C : 0;
    const found = look.field === "colour" || look.field === "robot" ? null
      : (this.spread.range(look.field) ?? rangeOf(this.cells, look.field, uLow.value.z, uHigh.value.z));
    const range = look.ranges[look.field] ?? (found && (found.map((end) => end - zero) as [number, number]));
    const before = uRange.value.toArray();
    if (range) uRange.value.set(range[0] + zero, range[1] + zero);
    this.legend.show(look, range, { robots, classes: this.classes }, this.told(range), this.valuesOf(zero));
    // A frame takes the time of many ticks where there is no graphics card.
    if (look.field === "age" || look.field === "robot" || uRange.value.toArray().some((end, n) => end !== before[n])) this.stage.draw();
  }

  /** The map's values in the look's unit; heights over the floor. */
  private valuesOf(zero: number): Values {
    const found = this.spread.of(this.look.field);
    const isHeight = this.look.field === "height";
    const shiftM = isHeight ? this.zeroM : 0;
    if (!found) return { shift: shiftM, histogram: null };
    const { least, most, begin, step, counts } = found;
    return { shift: shiftM, histogram: { least: least - zero, most: most - zero, begin: begin - zero, step, counts } };
  }

  /** Unit of ages, and reach of the log that is known here, for the legend. */
  private told(range: [number, number] | null): Told {
    const { head, all } = this.cells;
    const asks = this.look.field === "age" || this.look.field === "robot";
    const isShort = asks && [...all.values()].some(({ points, lm }) => points && this.book.isBefore(lm));
    const log: Told["log"] = !isShort ? "whole" : this.book.isReading ? "read" : "short";
    const known = { log, newestS: this.book.newestS || null, cellM: this.cells.edgeM };
    if (this.book.ageS(head) === null) return { unit: "log entries", size: 1, ...known };
    return { ...ageUnit(range?.[1] ?? 0), ...known };
  }

  /** Field and ranges that a floor plan is drawn with: temperatures have the ends of the whole map's. */
  get planInk(): PlanInk {
    const locked = this.look.ranges.temperature;
    const rangeK = locked ? (locked.map((end) => end + KELVIN_ZERO_C) as [number, number]) : this.spread.range("temperature");
    // A level's plan tells what hinders a vehicle, by whatever its picture is coloured.
    const isOfGround = this.look.field === "slope" || this.look.field === "step";
    const field = this.cells.isLevel && !isOfGround ? "difficulty" : this.look.field;
    // A level's ranges are constants; another map's heights or temperatures would be sampled and sorted a few times a second.
    const range: [number, number] = this.cells.isLevel ? (this.look.ranges[field] ?? rangeOf(this.cells, field, -FAR_M, FAR_M) ?? [0, 1]) : [0, 1];
    return { theme: document.documentElement.dataset.theme === "light" ? "light" : "dark", field, rangeK, range };
  }

  /** Dark or light, as the page is. */
  theme(): "dark" | "light" {
    const theme = applyTheme();
    const light = theme === "light";
    uniforms.uBare.value.set(...((light ? [0.62, 0.63, 0.66] : [0.42, 0.44, 0.47]) as Triple));
    // Nearer to the ground than what stands out from it.
    uniforms.uFaded.value.set(...((light ? [0.83, 0.84, 0.86] : [0.19, 0.2, 0.21]) as Triple));
    this.stage.setBackground(light ? "#eef0f3" : "#0e1116");
    return theme;
  }

  dispose(): void {
    for (const texture of this.palettes.values()) texture.dispose();
  }
}
