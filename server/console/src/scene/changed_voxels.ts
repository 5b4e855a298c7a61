/** Voxels that changed, in colours over the map: what is gone is seen through, as nothing is there any more. */

import { BoxGeometry, Color, Group, InstancedMesh, Matrix4, MeshBasicMaterial, Vector3 } from "three";
import type { Triple } from "../messages.ts";

/** Over the voxel that it stands for, so that it is seen. */
const GROWN = 1.06;
const SEEN_THROUGH = 0.5;
/** So that the top face, the lightest, has the colour itself. */
const BRIGHTEST = 1 / 1.04;

export interface ColouredVoxels {
  readonly colour: string;
  readonly centresM: readonly Triple[];
  readonly isThere: boolean;
}

export class ChangedVoxels {
  readonly group = new Group();
  private readonly shape: BoxGeometry;

  /** `size`: of a voxel, m. */
  constructor(size: Triple) {
    const [x, y, z] = size.map((edgeM) => edgeM * GROWN);
    this.shape = shaded(new BoxGeometry(x, y, z));
  }

  /** `isShown`: whether a place lies within what is shown of the map. */
  show(parts: readonly ColouredVoxels[], isShown: (place: Vector3) => boolean): void {
    this.clear();
    const place = new Vector3();
    const matrix = new Matrix4();
    for (const { colour, centresM, isThere } of parts) {
      const shown = centresM.filter((centre) => isShown(place.set(...centre)));
      if (!shown.length) continue;
      const material = new MeshBasicMaterial({ color: new Color(colour), vertexColors: true, transparent: !isThere, opacity: isThere ? 1 : SEEN_THROUGH, depthWrite: isThere });
      const mesh = new InstancedMesh(this.shape, material, shown.length);
      shown.forEach((centre, n) => mesh.setMatrixAt(n, matrix.makeTranslation(...centre)));
      mesh.renderOrder = isThere ? 5 : 6;
      mesh.frustumCulled = false;
      this.group.add(mesh);
    }
  }

  /** Voxels that are drawn. */
  get count(): number {
    return this.group.children.reduce((sum, mesh) => sum + (mesh as InstancedMesh).count, 0);
  }

  clear(): void {
    for (const mesh of [...this.group.children] as InstancedMesh[]) {
      mesh.removeFromParent();
      (mesh.material as MeshBasicMaterial).dispose();
      mesh.dispose();
    }
  }

  /** For good. */
  dispose(): void {
    this.clear();
    this.shape.dispose();
  }
}

/** Faces lit as those of the voxels are: the top most, the bottom least. */
function shaded(box: BoxGeometry): BoxGeometry {
  const lights = [0.88, 0.88, 0.74, 0.74, 1.04, 0.62];
  const colours = lights.flatMap((light) => Array.from({ length: 12 }, () => light * BRIGHTEST));
  const attribute = box.getAttribute("position").clone();
  colours.forEach((value, n) => (attribute.array[n] = value));
  box.setAttribute("color", attribute);
  return box;
}
