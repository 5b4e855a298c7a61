/** Which voxel lies under a pixel: the picture is drawn once more, one pixel of it, with numbers instead of colours. */

import {
  Box3, NearestFilter, RGBAIntegerFormat, Scene, UnsignedIntType, Vector3, WebGLRenderTarget, type Object3D,
} from "three";
import { COLOURED, HEAT_STEP_K, HEAT_ZERO_K, STRIDE, WARM } from "../decode/pack.ts";
import type { Triple } from "../messages.ts";
import type { Cells } from "./cells.ts";
import { numbers, uniforms } from "./materials.ts";
import type { ShownCell } from "./shown_cell.ts";
import type { Stage } from "./stage.ts";

export interface Picked {
  readonly cell: ShownCell;
  readonly row: number;
  /** Places of the node in its cell, at `depth`. */
  readonly node: Triple;
  readonly depth: number;
  readonly edgeM: number;
  /** Size of the node, m. */
  readonly size: Vector3;
  readonly centre: Vector3;
  /** Where the pixel's ray meets the node's surface; m. */
  readonly point: Vector3;
  readonly isVoxel: boolean;
}

const FORMAT = {
  format: RGBAIntegerFormat, type: UnsignedIntType, internalFormat: "RGBA32UI", magFilter: NearestFilter,
  minFilter: NearestFilter, generateMipmaps: false,
} as const;
/** Of the picture that boxes are measured in, px. */
const WHOLE = { width: 96, height: 72 };

export class Picker {
  private readonly target = new WebGLRenderTarget(1, 1, FORMAT);
  private readonly whole = new WebGLRenderTarget(WHOLE.width, WHOLE.height, FORMAT);
  private readonly scene = new Scene();
  private readonly stage: Stage;
  private readonly cells: Cells;

  constructor(stage: Stage, cells: Cells) {
    this.stage = stage;
    this.cells = cells;
  }

  /** What is drawn at a place of the canvas, px from its upper left corner; null: nothing. */
  at(x: number, y: number): Picked | null {
    const { renderer, canvas } = this.stage;
    const ratio = renderer.getPixelRatio();
    const px = Math.floor(x * ratio);
    const py = canvas.height - 1 - Math.floor(y * ratio);
    // The target is one pixel of a picture that reaches beyond it, so points whose centres lie elsewhere count.
    this.target.viewport.set(-px, -py, canvas.width, canvas.height);
    this.target.scissor.set(0, 0, 1, 1);
    const read = this.read(this.target);
    if (!read[3] || !read[0]) return null;
    const depthM = new Float32Array(read.buffer)[2];
    return this.named(this.cells.byNumber[read[0] - 1], read[1], x, y, depthM);
  }

  /** A box around all that is in the picture, looked at in a coarse one; null: nothing is. */
  boxInView(): Box3 | null {
    const { width, height } = WHOLE;
    const { clientWidth, clientHeight } = this.stage.canvas;
    const read = this.read(this.whole);
    const depths = new Float32Array(read.buffer);
    const box = new Box3();
    for (let n = 0; n < width * height; n++) {
      if (!read[4 * n + 3] || !read[4 * n]) continue;
      const [x, y] = [(n % width) + 0.5, height - Math.floor(n / width) - 0.5];
      const cell = this.cells.byNumber[read[4 * n] - 1];
      const picked = this.named(cell, read[4 * n + 1], (x / width) * clientWidth, (y / height) * clientHeight, depths[4 * n + 2]);
      if (picked) box.expandByPoint(picked.point);
    }
    return box.isEmpty() ? null : box.expandByScalar(0.2);
  }

  dispose(): void {
    this.target.dispose();
    this.whole.dispose();
  }

  /** The picture once more, in a target, with numbers instead of colours. */
  private read(target: WebGLRenderTarget): Uint32Array {
    const { renderer, camera } = this.stage;
    const { x, y, z, w } = target.viewport;
    uniforms.uViewport.value.set(x, y, z, w);
    const parent = this.cells.group.parent as Object3D;
    const material = this.cells.material;
    this.cells.setMaterial(numbers);
    this.scene.add(this.cells.group);
    renderer.setRenderTarget(target);
    renderer.clear();
    renderer.render(this.scene, camera);
    const read = new Uint32Array(4 * target.width * target.height);
    renderer.readRenderTargetPixels(target, 0, 0, target.width, target.height, read);
    renderer.setRenderTarget(null);
    parent.add(this.cells.group);
    this.cells.setMaterial(material);
    return read;
  }

  private named(cell: ShownCell, row: number, x: number, y: number, depthM: number): Picked | null {
    const node = nodeOf(cell, row);
    if (!node) return null;
    const edgeM = this.cells.edgeM / 2 ** cell.depth;
    const size = this.cells.sizeAt(cell.depth);
    const centre = new Vector3(...node).addScalar(0.5).multiply(size).add(cell.box.min);
    const { camera, canvas } = this.stage;
    const ndc = new Vector3((x / canvas.clientWidth) * 2 - 1, 1 - (y / canvas.clientHeight) * 2, 0.5);
    const ray = ndc.unproject(camera).sub(camera.position);
    const forward = camera.getWorldDirection(new Vector3());
    const point = camera.position.clone().addScaledVector(ray, depthM / ray.dot(forward));
    const isVoxel = cell.depth === this.cells.depthMax;
    return { cell, row, node, depth: cell.depth, edgeM, size, centre, point, isVoxel };
  }
}

export function nodeOf(cell: ShownCell, row: number): Triple | null {
  const at = row * STRIDE;
  return at + STRIDE <= cell.bytes.length ? [cell.bytes[at], cell.bytes[at + 1], cell.bytes[at + 2]] : null;
}

export interface Reading {
  readonly probability: number;
  readonly rgb: Triple | null;
  readonly meanK: number | null;
  readonly hottestK: number | null;
}

/** What a node's 12 bytes say. */
export function readingOf(cell: ShownCell, row: number): Reading {
  const { bytes } = cell;
  const at = row * STRIDE;
  const flags = bytes[at + 7];
  const kelvin = (low: number) => (bytes[low] + 256 * bytes[low + 1]) * HEAT_STEP_K + HEAT_ZERO_K;
  const warm = (flags & WARM) !== 0;
  return {
    probability: bytes[at + 3] / 255,
    rgb: flags & COLOURED ? [bytes[at + 4], bytes[at + 5], bytes[at + 6]] : null,
    meanK: warm ? kelvin(at + 8) : null,
    hottestK: warm ? kelvin(at + 10) : null,
  };
}
