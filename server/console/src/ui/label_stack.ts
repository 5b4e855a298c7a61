/** Labels in the picture, none over another: those of one place stand in a stack. */

const GAP_PX = 2;

export interface LabelBox {
  readonly x: number;
  readonly y: number;
  readonly width: number;
  readonly height: number;
}

/** Where the upper edge of each comes, px: its own, or as far from it as those before it reach, towards the middle of the picture. */
export function stacked(boxes: readonly LabelBox[], heightPx: number): number[] {
  const placed: LabelBox[] = [];
  return boxes.map((box) => {
    const down = box.y < heightPx / 2;
    let y = box.y;
    // Each step is past one that is placed, always the same way.
    for (let over: LabelBox | undefined; (over = placed.find((other) => areOver({ ...box, y }, other))); ) {
      y = down ? over.y + over.height + GAP_PX : over.y - box.height - GAP_PX;
    }
    placed.push({ ...box, y });
    return y;
  });
}

/** Labels that would lie over one another, in groups, by number; each where it would stand by itself. */
export function heaps(boxes: readonly LabelBox[]): number[][] {
  const heapOf = boxes.map((_, n) => n);
  boxes.forEach((box, n) => {
    for (let m = 0; m < n; m++) {
      if (!areOver(box, boxes[m])) continue;
      const [from, to] = [heapOf[n], heapOf[m]];
      heapOf.forEach((heap, k) => (heapOf[k] = heap === from ? to : heap));
    }
  });
  const found = new Map<number, number[]>();
  heapOf.forEach((heap, n) => found.set(heap, [...(found.get(heap) ?? []), n]));
  return [...found.values()];
}

function areOver(a: LabelBox, b: LabelBox): boolean {
  const across = a.x < b.x + b.width && b.x < a.x + a.width;
  // Less than the gap that they are given, which may be rounded.
  return across && a.y < b.y + b.height + GAP_PX / 2 && b.y < a.y + a.height + GAP_PX / 2;
}
