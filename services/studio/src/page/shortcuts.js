// One table of keys and mouse actions: it makes the sheet, the tooltips and the dispatch; the tests read it too.

/** @typedef {{act: string, keys: string[], does: string, where?: "stage" | "space", mouse?: boolean}} Shortcut */

/** `keys` are codes of keys (`KeyZ`), with `Ctrl+` or `Shift+` before them; `mouse` rows only explain. @type {Shortcut[]} */
export const shortcuts = [
  { act: "keep", keys: ["Enter"], does: "Keep the answer as an object" },
  { act: "drop", keys: ["Escape"], does: "Drop the prompts; show everything again" },
  { act: "undo", keys: ["Ctrl+KeyZ"], does: "Undo" },
  { act: "redo", keys: ["Ctrl+Shift+KeyZ", "Ctrl+KeyY"], does: "Redo" },
  { act: "next_photo", keys: ["PageDown"], does: "Next photo" },
  { act: "previous_photo", keys: ["PageUp"], does: "Previous photo" },
  { act: "view_photo", keys: ["F1", "KeyP"], does: "Photo alone" },
  { act: "view_both", keys: ["KeyB"], does: "Photo and 3D" },
  { act: "view_scene", keys: ["KeyT"], does: "3D alone" },
  { act: "view_status", keys: ["KeyO"], does: "Progress of the run, the batch and the farm" },
  { act: "tool_prompt", keys: ["Digit1"], does: "Tool: click" },
  { act: "tool_rectangle", keys: ["Digit2"], does: "Tool: rectangle" },
  { act: "tool_lasso", keys: ["Digit3"], does: "Tool: lasso" },
  { act: "tool_brush", keys: ["Digit4"], does: "Tool: brush" },
  { act: "tool_sphere", keys: ["Digit5"], does: "Tool: sphere" },
  { act: "rule_visible", keys: ["KeyN"], does: "Tools take only what is visible, or all" },
  { act: "rule_footprint", keys: ["KeyM"], does: "Tools take footprints, or centres" },
  { act: "transients", keys: ["KeyR"], does: "Show the photo's transients; tools paint them" },
  { act: "part", keys: ["BracketLeft"], does: "A smaller part" },
  { act: "whole", keys: ["BracketRight"], does: "A larger whole" },
  { act: "isolate", keys: ["KeyI"], does: "Show the selected object alone, or everything" },
  { act: "hide", keys: ["KeyH"], does: "Hide or show the selected object" },
  { act: "rename", keys: ["F2"], does: "Rename the selected object" },
  { act: "delete", keys: ["Delete"], does: "Delete the selected object" },
  { act: "through", keys: ["KeyL"], does: "Show the scene through this photo's camera" },
  { act: "frame_object", keys: ["KeyF"], does: "Turn the 3D view to the middle of the scene" },
  { act: "fly", keys: ["KeyV"], does: "Orbit or fly" },
  { act: "theme", keys: ["KeyC"], does: "Dark or light" },
  { act: "help", keys: ["Shift+Slash", "Slash"], does: "This sheet" },
  { act: "cursor_left", keys: ["ArrowLeft"], does: "Move the cursor left", where: "stage" },
  { act: "cursor_right", keys: ["ArrowRight"], does: "Move the cursor right", where: "stage" },
  { act: "cursor_up", keys: ["ArrowUp"], does: "Move the cursor up", where: "stage" },
  { act: "cursor_down", keys: ["ArrowDown"], does: "Move the cursor down", where: "stage" },
  { act: "click_inside", keys: ["Space"], does: "Click inside at the cursor", where: "stage" },
  { act: "click_outside", keys: ["KeyX"], does: "Click outside at the cursor", where: "stage" },
  { act: "forward", keys: ["KeyW"], does: "Move forward", where: "space" },
  { act: "back", keys: ["KeyS"], does: "Move back", where: "space" },
  { act: "left", keys: ["KeyA"], does: "Move left", where: "space" },
  { act: "right", keys: ["KeyD"], does: "Move right", where: "space" },
  { act: "down", keys: ["KeyQ"], does: "Move down", where: "space" },
  { act: "up", keys: ["KeyE"], does: "Move up", where: "space" },
  { act: "turn_left", keys: ["ArrowLeft"], does: "Orbit left", where: "space" },
  { act: "turn_right", keys: ["ArrowRight"], does: "Orbit right", where: "space" },
  { act: "turn_up", keys: ["ArrowUp"], does: "Orbit up", where: "space" },
  { act: "turn_down", keys: ["ArrowDown"], does: "Orbit down", where: "space" },
  { act: "", mouse: true, keys: ["Click"], does: "Inside the object; the right button, or Alt, is outside" },
  { act: "", mouse: true, keys: ["Drag"], does: "A box in the photo; orbit in 3D (right button: pan)" },
  { act: "", mouse: true, keys: ["Wheel"], does: "Nearer or farther; with Shift from part to whole" },
  { act: "", mouse: true, keys: ["Double click"], does: "Orbit around this point of the 3D view" },
  { act: "", mouse: true, keys: ["Shift, Ctrl, both"], does: "Tools add, subtract, intersect" },
];

/** The action of a key, with the focus in `where`. @param {KeyboardEvent} event @param {string} where */
export function actionOf(event, where) {
  const name = (event.ctrlKey || event.metaKey ? "Ctrl+" : "") + (event.shiftKey ? "Shift+" : "") + event.code;
  const fits = (/** @type {Shortcut} */ s) => !s.mouse && s.keys.includes(name);
  return (shortcuts.find(s => fits(s) && s.where === where) ?? shortcuts.find(s => fits(s) && !s.where))?.act ?? null;
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
