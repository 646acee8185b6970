// The page: one state from the server, shown by the panes; what a person does goes back as actions.

import { Refused, Run, getJson } from "./api.js";
import { FINE, STEP } from "./cursor.js";
import { centreOf, cross, dot, scaled, subtract, unit } from "./geometry.js";
import { Side, element } from "./objects.js";
import { ANSWER, bounds, decode, nearest } from "./overlay.js";
import { LEVELS, PhotoPane, Strip } from "./photos.js";
import { ScenePane } from "./scene.js";
import { actionOf, keysOf, shortcuts, shown, tipOf } from "./shortcuts.js";
import { StatusPane } from "./status.js";
import { text } from "./strings.js";
import { RADIUS, SIZED, TOOLS } from "./tools.js";
import { TrainingPane } from "./training.js";

/** @typedef {import("./api.js").State} State */
/** @typedef {import("./api.js").Prompts} Prompts */
/** @typedef {import("./api.js").Point} Point */
/** @typedef {import("./api.js").Item} Item */

const of = (/** @type {string} */ id) => /** @type {HTMLElement} */ (document.getElementById(id));
/** What keys do where there is no run. */
const WITHOUT_RUN = ["theme", "help"];
/** Milliseconds between two tries of a scene that is not there yet: at most, and at first. */
const AGAIN = 150;
const SOON = 20;
/** Milliseconds between two questions how far a training is. */
const TRAINING = 2000;
/** Milliseconds that a message stays. */
const MESSAGE = 6000;

/** The page. */
export class App {
  constructor() {
    this.run = new Run("");
    this.description = /** @type {import("./api.js").Description} */ (/** @type {unknown} */ (null));
    this.state = /** @type {State | null} */ (null);
    this.photo = 0;
    this.tool = "prompt";
    this.rule = "centre";
    this.level = /** @type {number | null} */ (null);
    this.item = /** @type {number | null} */ (null);
    this.radius = RADIUS.first;
    /** The object that is being kept, -1 for a new one. @type {number | null} */
    this.keeping = null;
    /** Whether the photo shows its transients, and tools paint them. */
    this.transients = false;
    this.view = "both";
    /** Keys that are down. @type {Set<string>} */
    this.held = new Set();
    /** What was measured last, in milliseconds. @type {Record<string, number>} */
    this.times = {};
    /** What was shown first, in milliseconds after the page was opened. @type {Record<string, number>} */
    this.first = {};
    /** Pixels of objects by photo, by object and selection. @type {Map<string, Promise<number[]>>} */
    this.counts = new Map();
    /** Ends their requests with the run. */
    this.counting = new AbortController();
    this.photoPane = new PhotoPane(this);
    this.strip = new Strip(this);
    this.scenePane = new ScenePane(this);
    this.side = new Side(this);
    this.statusPane = new StatusPane(this);
    this.trainingPane = new TrainingPane(this);
    /** Whether the run has no scene yet. */
    this.waiting = false;
  }

  /** @param {string} what */
  ready(what) {
    this.first[what] ??= performance.now();
  }

  async start() {
    fillTexts();
    this.makeTools();
    this.listen();
    this.setView(matchMedia("(max-width: 700px)").matches ? "photo" : "both");
    const runs = await getJson("/api/v1/runs");
    const choice = /** @type {HTMLSelectElement} */ (of("runs"));
    for (const run of runs) choice.append(new Option(run.name, run.name));
    choice.addEventListener("change", () => this.open(choice.value));
    const wanted = decodeURIComponent(location.hash.slice(1));
    const name = runs.some((/** @type {any} */ run) => run.name === wanted) ? wanted : runs[0]?.name;
    if (!name) return this.showOperators();
    choice.value = name;
    await this.open(name);
  }

  /** Shows what operators see, where there is no run to show. */
  showOperators() {
    document.body.dataset.runs = "none";
    this.setView("status");
  }

