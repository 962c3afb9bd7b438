/** Elements without a framework: `h("p", { class: "muted" }, "text")`. */

type Child = Node | string | null | undefined | false;
type Props = Record<string, string | number | boolean | null | undefined | EventListener>;

function assign(element: Element, props: Props): void {
  for (const [key, value] of Object.entries(props)) {
    if (typeof value === "function") element.addEventListener(key.replace(/^on/, ""), value);
    else if (value === true) element.setAttribute(key, "");
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(key, String(value));
  }
}

export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  props: Props = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  assign(element, props);
  for (const child of children) if (child) element.append(child);
  return element;
}

const SVG = "http://www.w3.org/2000/svg";

/** A 20 px line icon from its path data. */
export function icon(path: string): SVGSVGElement {
  const svg = document.createElementNS(SVG, "svg");
  assign(svg, { viewBox: "0 0 20 20", class: "icon", "aria-hidden": "true" });
  const shape = document.createElementNS(SVG, "path");
  shape.setAttribute("d", path);
  svg.append(shape);
  return svg;
}

export const ICONS = {
  back: "M12 4 6 10l6 6",
  plus: "M10 4v12M4 10h12",
  link: "M8.5 11.5l3-3M9 6l1.6-1.6a3.5 3.5 0 0 1 5 5L14 11M11 14l-1.6 1.6a3.5 3.5 0 0 1-5-5L6 9",
  check: "M4 10.5 8 14.5 16 5.5",
  download: "M10 3v9m-4-3.5 4 4 4-4M4 16.5h12",
  target: "M10 2.5v3M10 14.5v3M2.5 10h3M14.5 10h3M10 6.2a3.8 3.8 0 1 0 0 7.6 3.8 3.8 0 0 0 0-7.6z",
  upload: "M10 13V4M6 7.5 10 3.5l4 4M4 16.5h12",
  chevron: "M5 12.5 10 7.5l5 5",
  photo: "M3 5.5h14v10H3zM3 13l4-4 3.5 3.5L13 10l4 4",
} as const;

/** Replaces all children at once. */
export function fill(element: Element, ...children: Child[]): void {
  element.replaceChildren(...children.filter((child): child is Node | string => Boolean(child)));
}

/** Sets the text only when it differs, so that nothing is laid out again for nothing. */
export function text(element: Element, value: string): void {
  if (element.textContent !== value) element.textContent = value;
}
