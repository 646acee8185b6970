// One table of keys and mouse actions: it makes the sheet, the tooltips and the dispatch; the tests read it too.

import { text } from "./strings.js";

/** @typedef {{act: string, keys: string[], where?: "stage" | "space" | "both", mouse?: boolean}} Shortcut */

/**
 * `keys` are codes of keys (`KeyZ`), with `Ctrl+` or `Shift+` before them; `mouse` rows only explain. Those of a `where` need the focus
 * in the photo (`stage`), in the 3D view (`space`), or in one of them. @type {Shortcut[]}
 */
const table = [
  { act: "keep", keys: ["Enter"] },
  { act: "drop", keys: ["Escape"] },
  { act: "undo", keys: ["Ctrl+KeyZ"] },
  { act: "redo", keys: ["Ctrl+Shift+KeyZ", "Ctrl+KeyY"] },
  { act: "next_photo", keys: ["PageDown"] },
  { act: "previous_photo", keys: ["PageUp"] },
  { act: "view_photo", keys: ["F1", "KeyP"] },
  { act: "view_both", keys: ["KeyB"] },
  { act: "view_scene", keys: ["KeyT"] },
  { act: "view_status", keys: ["KeyO"] },
  { act: "tool_prompt", keys: ["Digit1"] },
  { act: "tool_rectangle", keys: ["Digit2"] },
  { act: "tool_lasso", keys: ["Digit3"] },
  { act: "tool_brush", keys: ["Digit4"] },
  { act: "tool_sphere", keys: ["Digit5"] },
  { act: "rule_visible", keys: ["KeyN"] },
  { act: "rule_footprint", keys: ["KeyM"] },
  { act: "transients", keys: ["KeyR"] },
  { act: "part", keys: ["BracketLeft"] },
  { act: "whole", keys: ["BracketRight"] },
  { act: "isolate", keys: ["KeyI"] },
  { act: "hide", keys: ["KeyH"] },
  { act: "rename", keys: ["F2"] },
  { act: "delete", keys: ["Delete"] },
  { act: "through", keys: ["KeyL"] },
  { act: "frame_object", keys: ["KeyF"] },
  { act: "fly", keys: ["KeyV"] },
  { act: "theme", keys: ["KeyC"] },
  { act: "help", keys: ["Shift+Slash", "Slash"] },
  { act: "cursor_left", keys: ["ArrowLeft"], where: "stage" },
  { act: "cursor_right", keys: ["ArrowRight"], where: "stage" },
  { act: "cursor_up", keys: ["ArrowUp"], where: "stage" },
  { act: "cursor_down", keys: ["ArrowDown"], where: "stage" },
  { act: "scene_cursor_left", keys: ["Shift+ArrowLeft"], where: "space" },
  { act: "scene_cursor_right", keys: ["Shift+ArrowRight"], where: "space" },
  { act: "scene_cursor_up", keys: ["Shift+ArrowUp"], where: "space" },
  { act: "scene_cursor_down", keys: ["Shift+ArrowDown"], where: "space" },
  { act: "fine_left", keys: ["Ctrl+ArrowLeft"], where: "both" },
  { act: "fine_right", keys: ["Ctrl+ArrowRight"], where: "both" },
  { act: "fine_up", keys: ["Ctrl+ArrowUp"], where: "both" },
  { act: "fine_down", keys: ["Ctrl+ArrowDown"], where: "both" },
  { act: "click_inside", keys: ["Space"], where: "both" },
  { act: "click_outside", keys: ["KeyX"], where: "both" },
  { act: "intersect", keys: ["Shift+KeyX"], where: "both" },
  { act: "corner", keys: ["KeyK"], where: "stage" },
  { act: "pivot", keys: ["KeyG"], where: "space" },
  { act: "forward", keys: ["KeyW"], where: "space" },
  { act: "back", keys: ["KeyS"], where: "space" },
  { act: "left", keys: ["KeyA"], where: "space" },
  { act: "right", keys: ["KeyD"], where: "space" },
  { act: "down", keys: ["KeyQ"], where: "space" },
  { act: "up", keys: ["KeyE"], where: "space" },
  { act: "turn_left", keys: ["ArrowLeft"], where: "space" },
  { act: "turn_right", keys: ["ArrowRight"], where: "space" },
  { act: "turn_up", keys: ["ArrowUp"], where: "space" },
  { act: "turn_down", keys: ["ArrowDown"], where: "space" },
  { act: "mouse_click", keys: ["Click"], mouse: true },
  { act: "mouse_drag", keys: ["Drag"], mouse: true },
  { act: "mouse_wheel", keys: ["Wheel"], mouse: true },
  { act: "mouse_double", keys: ["Double click"], mouse: true },
  { act: "mouse_tools", keys: ["Shift, Ctrl, both"], mouse: true },
];

/** The table with what each row does, in words. */
export const shortcuts = table.map(s => ({ ...s, does: text(`does_${s.act}`) }));

/** The action of a key, with the focus in `where`. @param {KeyboardEvent} event @param {string} where */
export function actionOf(event, where) {
  const name = (event.ctrlKey || event.metaKey ? "Ctrl+" : "") + (event.shiftKey ? "Shift+" : "") + event.code;
  const fits = (/** @type {Shortcut} */ s) => !s.mouse && s.keys.includes(name);
  const here = (/** @type {Shortcut} */ s) => s.where === where || (s.where === "both" && where !== "");
  return (shortcuts.find(s => fits(s) && here(s)) ?? shortcuts.find(s => fits(s) && !s.where))?.act ?? null;
}

/** A key as a person reads it. @param {string} key */
export function shown(key) {
  return key.replace("Key", "").replace("Digit", "").replace("BracketLeft", "[").replace("BracketRight", "]")
    .replace("Shift+Slash", "?").replace("Slash", "/").replace("Arrow", "").replace("Escape", "Esc");
}

/** The keys of an action, for tooltips. @param {string} act */
export function keysOf(act) {
  const found = shortcuts.find(s => s.act === act);
  return found ? ` (${shown(found.keys[0])})` : "";
}

/** What an action does and its keys, for tooltips; empty where the table has no such action. @param {string} act */
export function tipOf(act) {
  const found = shortcuts.find(s => s.act === act);
  return found ? found.does + keysOf(act) : "";
}
