// Every text of the page, in one file.

/** @type {Record<string, string>} */
export const strings = {
  run: "Run", views: "What is shown", view_photo: "Photo", view_both: "Both", view_scene: "3D", view_status: "Progress",
  tools: "Tool", tool_prompt: "Click", tool_rectangle: "Rectangle", tool_lasso: "Lasso", tool_brush: "Brush", tool_sphere: "Sphere",
  undo: "Undo", redo: "Redo", help: "Keys (?)", undo_of: "Undo: {0}", redo_of: "Redo: {0}",
  photo_pane: "Photo", scene_pane: "3D scene", status_pane: "Progress of the run", answer: "Answer", objects: "Objects",
  listed: "Parts of the scene", notes: "Notes", strip: "Photos", search: "Search photos by name",
  stage: "Photo. Click inside the object, right click outside of it, drag a box. Arrow keys move a cursor, Space clicks inside, X outside.",
  space: "3D scene. Drag to orbit, right drag to pan, wheel to move nearer. Click an object to select it.",
  sort: "Sort", sort_name: "by name", sort_angle: "by angle", only_showing: "only those that show the object",
  frusta: "Cameras", marks: "Colours", rendered_by_server: "Drawn by the server", rendered_by_browser: "Drawn by the browser",
  frame_time: "{0} ms", held_out: "held out", transients: "Transients", train: "Train without them",
  transients_how: "The transients of this photo. Tools add to them, with Ctrl they take away.",
  trained_again: "The scene is trained on without them. It is replaced once that is done.",
  blend: "Appearance of {0}", blend_scene: "the scene", blend_from: "from", blend_to: "to", blend_own: "its own", blend_share: "Share",
  exports: "All objects", save: "Write {0} to the run's folder, with its masks",
  short_save: "write", saving: "“{0}” is being written.", saved: "Written: selections/{0}",
  empty: "Click an object in the photo: left inside, right outside, or drag a box around it.",
  refining: "Prompts of “{0}” are taken up again.",
  working: "Working: {0}", done: "Ready: {0}", failed: "No answer: {0}", splats: "{0} splats, {1} s",
  sure: "{0} % sure.", lopsided_disagrees: "{0} % sure: its other side fits less.", lopsided_unseen: "{0} % sure: its other side was hardly checked.",
  next_click: "One more click helps most in {0}.",
  step_none: "first answer", step_tree: "the scene's tree", step_prompted: "this photo", step_photos: "{0} photos", step_all: "all photos",
  keep: "Keep (Enter)", drop: "Drop (Esc)", level: "Part to whole", level_auto: "automatic", alternatives: "It may also mean",
  alternative_group: "{0} % of the scene", alternative_photo: "what this photo shows", alternative_score: "{0}, score {1}",
  words: "Describe an object", words_find: "Find", words_example: "the dome, all windows",
  no_objects: "Nothing is kept yet.", colour: "Colour of {0}", show: "Show {0}", hide: "Hide {0}", lock: "Lock {0}", unlock: "Unlock {0}",
  isolate: "Show {0} alone", show_all: "Show everything", rename: "Rename {0}", remove: "Delete {0}", duplicate: "Duplicate {0}",
  refine: "Refine {0} by clicks", grow: "Grow {0}", shrink: "Shrink {0}", union: "Add another object to {0}",
  subtract: "Subtract another object from {0}", export_file: "Save {0} as .{1}",
  spikes: "Cut spikes",
  short_hide: "hide", short_show: "show", short_lock: "lock", short_unlock: "unlock", short_alone: "alone", short_refine: "refine",
  short_copy: "duplicate", short_grow: "grow", short_shrink: "shrink", short_union: "add", short_subtract: "subtract",
  short_delete: "delete", short_rename: "rename",
  first_inside: "Click inside the object first.", lost: "The server does not answer. Nothing is lost; the page tries again.",
  opening: "The scene is being loaded.", training: "The scene is being trained. Prompts are possible once it is there.",
  early_pane: "The training", early: "The scene is being trained", early_photos: "{0} photos.", early_step: "Step {0}, {1} splats.",
  curves_pane: "Curves of the training", curve_loss: "Loss", curve_psnr: "PSNR", curve_of: "{0}: from {1} to {2}, steps {3} to {4}",
  trained_to: "The scene after {0} steps of its training. {1}", training_pane: "Training",
  keys: "Keys and mouse", close: "Close", region_new: "A new object is made of what is marked; select an object to change it.",
  rule_centre: "centres", rule_visible: "visible only", rule_footprint: "footprint",
  status_stage: "Stage", status_state: "State", status_done: "Done", status_waits: "Waits for, or why it failed", status_rate: "Rate",
  status_time: "Time", status_actor: "Actor", status_busy: "Busy", status_messages: "Messages", status_retries: "Retries",
  status_given_up: "Given up", status_mailbox: "Mailbox", status_bytes: "Bytes", status_scene: "Scene", status_failures: "Failures",
  status_memory: "Memory", status_left: "{0} left", status_still: "nothing moved for {0}", status_used: "{0} of {1} cores, {2} of {3}",
  retry: "Retry", retry_of: "Retry {0}", retried: "“{0}” is tried again: by the batch that runs, or by the next one.", no_status: "This folder has no run yet.",
  farm: "Farm {0}", farm_rate: "{0} scenes an hour", farm_oldest: "one has waited for {0}", farm_retries: "{0} attempts were retried",
  farm_silences: "{0} leases ran out", farm_past: "{0} scenes done in {1}; at most {2} in {3}", farm_of: "{0} of {1}", farm_cores: "Cores of {0}",
  farm_machine: "Machine", farm_used: "Cores", farm_accelerators: "Accelerators", farm_scenes: "Scenes", farm_seen: "Last seen", farm_hourly: "Scenes an hour",
  farm_silent: "Fell silent", farm_no_machine: "No worker was seen in the last hour.", farm_more: "{0} more scenes are not listed.",
  farm_void: "{0} records of its log are void here: the farm may have another key (--farm-key).", farm_silence: "The farm cannot be read: {0}",
  farm_retried: "“{0}” is tried again by the farm.",
  remove_point: "Remove the click at {0}, {1}", remove_box: "Remove the box",
};

/**
 * A text with its blanks filled.
 * @param {string} name
 * @param {...(string | number)} values
 */
export function text(name, ...values) {
  const found = strings[name];
  if (found === undefined) throw new Error(`no text ${name}`);
  return found.replace(/\{(\d)\}/g, (_, k) => String(values[+k]));
}