  /** Opens a run; waits for one that is still trained or loaded. @param {string} name */
  async open(name) {
    this.source?.close();
    clearTimeout(this.trainingTimer);
    const same = this.run.name === name && this.description ? this.photo : null;
    this.state = null;
    this.run = new Run(name);
    delete document.body.dataset.runs;
    location.hash = encodeURIComponent(name);
    const { run } = this;
    let early = false, pause = SOON;
    for (;;) {
      try {
        this.description = await run.describe();
        break;
      } catch (error) {
        if (run !== this.run) return;
        const state = error instanceof Refused ? error.body?.state : null;
        this.say(state === "training" ? text("training") : state === "opening" ? text("opening") : String(/** @type {any} */ (error).message), true);
        if (state === "training") {
          const there = await this.trainingPane.show();
          if (run !== this.run) return;
          if (there && !early) {
            early = true;
            this.waits(true);
            if (this.view === "status") this.setView("both");
          } else if (!there && !early && this.view !== "status") this.setView("status");
        }
        const wait = state === "training" ? 10 * AGAIN : pause;
        await new Promise(done => setTimeout(done, wait));
        pause = Math.min(AGAIN, 2 * pause);
      }
    }
    this.say("");
    document.title = `segwild · ${name}`;
    this.photo = same ?? Math.max(0, this.description.photos.findIndex(photo => !photo.held_out));
    this.item = null;
    this.counts.clear();
    this.counting.abort();
    this.counting = new AbortController();
    this.scenePane.drawer = null;
    this.scenePane.forget();
    this.strip.shownFor = "";
    this.strip.showing = null;
    this.strip.draw();
    this.photoPane.open();
    if (same === null) this.scenePane.through(this.photo);
    else this.scenePane.redraw();
    this.waits(false);
    if (this.view === "status") this.setView("both");
    let connected = true;
    this.source = run.follow(state => this.update(state), now => {
      if (now !== connected) this.say(now ? "" : text("lost"), !now);
      connected = now;
    }, () => run === this.run && this.open(name));
    this.followTraining();
  }

  /** While the scene is trained: asks for newer ones, and says how far it is. */
  async followTraining() {
    const { run, description } = this;
    if (description.snapshot === null) return this.side.training("", []);
    const training = await run.training().catch(() => null), view = await getJson(`/api/v1/status?run=${encodeURIComponent(run.name)}`).catch(() => null);
    const stages = view?.stages ?? [], busy = stages.filter((/** @type {any} */ s) => s.state === "running");
    const words = busy.map((/** @type {any} */ s) => `${s.name} ${s.done}/${s.total}`).join(", ");
    if (run !== this.run) return;
    this.side.training(text("trained_to", description.snapshot, words), training?.history ?? []);
    try {
      const { snapshot } = await run.describe();
      if (run !== this.run) return;
      if (snapshot !== description.snapshot) return this.open(run.name);
    } catch {
      if (run === this.run) return this.open(run.name);
      return;
    }
    this.trainingTimer = setTimeout(() => this.followTraining(), TRAINING);
  }

  /** Takes a new state. @param {State} state */
  update(state) {
    // Of one revision there are several, while objects are written: an older one may come later.
    if (this.state && state.sequence < this.state.sequence) return;
    const moved = state.revision !== this.state?.revision;
    // What this page keeps is selected as soon as it is there, whichever way the state came.
    if (this.keeping !== null && (this.keeping > 0 || state.objects.length > (this.state?.objects.length ?? 0))) {
      this.item = this.keeping > 0 ? this.keeping : state.objects.at(-1)?.id ?? null;
      this.keeping = null;
      const kept = state.objects.find(item => item.id === this.item);
      if (kept) this.say(text("kept", kept.name));
    }
    this.state = state;
    if (this.item !== null && !state.objects.some(item => item.id === this.item)) this.item = null;
    this.side.update();
    this.side.undo();
    this.photoPane.update();
    if (this.photoPane.requests) this.scenePane.clearCandidate();
    this.strip.update();
    if (moved) this.scenePane.redraw(true);
    of("train").hidden = !state.corrected.length;
    document.body.dataset.answer = state.answer.state;
  }

