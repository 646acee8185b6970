// The side: the answer, the objects, the scene's own list, the notes.

import { bounds, decode } from "./overlay.js";
import { LEVELS } from "./photos.js";
import { keysOf } from "./shortcuts.js";
import { text } from "./strings.js";
import { curves } from "./training.js";

/** @typedef {import("./main.js").App} App */
/** @typedef {import("./api.js").Item} Item */
/** @typedef {import("./api.js").Run} Run */

const of = (/** @type {string} */ id) => /** @type {HTMLElement} */ (document.getElementById(id));

/**
 * An element.
 * @param {string} name @param {Record<string, any>} [properties] @param {(Node | string)[]} children
 */
export function element(name, properties = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(properties)) {
    if (key.startsWith("aria-") || key === "role") made.setAttribute(key, String(value));
    else if (key === "click") made.addEventListener("click", value);
    else /** @type {any} */ (made)[key] = value;
  }
  made.append(...children);
  return made;
}

/** @param {string} shown @param {string} label @param {() => void} click @param {Record<string, any>} [properties] */
const button = (shown, label, click, properties = {}) =>
  element("button", { type: "button", title: label, "aria-label": label, click, ...properties }, shown);

/** The side of the page. */
export class Side {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    /** Thumbnails by object and selection. @type {Map<string, HTMLCanvasElement>} */
    this.thumbs = new Map();
    this.renaming = /** @type {number | null} */ (null);
    this.rendered = { answer: "", objects: "", listed: "" };
    /** Objects that are to be written, or are being written, by this page. @type {Set<string>} */
    this.writes = new Set();
    /** The end of the last one. @type {Promise<void>} */
    this.written = Promise.resolve();
    const words = /** @type {HTMLInputElement} */ (of("words-text"));
    words.placeholder = text("words_example");
    of("words").addEventListener("submit", event => {
      event.preventDefault();
      if (words.value.trim()) app.act({ do: "text", text: words.value.trim(), alternative: 0 });
    });
  }

  update() {
    of("words").hidden = !this.app.description?.texts;
    this.answer();
    this.objects();
    this.listed();
    of("notes").replaceChildren(...(this.app.state?.notes ?? []).map(note => element("p", {}, note)));
  }

  /** In words, what an answer comes from. @param {any} step @param {string} state */
  step(step, state) {
    if (state === "done" || step === "selected") return text("step_all");
    if (step && typeof step === "object") return text("step_photos", step.photos);
    return step ? text(`step_${step}`) : text("step_none");
  }

  /** In words, how sure an answer is. @param {import("./api.js").Confidence} confidence */
  sure({ value, lopsided, next_click }) {
    const sure = text(lopsided ? `lopsided_${lopsided}` : "sure", (100 * value).toFixed(0));
    const photo = next_click === null ? undefined : this.app.description.photos[next_click];
    return photo ? `${sure} ${text("next_click", photo.name)}` : sure;
  }

  answer() {
    const { app } = this, { state } = app;
    if (!state) return;
    const { answer, draft } = state;
    const key = JSON.stringify([answer, draft, app.level]);
    if (key === this.rendered.answer) return;
    this.rendered.answer = key;
    const parts = [element("h2", {}, text("answer"))];
    if (draft.of !== null) {
      const item = state.objects.find(o => o.id === draft.of);
      parts.push(element("p", { className: "quiet" }, text("refining", item?.name ?? "")));
    }
    if (answer.state === "none") parts.push(element("p", { className: "quiet" }, text("empty")));
    else if (answer.state === "failed") {
      parts.push(element("p", {}, text("failed", answer.error ?? "")));
      if (state.undo === "prompt") parts.push(button(text("take_back"), text("take_back"), () => app.do("undo"), { id: "take-back" }));
    }
    else {
      // The object is the last one while it is being computed how sure it is.
      const measured = answer.state === "done", busy = !measured && answer.step !== "selected";
      parts.push(element("p", { className: busy ? "busy" : "" }, text(busy ? "working" : "done", this.step(answer.step, answer.state))));
      if (answer.splats) parts.push(element("p", { className: "quiet" }, text("splats", answer.splats, answer.seconds.toFixed(2))));
      if (!busy) parts.push(element("p", { className: "quiet" }, text("done_how")));
      if (answer.confidence) parts.push(element("p", { className: "quiet", id: "sure" }, this.sure(answer.confidence)));
      else if (!busy && !measured) parts.push(element("p", { className: "quiet busy" }, text("sure_soon")));
    }
    if (answer.state !== "none") {
      const keep = button(text("keep"), text("keep"), () => app.do("keep"), { id: "keep", className: "main", disabled: !answer.splats });
      const drop = button(text("drop"), text("drop"), () => app.do("drop"), { id: "drop" });
      parts.push(element("p", { className: "row" }, keep, drop));
    }
    const level = /** @type {HTMLInputElement} */ (element("input", {
      type: "range", min: "0", max: String(LEVELS.length - 1), step: "1", value: String(LEVELS.indexOf(app.level)), id: "level",
      "aria-label": text("level"), "aria-valuetext": app.level === null ? text("level_auto") : String(app.level),
    }));
    level.addEventListener("change", () => app.setLevel(LEVELS[+level.value]));
    const named = app.level === null ? text("level_auto") : `${100 * app.level} %`;
    parts.push(element("label", { className: "row" }, element("span", { className: "quiet" }, text("level")), level, named));
    if (answer.alternatives.length > 1) {
      const chips = answer.alternatives.map((alternative, k) => {
        const [kind, of] = typeof alternative === "object" ? Object.entries(alternative)[0] : [alternative, 0];
        const share = text(`alternative_${kind}`, (100 * of).toFixed(1));
        const shown = k < answer.scores.length ? text("alternative_score", share, answer.scores[k].toFixed(2)) : share;
        return button(shown, shown, () => app.alternative(k), { "aria-pressed": k === draft.alternative });
      });
      parts.push(element("p", { className: "quiet" }, text("alternatives")), element("div", { className: "row" }, ...chips));
    }
    of("answer").replaceChildren(...parts);
  }

  objects() {
    const { app } = this, { state } = app;
    if (!state) return;
    const key = JSON.stringify([state.objects, state.isolated, state.appearance, state.cut_spikes, this.saving().map(save => save.object), app.item, this.renaming, app.photo]);
    if (key === this.rendered.objects) return this.progress();
    this.rendered.objects = key;
    const focus = document.activeElement?.getAttribute("data-focus");
    const rows = state.objects.map((item, k) => this.row(item, k));
    const spikes = element("label", { className: "row" },
      element("input", { type: "checkbox", id: "spikes", checked: state.cut_spikes, click: () => app.act({ do: "cut_spikes", cut: !state.cut_spikes }) }),
      text("spikes"));
    const parts = [element("h2", {}, text("objects"))];
    if (!rows.length) parts.push(element("p", { className: "quiet" }, text("no_objects")));
    if (state.isolated !== null) {
      parts.push(button(text("show_all"), text("show_all"), () => app.act({ do: "isolate", id: null }), { id: "show-all" }));
    }
    parts.push(element("ul", {}, ...rows), spikes, this.blend());
    if (rows.length) {
      const file = (/** @type {string} */ name) => element("a", { href: `${app.run.base}/export/${name}`, download: "" }, name);
      parts.push(element("p", { className: "row" }, text("exports"), file("labels.ply"), file("coco.json"), file("masks.zip")));
    }
    of("objects").replaceChildren(...parts);
    if (focus) /** @type {HTMLElement | null} */ (document.querySelector(`[data-focus="${focus}"]`))?.focus();
    if (this.renaming !== null) /** @type {HTMLInputElement | null} */ (document.getElementById("new-name"))?.select();
  }

  /** The key of an object that this page writes. @param {Run} run @param {number} id */
  writeKey(run, id) {
    return `${run.base}/${id}`;
  }

  /** How far the objects are that are being written, and those that wait for it, here or in the server. */
  saving() {
    const { run, state, description } = this.app, known = state?.saving ?? [];
    const waiting = (state?.objects ?? []).map(item => item.id).filter(id =>
      this.writes.has(this.writeKey(run, id)) && !known.some(save => save.object === id));
    return [...known, ...waiting.map(object => ({ object, done: 0, photos: description.photos.length }))];
  }

  /** Shows how far they are, in what is shown already: a name that is being typed stays. */
  progress() {
    for (const { object, done, photos } of this.saving()) {
      const bar = /** @type {HTMLProgressElement | null} */ (document.querySelector(`progress[data-object="${object}"]`));
      if (!bar) continue;
      bar.max = photos;
      bar.value = done;
      if (bar.nextElementSibling) bar.nextElementSibling.textContent = text("saved_photos", done, photos);
    }
  }

  /** @param {Item} item @param {number} k */
  row(item, k) {
    const { app } = this, { state } = app, selected = app.item === item.id;
    const act = (/** @type {string} */ name, more = {}) => app.act({ do: name, id: item.id, ...more });
    const colour = button("", text("colour", item.name), () => act("colour", { colour: (item.colour + 1) % app.description.palette.length }), { className: "swatch" });
    colour.style.setProperty("--swatch", `rgb(${app.description.palette[item.colour].join()})`);
    const name = this.renaming === item.id
      ? this.nameInput(item)
      : element("button", {
        type: "button", className: "name", title: item.name, "aria-pressed": selected,
        click: () => app.select(selected ? null : item.id), ondblclick: () => this.rename(item.id),
      }, item.name);
    name.setAttribute("data-focus", `name-${item.id}`);
    const head = element("div", { className: "row" }, this.thumb(item, k), colour, name,
      element("span", { className: "quiet" }, String(item.splats)));
    const small = (/** @type {string} */ id, /** @type {() => void} */ click, /** @type {Record<string, any>} */ more = {}) =>
      button(text(`short_${id}`), text(more.label ?? id, item.name), click, more);
    const saving = this.saving().find(save => save.object === item.id), tools = element("div", { className: "row" },
      small(item.visible ? "hide" : "show", () => act("show", { visible: !item.visible })),
      small("alone", () => act("isolate", { id: state?.isolated === item.id ? null : item.id }), { label: "isolate", "aria-pressed": state?.isolated === item.id }));
    tools.append(element("span", { className: "quiet" }, text("save_as")));
    const file = (/** @type {string} */ name, /** @type {string} */ shown, /** @type {string} */ label) => {
      const link = element("a", { href: app.run.file(item.id, name), download: "", title: label },
        element("button", { type: "button", tabIndex: -1 }, shown));
      link.setAttribute("aria-label", label);
      tools.append(link);
    };
    for (const format of selected ? ["ply", "spz", "glb"] : ["ply"]) file(format, `.${format}`, text("export_file", item.name, format));
    if (selected) {
      file("masks.zip", text("short_masks"), text("export_masks", item.name));
      file("coco.json", text("short_coco"), text("export_coco", item.name));
    }
    const made = item.edited || !item.prompted, refused = { disabled: true, title: text("made_by_tool") };
    if (selected && made) tools.append(button(text("short_prompts"), text("save_prompts", item.name), () => {}, refused));
    else if (selected) file("prompts", text("short_prompts"), text("save_prompts", item.name));
    if (selected) {
      const pair = (/** @type {string} */ how) => {
        const others = (state?.objects ?? []).filter(o => o.id !== item.id);
        const choice = /** @type {HTMLSelectElement} */ (element("select", { "aria-label": text(how, item.name), title: text(how, item.name) }));
        choice.append(new Option(`${text(`short_${how}`)}…`, ""), ...others.map(o => new Option(o.name, String(o.id))));
        const verb = how === "union" ? "add" : "subtract";
        choice.addEventListener("change", () => act("combine", { with: +choice.value, how: verb }));
        return choice;
      };
      tools.append(
        small(item.locked ? "unlock" : "lock", () => act("lock", { locked: !item.locked })),
        small("rename", () => this.rename(item.id)),
        ...(item.prompted ? [small("refine", () => act("refine"))] : []),
        small("copy", () => act("duplicate"), { label: "duplicate" }),
        small("grow", () => act("grow", { steps: 1 })),
        small("shrink", () => act("grow", { steps: -1 })),
        ...(saving ? [] : [small("save", () => this.save(item), made ? refused : {})]),
        ...((state?.objects.length ?? 0) > 1 ? [pair("union"), pair("subtract")] : []),
        small("delete", () => act("delete"), { label: "remove" }));
    }
    const parts = [head, tools];
    if (selected && made) parts.push(element("p", { className: "quiet" }, text("made_by_tool")));
    if (saving) {
      const bar = element("progress", { value: saving.done, max: saving.photos, "aria-label": text("saving", item.name) });
      bar.dataset.object = String(item.id);
      parts.push(element("div", { className: "row" }, bar,
        element("span", { className: "quiet" }, text("saved_photos", saving.done, saving.photos)),
        small("stop_save", () => this.stopSave(item))));
    }
    return element("li", { className: selected ? "selected" : "" }, ...parts);
  }

  /** Chooses the appearance of the selected object, or of the scene where none is selected: from one to another. */
  blend() {
    const { app } = this, item = app.selected(), now = (item ? item.appearance : app.state?.appearance) ?? { photo: null, towards: null, share: 0 };
    const id = item?.id ?? null, name = item?.name ?? text("blend_scene");
    const act = (/** @type {object} */ change) => app.act({ do: "appearance", id, ...now, ...change });
    const choose = (/** @type {"photo" | "towards"} */ key, /** @type {string} */ label) => {
      const select = /** @type {HTMLSelectElement} */ (element("select", { "aria-label": `${text("blend", name)}: ${text(label)}` }));
      select.append(new Option(text("blend_own"), "", false, now[key] === null));
      app.description.photos.forEach((photo, i) => {
        if (!photo.held_out) select.append(new Option(photo.name, String(i), false, now[key] === i));
      });
      select.addEventListener("change", () => act({ [key]: select.value === "" ? null : +select.value }));
      return element("label", { className: "row" }, element("span", { className: "quiet" }, text(label)), select);
    };
    const label = `${text("blend", name)}: ${text("blend_share")}`;
    const share = /** @type {HTMLInputElement} */ (element("input", { type: "range", min: "0", max: "1", step: "0.05", value: String(now.share), "aria-label": label }));
    share.addEventListener("change", () => act({ share: +share.value }));
    return element("fieldset", { id: "blend" }, element("legend", {}, text("blend", name)), choose("photo", "blend_from"), choose("towards", "blend_to"), share);
  }

  /** Writes an object to the run's folder. One request at a time: a browser has six connections to a server. @param {Item} item */
  save(item) {
    const { app } = this, { run } = app, key = this.writeKey(run, item.id);
    if (this.writes.has(key)) return;
    this.writes.add(key);
    app.say(text("saving", item.name));
    this.written = this.written.then(async () => {
      // It may have been stopped while it waited.
      if (!this.writes.has(key)) return;
      await run.save(item.id).then(({ selection }) => app.say(text("saved", selection)), error => app.failed(error));
      this.writes.delete(key);
      this.objects();
    });
    this.objects();
  }

  /** Ends the writing of an object, or takes it out of those that wait. @param {Item} item */
  stopSave(item) {
    const { app } = this;
    if (app.state?.saving.some(save => save.object === item.id)) return app.act({ do: "stop_save", id: item.id });
    this.writes.delete(this.writeKey(app.run, item.id));
    this.objects();
  }

  /** @param {number} id */
  rename(id) {
    this.renaming = id;
    this.app.select(id);
    this.objects();
  }

  /** @param {Item} item */
  nameInput(item) {
    const input = /** @type {HTMLInputElement} */ (element("input", { id: "new-name", value: item.name, maxLength: 80, "aria-label": text("rename", item.name) }));
    const end = (/** @type {boolean} */ keep) => {
      if (this.renaming === null) return;
      this.renaming = null;
      const name = input.value.trim();
      if (keep && name && name !== item.name) this.app.act({ do: "rename", id: item.id, name });
      this.objects();
    };
    input.addEventListener("keydown", event => {
      event.stopPropagation();
      if (event.key === "Enter" || event.key === "Escape") end(event.key === "Enter");
    });
    input.addEventListener("blur", () => end(true));
    return input;
  }

  /** The part of a photo that shows an object. @param {Item} item @param {number} k */
  thumb(item, k) {
    const key = `${item.id}/${item.selection}`, known = this.thumbs.get(key);
    if (known) return known;
    const canvas = /** @type {HTMLCanvasElement} */ (element("canvas", { className: "thumb", width: 88, height: 88, "aria-hidden": true }));
    this.thumbs.set(key, canvas);
    if (this.thumbs.size > 300) this.thumbs.clear();
    this.drawThumb(canvas, item, k).catch(() => this.thumbs.delete(key));
    return canvas;
  }

  /** @param {HTMLCanvasElement} canvas @param {Item} item @param {number} k */
  async drawThumb(canvas, item, k) {
    const { app } = this, counts = await app.photosOf(item), best = counts.indexOf(Math.max(...counts));
    if (!counts[best]) return;
    const map = await app.run.labels(best), image = new Image();
    image.src = app.run.photo(best, 480);
    await image.decode();
    const box = bounds(decode(map), map.width, k + 1) ?? [0, 0, map.width, map.height];
    const side = Math.max(box[2] - box[0], box[3] - box[1]) * 1.3, s = image.width / map.width;
    const [x, y] = [(box[0] + box[2] - side) / 2, (box[1] + box[3] - side) / 2];
    canvas.getContext("2d")?.drawImage(image, x * s, y * s, side * s, side * s, 0, 0, canvas.width, canvas.height);
  }

  listed() {
    const { app } = this, list = app.description?.listed ?? [], chosen = app.state?.draft.listed;
    const key = `${app.run.name}/${list.length}/${chosen}`;
    if (key === this.rendered.listed || !app.state) return;
    this.rendered.listed = key;
    if (!list.length) return of("listed").replaceChildren();
    // The sheet has six columns of thumbnails of 160 pixels, 4 apart; a tile shows one at 72 pixels.
    const step = 164, scale = 72 / 160, columns = Math.min(list.length, 6);
    const tiles = list.map(object => {
      const k = object.number - 1, tile = element("span", { className: "tile" });
      const offset = (/** @type {number} */ at) => `${-(4 + at * step) * scale}px`;
      tile.style.backgroundImage = `url("${app.run.base}/sheet")`;
      tile.style.backgroundSize = `${(columns * step + 4) * scale}px auto`;
      tile.style.backgroundPosition = `${offset(k % 6)} ${offset(Math.floor(k / 6))}`;
      const choose = () => app.openPhoto(object.photo).then(() => app.act({ do: "listed", number: object.number }));
      return element("li", {}, element("button", { type: "button", "aria-pressed": chosen === object.number, click: choose }, tile, object.name));
    });
    of("listed").replaceChildren(element("h2", {}, text("listed")), element("ul", {}, ...tiles));
  }

  /** Says how far the training is. @param {string} words @param {import("./api.js").Moment[]} history */
  training(words, history) {
    of("training").textContent = words;
    of("curves").replaceChildren(...curves(history));
  }

  /** Tooltips of buttons that undo and redo. */
  undo() {
    const { state } = this.app;
    for (const name of ["undo", "redo"]) {
      const button = /** @type {HTMLButtonElement} */ (of(name)), what = state?.[/** @type {"undo" | "redo"} */ (name)];
      button.disabled = !what;
      button.title = what ? text(`${name}_of`, what) + keysOf(name) : "";
    }
  }
}
