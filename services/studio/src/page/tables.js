// Tables, bars, curves and numbers of what operators see.

import { element } from "./objects.js";
import { text } from "./strings.js";

/** Sides of a curve, in its own units. */
export const [WIDTH, HEIGHT] = [240, 80];

/** @param {number | null | undefined} seconds */
export const duration = seconds => seconds == null ? "" : seconds < 90 ? `${seconds.toFixed(1)} s` : seconds < 7200 ? `${(seconds / 60).toFixed(1)} min` : `${(seconds / 3600).toFixed(1)} h`;
/** @param {number | null | undefined} bytes */
export const mib = bytes => bytes == null ? "" : bytes < 2 ** 34 ? `${Math.round(bytes / 2 ** 20)} MiB` : `${Math.round(bytes / 2 ** 30)} GiB`;

/** A table. @param {string[]} heads @param {(Node | string)[][]} rows */
export function table(heads, rows) {
  const head = heads.map(name => element("th", { scope: "col" }, text(name)));
  const body = rows.map(([first, ...rest]) => element("tr", {}, element("th", { scope: "row" }, first), ...rest.map(cell => element("td", {}, cell))));
  return element("table", {}, element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...body));
}

/** How much of something is done. @param {string} name @param {number} share @param {string} words */
export function bar(name, share, words) {
  return element("span", {}, element("progress", { max: 1, value: share, "aria-label": name }), ` ${words}`);
}

/** A curve under its caption. @param {string} label @param {string} caption @param {string} path */
export function plot(label, caption, path) {
  const [svg, line] = ["svg", "path"].map(tag => document.createElementNS("http://www.w3.org/2000/svg", tag));
  const attributes = { viewBox: `0 -2 ${WIDTH} ${HEIGHT + 4}`, preserveAspectRatio: "none", role: "img", "aria-label": label };
  for (const [name, value] of Object.entries(attributes)) svg.setAttribute(name, value);
  line.setAttribute("d", path);
  svg.append(line);
  return element("figure", {}, element("figcaption", {}, caption), svg);
}

/** Why a scene waits or was given up; one that was given up has a button. @param {any} scene @param {(scene: string) => void} retry */
export function reason(scene, retry) {
  if (scene.state !== "dead") return (scene.worker ? scene.error : scene.why ?? scene.error) ?? "";
  return element("span", {}, `${scene.error ?? ""} `, element("button", { type: "button", click: () => retry(scene.name), "aria-label": text("retry_of", scene.name) }, text("retry")));
}