  /** Sends an action. @param {object} action */
  async act(action) {
    try {
      this.update(await this.run.act(action));
    } catch (error) {
      this.keeping = null;
      this.failed(error);
    }
  }

  /** @param {unknown} error */
  failed(error) {
    if (error instanceof Refused) return this.say(error.message);
    if (error instanceof DOMException && error.name === "AbortError") return;
    this.say(error instanceof TypeError ? text("lost") : String(error));
    if (!(error instanceof TypeError)) console.error(error);
  }

  /** Shows a message. @param {string} words @param {boolean} [stays] */
  say(words, stays) {
    of("message").textContent = words;
    clearTimeout(this.silence);
    if (words && !stays) this.silence = setTimeout(() => this.say(""), MESSAGE);
  }

  /** @param {"photo" | "scene"} pane */
  shows(pane) {
    return !this.waiting && (this.view === "both" || this.view === pane);
  }

  /** Shows the training in the stead of photo and scene, or no longer. @param {boolean} waiting */
  waits(waiting) {
    if (waiting === this.waiting) return;
    this.waiting = waiting;
    this.setView(this.view);
  }

  /** @param {string} view */
  setView(view) {
    this.view = view;
    document.body.dataset.view = view;
    of("photo").hidden = !this.shows("photo");
    of("scene").hidden = !this.shows("scene");
    of("early").hidden = !this.waiting || view === "status";
    of("status").hidden = view !== "status";
    for (const button of of("views").querySelectorAll("button")) {
      button.setAttribute("aria-pressed", String(button.dataset.view === view));
    }
    if (view === "status") this.statusPane.show();
    if (!this.description) return;
    this.photoPane.layout();
    this.photoPane.update();
    this.scenePane.redraw();
  }

  /** @param {string} tool */
  setTool(tool) {
    this.tool = tool;
    for (const button of of("tools").querySelectorAll("button")) {
      button.setAttribute("aria-pressed", String(button.dataset.tool === tool));
    }
    of("rule").hidden = tool === "prompt" || tool === "sphere";
    if (!this.description) return;
    for (const pane of [this.photoPane, this.scenePane]) {
      pane.clearCandidate();
      pane.cursor.end();
    }
    const is = text("tool_now", text(`tool_${tool}`)), makes = tool !== "prompt" && this.item === null && !this.transients;
    this.say(makes ? `${is} ${text("region_new")}` : is);
  }

  makeTools() {
    for (const tool of TOOLS) {
      const button = element("button", { type: "button", click: () => this.setTool(tool) }, text(`tool_${tool}`));
      button.dataset.tool = tool;
      const tip = tipOf(`tool_${tool}`);
      button.title = tool === "prompt" ? tip : text("tool_how", tip);
      of("tools").append(button);
    }
    const rule = element("button", { type: "button", id: "rule", title: text("rule_how"), click: () => this.nextRule() }, text("rule_centre"));
    of("tools").append(rule);
    this.setTool("prompt");
  }

  /** @param {string} [rule] */
  nextRule(rule) {
    const all = ["centre", "visible", "footprint"];
    this.rule = rule ? (this.rule === rule ? "centre" : rule) : all[(all.indexOf(this.rule) + 1) % 3];
    of("rule").textContent = text(`rule_${this.rule}`);
    this.say(text("rule_now", text(`rule_${this.rule}`)));
  }

  /** Colour of an object's label. @param {number} label */
  colourOf(label) {
    const item = this.state?.objects[label - 1];
    return item ? this.description.palette[item.colour] : null;
  }

  selected() {
    return this.state?.objects.find(item => item.id === this.item) ?? null;
  }

  /** @param {number | null} id */
  select(id) {
    this.item = id;
    this.side.update();
    this.strip.update();
  }

  /** Pixels of each photo that show an object. @param {Item} item */
  photosOf(item) {
    const key = `${item.id}/${item.selection}`;
    let found = this.counts.get(key);
    if (!found) {
      found = this.run.photosOf(item.id, this.counting.signal);
      this.counts.set(key, found);
      found.catch(() => this.counts.delete(key));
    }
    return found;
  }

