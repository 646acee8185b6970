// Labels of a photo's pixels as colours.

/** @typedef {import("./api.js").LabelMap} LabelMap */

/** The label of what the answer selects, as the server gives it. */
export const ANSWER = 255;

/** Colour of the answer. */
export const ANSWER_COLOUR = [255, 64, 160];

/**
 * Labels row by row.
 * @param {LabelMap} map
 */
export function decode(map) {
  const labels = new Uint8Array(map.width * map.height);
  let at = 0;
  for (let k = 0; k < map.runs.length; k += 2) {
    labels.fill(map.runs[k], at, at + map.runs[k + 1]);
    at += map.runs[k + 1];
  }
  return labels;
}

/** The share of the pixels that have a label. @param {LabelMap | null} map */
export function covered(map) {
  if (!map) return null;
  let count = 0;
  for (let k = 0; k < map.runs.length; k += 2) if (map.runs[k]) count += map.runs[k + 1];
  return count / (map.width * map.height);
}

/**
 * Paints labels: a tint inside, an opaque outline.
 * @param {HTMLCanvasElement} canvas @param {LabelMap | null} map @param {(label: number) => number[] | null} colour
 */
export function paint(canvas, map, colour) {
  if (!map) {
    canvas.width = canvas.height = 1;
    return;
  }
  const { width, height } = map, labels = decode(map);
  canvas.width = width;
  canvas.height = height;
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  const image = context.createImageData(width, height), out = image.data;
  for (let y = 0, i = 0; y < height; y++) {
    for (let x = 0; x < width; x++, i++) {
      const label = labels[i], rgb = label ? colour(label) : null;
      if (!rgb) continue;
      const edge = (x > 0 && labels[i - 1] !== label) || (x + 1 < width && labels[i + 1] !== label) ||
        (y > 0 && labels[i - width] !== label) || (y + 1 < height && labels[i + width] !== label);
      out.set([rgb[0], rgb[1], rgb[2], edge ? 255 : 96], 4 * i);
    }
  }
  context.putImageData(image, 0, 0);
}

/**
 * The bounds of a label, as [x0, y0, x1, y1] in pixels of the map; null where it does not occur.
 * @param {Uint8Array} labels @param {number} width @param {number} wanted
 */
export function bounds(labels, width, wanted) {
  let [x0, y0, x1, y1] = [Infinity, Infinity, -1, -1];
  for (let i = 0; i < labels.length; i++) {
    if (labels[i] !== wanted) continue;
    const x = i % width, y = (i / width) | 0;
    x0 = Math.min(x0, x); x1 = Math.max(x1, x + 1); y0 = Math.min(y0, y); y1 = Math.max(y1, y + 1);
  }
  return x1 < 0 ? null : [x0, y0, x1, y1];
}

/**
 * The middle of the pixel of a label that is nearest to a position.
 * @param {Uint8Array} labels @param {number} width @param {number} wanted @param {number[]} to
 */
export function nearest(labels, width, wanted, to) {
  let [best, least] = [to, Infinity];
  for (let i = 0; i < labels.length; i++) {
    if (labels[i] !== wanted) continue;
    const at = [i % width + 0.5, ((i / width) | 0) + 0.5], far = Math.hypot(at[0] - to[0], at[1] - to[1]);
    if (far < least) [best, least] = [at, far];
  }
  return best;
}
