// The tools: what a pointer, or the keyboard's cursor, does in the photo and in 3D.

/** All of them, by their names: clicks and boxes, and those that mark splats by hand. */
export const TOOLS = ["prompt", "rectangle", "lasso", "brush", "sphere"];
/** Those that have a size. */
export const SIZED = ["brush", "sphere"];
/** That size: a radius in shares of a view's long side, at first, at least, at most, and by what a step changes it. */
export const RADIUS = { first: 0.02, least: 0.002, most: 0.2, step: 1.25 };

/** Keys that are held while a tool marks. @typedef {{ctrlKey: boolean, metaKey: boolean, shiftKey: boolean}} Modifiers */

/**
 * Draws a tool's path.
 * @param {Element} svg @param {string} tool @param {number[][]} path @param {{width: number, height: number}} size @param {number} radius
 */
export function drawStroke(svg, tool, path, size, radius) {
  svg.setAttribute("viewBox", `0 0 ${size.width} ${size.height}`);
  svg.setAttribute("preserveAspectRatio", "none");
  const [a, b] = [path[0], path[path.length - 1]];
  const line = document.createElementNS("http://www.w3.org/2000/svg", "path");
  const round = `M${b[0] - radius} ${b[1]}a${radius} ${radius} 0 1 0 ${2 * radius} 0a${radius} ${radius} 0 1 0 ${-2 * radius} 0`;
  const shapes = {
    lasso: `M${path.map(p => p.join(" ")).join("L")}Z`,
    brush: `M${path.map(p => p.join(" ")).join("L")}${round}`,
    sphere: round,
  };
  const rectangle = `M${a[0]} ${a[1]}H${b[0]}V${b[1]}H${a[0]}Z`;
  line.setAttribute("d", shapes[/** @type {keyof typeof shapes} */ (tool)] ?? rectangle);
  svg.replaceChildren(line);
}