  /** The angle from which a photo sees the scene, around its up direction. @param {number} i */
  angleOf(i) {
    const { centre, up, photos } = this.description, from = subtract(centreOf(photos[i]), centre);
    const east = unit(cross(up, Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0])), north = cross(up, east);
    return Math.atan2(dot(from, north), dot(from, east));
  }

  /** @param {number} photo */
  async openPhoto(photo) {
    this.photo = photo;
    this.photoPane.open();
    this.strip.mark();
    this.side.update();
    this.scenePane.drawCameras();
  }

  /**
   * The prompts of the draft with those of a photo changed. What failed by its only prompt is replaced by what selects something: with
   * it, every answer would fail.
   * @param {number} photo @param {(of: Prompts) => void} change @param {boolean} [selects]
   */
  prompt(photo, change, selects) {
    if (!this.state) return;
    const { draft, answer } = this.state, count = draft.prompts.reduce((sum, p) => sum + p.points.length + p.boxes.length, 0);
    const prompts = selects && answer.state === "failed" && count === 1 ? [] : structuredClone(draft.prompts);
    let own = prompts.find(p => p.photo === photo);
    if (!own) {
      own = { photo, points: [], boxes: [], granularity: this.level };
      prompts.push(own);
    }
    // A further prompt corrects the answer that is shown.
    const corrects = prompts.some(p => p.boxes.length || p.points.some(point => point.inside));
    change(own);
    for (const p of prompts) p.granularity = this.level;
    this.act({ do: "prompt", prompts, alternative: corrects ? this.state.draft.alternative : 0 });
  }

  /** @param {number} photo @param {number[]} at @param {boolean} inside */
  addPoint(photo, at, inside) {
    const any = this.state?.draft.prompts.some(p => p.boxes.length || p.points.some(point => point.inside));
    if (!inside && !any) return this.say(text("first_inside"));
    this.prompt(photo, own => own.points.push({ x: at[0], y: at[1], inside }), inside);
  }

  /** @param {number} photo @param {number[]} a @param {number[]} b */
  addBox(photo, a, b) {
    const { camera } = this.description.photos[photo];
    const clamp = (/** @type {number} */ v, /** @type {number} */ side) => Math.min(side - 1e-3, Math.max(0, v));
    const [x0, y0, x1, y1] = [clamp(a[0], camera.width), clamp(a[1], camera.height), clamp(b[0], camera.width), clamp(b[1], camera.height)];
    this.prompt(photo, own => own.boxes.push({ x0, y0, x1, y1 }), true);
  }

  /** @param {number} photo @param {Point} point */
  removePoint(photo, point) {
    this.prompt(photo, own => {
      own.points = own.points.filter(p => p.x !== point.x || p.y !== point.y);
    });
  }

  /** @param {number} photo @param {import("./api.js").Box} box */
  removeBox(photo, box) {
    this.prompt(photo, own => {
      own.boxes = own.boxes.filter(b => b.x0 !== box.x0 || b.y0 !== box.y0 || b.x1 !== box.x1 || b.y1 !== box.y1);
    });
  }

  /** @param {number} alternative */
  alternative(alternative) {
    const draft = this.state?.draft;
    if (draft?.text) this.act({ do: "text", text: draft.text, alternative });
    else if (draft) this.act({ do: "prompt", prompts: draft.prompts, alternative });
  }

  /** From part to whole; with a tool that has a size, that size. @param {number} steps */
  changeLevel(steps) {
    if (SIZED.includes(this.tool)) {
      this.radius = Math.min(RADIUS.most, Math.max(RADIUS.least, this.radius * RADIUS.step ** steps));
      this.photoPane.preview();
      this.scenePane.preview();
      return this.say(text("radius", (200 * this.radius).toFixed(1)));
    }
    const at = LEVELS.indexOf(this.level) + steps;
    this.setLevel(LEVELS[Math.min(LEVELS.length - 1, Math.max(0, at))]);
  }

  /** @param {number | null} level */
  setLevel(level) {
    if (level === this.level) return;
    this.level = level;
    this.side.update();
    const photo = this.state?.draft.prompts[0]?.photo;
    if (photo !== undefined) this.prompt(photo, () => {});
    else {
      this.photoPane.hover();
      this.scenePane.hover();
    }
  }

  /**
   * Changes the selected object by a region, or makes a new one.
   * @param {string} tool @param {number[][]} path @param {import("./api.js").View} view @param {number} radius
   * @param {import("./tools.js").Modifiers} event
   */
  async region(tool, path, view, radius, event) {
    const [a, b] = [path[0], path[path.length - 1]];
    const shapes = {
      rectangle: { shape: "polygon", points: [[a[0], a[1]], [b[0], a[1]], [b[0], b[1]], [a[0], b[1]]] },
      lasso: { shape: "polygon", points: path },
      brush: { shape: "brush", points: path, radius },
      sphere: { shape: "sphere", at: b, radius },
    };
    /** @type {{shape: string, points?: number[][], at?: number[], radius?: number}} */
    const region = shapes[/** @type {keyof typeof shapes} */ (tool)];
    const ctrl = event.ctrlKey || event.metaKey;
    const how = ctrl && event.shiftKey ? "intersect" : ctrl ? "subtract" : "add";
    if (this.transients && region.shape !== "sphere") return this.act({ do: "transients", photo: this.photo, region, how });
    // A photo may be larger than a view that the server renders.
    const long = Math.max(view.camera.width, view.camera.height), s = Math.min(1, 1024 / long);
    const camera = { ...view.camera, width: Math.round(view.camera.width * s), height: Math.round(view.camera.height * s) };
    for (const key of /** @type {const} */ (["fx", "fy", "cx", "cy"])) camera[key] *= s;
    const small = (/** @type {number[]} */ p) => [p[0] * s, p[1] * s];
    if (region.points) region.points = region.points.map(small);
    if (region.at) region.at = small(region.at);
    if (region.radius) region.radius *= s;
    return this.act({ do: "region", id: this.item, view: { ...view, camera }, region, how, rule: this.rule });
  }

  /** Turns the 3D view to the answer or the selected object, so near that it fills the view; without one to the scene. */
  async frameObject() {
    const found = await this.objectInPhoto().catch(error => this.failed(error));
    if (found) this.scenePane.frame(found.point, found.radius);
    else this.scenePane.frameScene();
  }

  /** A point of the answer or the selected object, and the object's radius as a photo shows it; null where no photo shows it. */
  async objectInPhoto() {
    const { state, run, description } = this, item = this.selected(), answer = Boolean(state?.answer.splats);
    if (!state || !(answer || item)) return null;
    const label = answer ? ANSWER : state.objects.findIndex(o => o.id === item?.id) + 1;
    const counts = answer || !item ? [] : await this.photosOf(item);
    const best = answer ? state.draft.prompts[0]?.photo ?? this.photo : counts.indexOf(Math.max(...counts));
    for (const photo of new Set([this.photo, best])) {
      const map = await run.labels(photo), labels = decode(map), box = bounds(labels, map.width, label);
      if (!box) continue;
      const { camera, rotation, translation } = description.photos[photo], small = scaled(camera, map.width / camera.width);
      const at = nearest(labels, map.width, label, [(box[0] + box[2]) / 2, (box[1] + box[3]) / 2]);
      const picked = await run.pick({ camera: small, rotation, translation, at });
      if (!picked) continue;
      const depth = dot(subtract(picked.point, centreOf({ rotation, translation })), rotation.slice(6, 9));
      return { point: picked.point, radius: Math.hypot(box[2] - box[0], box[3] - box[1]) / 2 * depth / small.fx };
    }
    return null;
  }

  listen() {
    document.addEventListener("keydown", event => {
      this.held.add(event.code);
      const { target } = event;
      if (target instanceof HTMLInputElement && target.type !== "checkbox" && target.type !== "range") return;
      if (target instanceof HTMLSelectElement) return;
      const pressed = target instanceof HTMLElement && target.closest("button, a");
      if (pressed && (event.code === "Enter" || event.code === "Space")) return;
      if (/** @type {HTMLDialogElement} */ (of("sheet-of-keys")).open) return;
      const where = target instanceof HTMLElement && target.closest("#stage, #space");
      const act = actionOf(event, where ? where.id : "");
      if (!act || !this.run.name && !WITHOUT_RUN.includes(act)) return;
      event.preventDefault();
      this.do(act, where ? where.id : "");
    });
    document.addEventListener("keyup", event => this.held.delete(event.code));
    window.addEventListener("blur", () => this.held.clear());
    for (const button of document.querySelectorAll("button[data-act]")) {
      const act = /** @type {HTMLElement} */ (button).dataset.act ?? "", tip = tipOf(act);
      if (tip) /** @type {HTMLElement} */ (button).title = tip;
      button.addEventListener("click", () => this.do(act));
    }
    for (const button of of("views").querySelectorAll("button")) {
      button.addEventListener("click", () => this.setView(button.dataset.view ?? "both"));
      button.title = text(`view_${button.dataset.view}`) + keysOf(`view_${button.dataset.view}`);
    }
  }

  /** Does what a key or a button stands for, with the focus in `where`. @param {string} act @param {string} [where] */
  do(act, where) {
    const { state, photoPane, scenePane } = this, item = this.selected(), { cursor } = where === "space" ? scenePane : photoPane;
    const step = 0.06;
    /** @type {Record<string, () => unknown>} */
    const acts = {
      keep: () => {
        if (!state?.answer.splats) return;
        this.keeping = state.draft.of ?? -1;
        return this.act({ do: "keep" });
      },
      drop: () => {
        const other = cursor === photoPane.cursor ? scenePane.cursor : photoPane.cursor;
        if (cursor.end() || other.end()) return this.say(text("mark_dropped"));
        if (state?.draft.prompts.length || state?.draft.listed !== null || state?.draft.text !== null) return this.act({ do: "prompt", prompts: [] });
        if (state?.isolated !== null) return this.act({ do: "isolate", id: null });
        this.select(null);
      },
      undo: () => state?.undo && this.act({ do: "undo" }),
      redo: () => state?.redo && this.act({ do: "redo" }),
      next_photo: () => this.openPhoto(this.strip.neighbour(1)),
      previous_photo: () => this.openPhoto(this.strip.neighbour(-1)),
      view_photo: () => this.setView("photo"), view_both: () => this.setView("both"), view_scene: () => this.setView("scene"), view_status: () => this.setView("status"),
      rule_visible: () => this.nextRule("visible"), rule_footprint: () => this.nextRule("footprint"),
      part: () => this.changeLevel(-1), whole: () => this.changeLevel(1),
      isolate: () => this.act({ do: "isolate", id: state?.isolated === null ? this.item : null }),
      hide: () => item && this.act({ do: "show", id: item.id, visible: !item.visible }),
      rename: () => item && this.side.rename(item.id),
      delete: () => item && this.act({ do: "delete", id: item.id }),
      through: () => scenePane.through(this.photo),
      frame_object: () => this.frameObject(),
      fly: () => { scenePane.flying = !scenePane.flying; },
      theme: () => {
        const dark = matchMedia("(prefers-color-scheme: dark)").matches !== document.documentElement.matches(".light, .dark");
        document.documentElement.className = document.documentElement.className ? "" : dark ? "light" : "dark";
      },
      help: () => this.showKeys(),
      frusta: () => {
        scenePane.frusta = !scenePane.frusta;
        of("frusta").setAttribute("aria-pressed", String(scenePane.frusta));
        scenePane.drawCameras();
      },
      marks: () => {
        scenePane.marks = !scenePane.marks;
        of("marks").setAttribute("aria-pressed", String(scenePane.marks));
        scenePane.redraw();
      },
      transients: () => this.showTransients(!this.transients),
      train: () => this.run.post("train", {}).then(() => this.say(text("trained_again")), error => this.failed(error)),
      rendered_by: () => scenePane.switchDrawer(),
      cursor_left: () => cursor.move(-STEP, 0), cursor_right: () => cursor.move(STEP, 0),
      cursor_up: () => cursor.move(0, -STEP), cursor_down: () => cursor.move(0, STEP),
      scene_cursor_left: () => cursor.move(-STEP, 0), scene_cursor_right: () => cursor.move(STEP, 0),
      scene_cursor_up: () => cursor.move(0, -STEP), scene_cursor_down: () => cursor.move(0, STEP),
      fine_left: () => cursor.move(-FINE, 0), fine_right: () => cursor.move(FINE, 0),
      fine_up: () => cursor.move(0, -FINE), fine_down: () => cursor.move(0, FINE),
      click_inside: () => cursor.press("add"), click_outside: () => cursor.press("subtract"), intersect: () => cursor.press("intersect"),
      corner: () => this.tool === "prompt" && cursor.corner(), pivot: () => scenePane.pivotCursor(),
      forward: () => scenePane.pan(0, 0, step), back: () => scenePane.pan(0, 0, -step),
      left: () => scenePane.pan(-step, 0), right: () => scenePane.pan(step, 0),
      up: () => scenePane.pan(0, -step), down: () => scenePane.pan(0, step),
      turn_left: () => scenePane.orbit(0.1, 0), turn_right: () => scenePane.orbit(-0.1, 0),
      turn_up: () => scenePane.orbit(0, 0.1), turn_down: () => scenePane.orbit(0, -0.1),
    };
    for (const tool of TOOLS) acts[`tool_${tool}`] = () => this.setTool(tool);
    acts[act]?.();
  }

  /** Shows the transients of photos, for tools to paint them. @param {boolean} shown */
  showTransients(shown) {
    this.transients = shown;
    of("transients").setAttribute("aria-pressed", String(shown));
    if (shown && this.tool === "prompt") this.setTool("brush");
    else if (!shown) this.setTool("prompt");
    if (shown) this.say(text("transients_how"));
    this.photoPane.update();
  }

  showKeys() {
    const dialog = /** @type {HTMLDialogElement} */ (of("sheet-of-keys"));
    const row = (/** @type {typeof shortcuts[number]} */ s) => element("tr", {},
      element("td", {}, ...s.keys.flatMap((key, k) => [k ? " " : "", element("kbd", {}, s.mouse ? key : shown(key))])),
      element("td", {}, s.does));
    const parts = ["all", "both", "stage", "space", "mouse"].flatMap(pane => {
      const rows = shortcuts.filter(s => (s.mouse ? "mouse" : s.where ?? "all") === pane).map(row);
      return [element("h3", {}, text(`keys_${pane}`)), element("table", {}, element("tbody", {}, ...rows))];
    });
    const close = element("button", { type: "button", className: "main", click: () => dialog.close() }, text("close"));
    dialog.setAttribute("aria-label", text("keys"));
    // What has the focus first is in sight: the button stands above the keys.
    dialog.replaceChildren(element("h2", {}, text("keys")), close, ...parts);
    dialog.showModal();
    dialog.scrollTop = 0;
  }

  /** Shows how far the run or the batch is, as operators see it. */
  async showStatus() {
    if (this.view !== "status") this.setView("status");
    else await this.statusPane.show();
  }
}

/** Fills the texts and labels of the document. */
function fillTexts() {
  for (const node of document.querySelectorAll("[data-text]")) node.textContent = text(/** @type {HTMLElement} */ (node).dataset.text ?? "");
  for (const node of document.querySelectorAll("[data-label]")) node.setAttribute("aria-label", text(/** @type {HTMLElement} */ (node).dataset.label ?? ""));
}

const app = new App();
/** For tests and for whoever wants to know. */
Object.assign(window, { segwild: app });
app.start().catch(error => app.failed(error));
