/** Elements without a framework: h("button", { class: "key", onclick }, "Fit"). */

type Child = Node | string | null | false;
type Props = Record<string, unknown>;

export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K, props: Props = {}, ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value as EventListener);
    else if (name === "class") element.className = String(value);
    else if (name in element && name !== "list" && name !== "role" && typeof value !== "string") {
      (element as unknown as Props)[name] = value;
    } else element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...(children.filter((child) => child !== null && child !== false) as (Node | string)[]));
  return element;
}

const SVG = "http://www.w3.org/2000/svg";

export function svg(tag: string, props: Record<string, string | number>, ...children: (Node | string)[]): SVGElement {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(props)) element.setAttribute(name, String(value));
  element.append(...children);
  return element;
}

export function fill(element: Element, ...children: Child[]): void {
  element.replaceChildren(...(children.filter((child) => child !== null && child !== false) as (Node | string)[]));
}

/** A table of facts: terms and what they are. */
export function facts(rows: [string, Child][]): HTMLElement {
  return h("dl", { class: "facts" }, ...rows.flatMap(([term, what]) => [h("dt", {}, term), h("dd", {}, what)]));
}

/** A picture, once it is there: nothing refers to its bytes any more, whoever takes it from the page when. */
export async function pictureOf(blob: Blob, alt: string): Promise<HTMLImageElement> {
  const url = URL.createObjectURL(blob);
  try {
    const picture = h("img", { src: url, alt });
    await picture.decode();
    return picture;
  } finally {
    URL.revokeObjectURL(url);
  }
}
