// The photos: the strip, and the large one with its marks, candidates, clicks and strokes.

import { showImage } from "./api.js";
import { Cursor } from "./cursor.js";
import { ANSWER, ANSWER_COLOUR, covered, paint } from "./overlay.js";
import { text } from "./strings.js";
import { SIZED, drawStroke } from "./tools.js";

/** @typedef {import("./main.js").App} App */
/** @typedef {import("./api.js").Prompts} Prompts */

/** The number that stands for the answer where an object's is wanted. */
const ANSWER_ID = 0;
/** Colour of transients. */
const TRANSIENT = [255, 140, 0];
/** Pixels that a pointer moves before a click becomes a drag. */
const DRAG = 6;
/** Steps from part to whole; null lets the server choose. @type {(number | null)[]} */
export const LEVELS = [null, 0, 0.25, 0.5, 0.75, 1];

const of = (/** @type {string} */ id) => /** @type {HTMLElement} */ (document.getElementById(id));
const stage = of("stage"), sheet = of("sheet"), promptBox = of("prompts"), stroke = of("stroke");
const image = /** @type {HTMLImageElement} */ (of("image"));
const labels = /** @type {HTMLCanvasElement} */ (of("labels")), candidate = /** @type {HTMLCanvasElement} */ (of("candidate"));

/** The large photo. */
export class PhotoPane {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.zoom = { scale: 1, x: 0, y: 0 };
    this.cursor = new Cursor(app, {
      stroke,
      size: () => this.photo.camera,
      brush: () => this.brush(),
      moved: () => this.cursorMoved(),
      candidate: () => this.share,
      searching: () => this.hovering !== null,
      click: (at, inside) => this.app.addPoint(this.app.photo, at, inside),
      box: (a, b) => this.app.addBox(this.app.photo, a, b),
      region: (tool, path, how) => this.region(tool, path, how),
    });
    /** The share of the photo that the candidate covers. @type {number | null} */
    this.share = null;
    this.labelled = "";
    this.hovering = /** @type {AbortController | null} */ (null);
    this.hovered = /** @type {number[] | null} */ (null);
    new ResizeObserver(() => this.layout()).observe(stage);
    stage.addEventListener("pointerdown", event => this.press(event));
    stage.addEventListener("pointermove", event => this.move(event));
    stage.addEventListener("pointerleave", () => this.leave());
    stage.addEventListener("contextmenu", event => event.preventDefault());
    stage.addEventListener("wheel", event => this.wheel(event), { passive: false });
    image.addEventListener("load", () => this.app.ready("photo"));
  }

  get photo() {
    return this.app.description.photos[this.app.photo];
  }

  /** Whether prompts, a listed part or a text are requested: no candidate is shown then. */
  get requests() {
    const draft = this.app.state?.draft;
    return draft !== undefined && (draft.prompts.length > 0 || draft.listed !== null || draft.text !== null);
  }

  /** Shows the app's photo. */
  open() {
    const { camera, name, held_out } = this.photo;
    showImage(image, this.app.run.photo(this.app.photo, 1280));
    image.alt = name;
    of("photo-name").textContent = `${name} · ${camera.width} × ${camera.height}${held_out ? ` · ${text("held_out")}` : ""}`;
    this.zoom = { scale: 1, x: 0, y: 0 };
    this.cursor.forget();
    this.clearCandidate();
    paint(labels, null, () => null);
    this.labelled = "";
    this.layout();
    this.update();
  }

  /** Fits the sheet into the stage. */
  layout() {
    if (!this.app.description) return;
    const { camera } = this.photo, { clientWidth: w, clientHeight: h } = stage;
    const fit = Math.min(w / camera.width, h / camera.height) || 1;
    this.fit = fit;
    sheet.style.width = `${camera.width * fit}px`;
    sheet.style.height = `${camera.height * fit}px`;
    this.origin = [(w - camera.width * fit) / 2, (h - camera.height * fit) / 2];
    this.arrange();
  }

  arrange() {
    const { scale, x, y } = this.zoom;
    const [left, top] = this.origin ?? [0, 0];
    sheet.style.transform = `translate(${left + x}px, ${top + y}px) scale(${scale})`;
  }

  /** The position of an event in the photo, in pixels at full size. @param {{clientX: number, clientY: number}} event */
  at(event) {
    const box = sheet.getBoundingClientRect(), { camera } = this.photo;
    return [(event.clientX - box.left) / box.width * camera.width, (event.clientY - box.top) / box.height * camera.height];
  }

  /** @param {number[]} at */
  inside(at) {
    const { camera } = this.photo;
    return at[0] >= 0 && at[1] >= 0 && at[0] < camera.width && at[1] < camera.height;
  }

  /** @param {PointerEvent} event */
  press(event) {
    if (event.target instanceof HTMLElement && event.target.closest("#prompts button")) return;
    const start = this.at(event), tool = this.app.tool;
    stage.focus({ preventScroll: true });
    if (event.button === 1 || (event.button === 0 && this.app.held.has("Space") && this.zoom.scale > 1)) {
      return this.drag(event, (dx, dy) => {
        this.zoom.x += dx;
        this.zoom.y += dy;
        this.arrange();
      });
    }
    if (!this.inside(start) || event.button > 2) return;
    stage.setPointerCapture(event.pointerId);
    event.preventDefault();
    const outside = event.button === 2 || event.altKey;
    const path = [start];
    let far = false;
    const move = (/** @type {PointerEvent} */ e) => {
      far ||= Math.hypot(e.clientX - event.clientX, e.clientY - event.clientY) > DRAG;
      const at = this.at(e);
      if (tool === "lasso" || tool === "brush") path.push(at);
      else path[1] = at;
      if (far || tool !== "prompt") drawStroke(stroke, tool, path, this.photo.camera, this.brush());
    };
    const end = (/** @type {PointerEvent} */ e) => {
      stage.removeEventListener("pointermove", move);
      stage.removeEventListener("pointerup", end);
      stage.removeEventListener("pointercancel", end);
      stroke.replaceChildren();
      if (e.type === "pointercancel") return;
      move(e);
      stroke.replaceChildren();
      if (tool !== "prompt") return this.region(tool, path, e);
      if (far && !outside) return this.app.addBox(this.app.photo, start, this.at(e));
      this.app.addPoint(this.app.photo, start, !outside);
    };
    stage.addEventListener("pointermove", move);
    stage.addEventListener("pointerup", end);
    stage.addEventListener("pointercancel", end);
  }

  /** Marks a region of the photo. @param {string} tool @param {number[][]} path @param {import("./tools.js").Modifiers} how */
  region(tool, path, how) {
    const { camera, rotation, translation } = this.photo;
    return this.app.region(tool, path, { camera, rotation, translation }, this.brush(), how);
  }

  /** Radius of the brush in pixels of the photo. */
  brush() {
    return this.app.radius * Math.max(this.photo.camera.width, this.photo.camera.height);
  }

  /** @param {PointerEvent} event @param {(dx: number, dy: number) => void} moved */
  drag(event, moved) {
    event.preventDefault();
    stage.setPointerCapture(event.pointerId);
    let last = [event.clientX, event.clientY];
    const move = (/** @type {PointerEvent} */ e) => {
      moved(e.clientX - last[0], e.clientY - last[1]);
      last = [e.clientX, e.clientY];
    };
    stage.addEventListener("pointermove", move);
    stage.addEventListener("pointerup", () => stage.removeEventListener("pointermove", move), { once: true });
  }

  /** @param {PointerEvent} event */
  move(event) {
    if (event.buttons || event.pointerType === "touch") return;
    const at = this.at(event);
    this.hovered = this.inside(at) ? at : null;
    this.hover();
    this.preview();
  }

  leave() {
    this.hovered = null;
    this.clearCandidate();
    this.preview();
  }

  /** Shows the size of a brush or a sphere under the pointer. */
  preview() {
    if (this.cursor.shape) return this.cursor.draw();
    stroke.replaceChildren();
    if (this.hovered && SIZED.includes(this.app.tool)) drawStroke(stroke, "sphere", [this.hovered], this.photo.camera, this.brush());
  }

  clearCandidate() {
    this.hovering?.abort();
    this.hovering = null;
    this.share = null;
    paint(candidate, null, () => null);
  }

  /** Asks for the candidate under the pointer; one request at a time, the newest position counts. */
  async hover() {
    const { app, hovered } = this;
    if (!hovered || app.tool !== "prompt" || app.transients || !app.state || this.requests) {
      return this.clearCandidate();
    }
    if (this.hovering) return;
    this.hovering = new AbortController();
    const { signal } = this.hovering, photo = app.photo;
    try {
      const began = performance.now();
      const map = await app.run.hover({ photo, x: hovered[0], y: hovered[1], granularity: app.level }, signal);
      app.times.hover = performance.now() - began;
      if (signal.aborted || photo !== app.photo) return;
      paint(candidate, map, () => [255, 255, 255]);
      if (this.hovered === hovered) this.share = covered(map);
    } catch (error) {
      if (!signal.aborted) app.failed(error);
    }
    // A newer one may be on its way.
    if (this.hovering && this.hovering.signal !== signal) return;
    this.hovering = null;
    if (this.hovered && this.hovered !== hovered) this.hover();
    else this.cursor.answered();
  }

  /** @param {WheelEvent} event */
  wheel(event) {
    event.preventDefault();
    const steps = event.deltaY || event.deltaX;
    if (event.shiftKey) return this.app.changeLevel(steps > 0 ? 1 : -1);
    const { scale } = this.zoom, next = Math.min(16, Math.max(1, scale * Math.exp(-steps * 0.002)));
    const box = stage.getBoundingClientRect(), [left, top] = this.origin ?? [0, 0];
    const [x, y] = [event.clientX - box.left - left, event.clientY - box.top - top];
    this.zoom = next === 1 ? { scale: 1, x: 0, y: 0 } : {
      scale: next, x: x - (x - this.zoom.x) * next / scale, y: y - (y - this.zoom.y) * next / scale,
    };
    this.arrange();
    this.drawPrompts();
  }

  /** Shows the keyboard's cursor, and the candidate there. */
  cursorMoved() {
    this.hovered = this.cursor.position();
    // That of the position before is not announced here.
    this.share = null;
    this.drawPrompts();
    this.hover();
    this.preview();
  }

  /** Shows the prompts of this photo; a click on one removes it. */
  drawPrompts() {
    const { app } = this, { camera } = this.photo, shrink = 1 / this.zoom.scale;
    const percent = (/** @type {number} */ v, /** @type {number} */ side) => `${100 * v / side}%`;
    const found = app.state?.draft.prompts.find(p => p.photo === app.photo), elements = [];
    for (const point of found?.points ?? []) {
      const b = document.createElement("button");
      b.type = "button";
      b.className = point.inside ? "inside" : "outside";
      b.textContent = point.inside ? "+" : "−";
      b.setAttribute("aria-label", text("remove_point", Math.round(point.x), Math.round(point.y)));
      Object.assign(b.style, { left: percent(point.x, camera.width), top: percent(point.y, camera.height), scale: String(shrink) });
      b.addEventListener("click", () => app.removePoint(app.photo, point));
      elements.push(b);
    }
    for (const box of found?.boxes ?? []) {
      const frame = document.createElement("span"), b = document.createElement("button");
      frame.className = "box";
      b.type = "button";
      b.textContent = "×";
      b.setAttribute("aria-label", text("remove_box"));
      b.style.scale = String(shrink);
      b.addEventListener("click", () => app.removeBox(app.photo, box));
      frame.append(b);
      const [x0, x1] = [Math.min(box.x0, box.x1), Math.max(box.x0, box.x1)], [y0, y1] = [Math.min(box.y0, box.y1), Math.max(box.y0, box.y1)];
      Object.assign(frame.style, {
        left: percent(x0, camera.width), top: percent(y0, camera.height),
        width: percent(x1 - x0, camera.width), height: percent(y1 - y0, camera.height),
      });
      elements.push(frame);
    }
    const cursor = this.cursor.at;
    if (cursor) {
      const mark = document.createElement("span");
      mark.className = "cursor";
      Object.assign(mark.style, { left: `${100 * cursor[0]}%`, top: `${100 * cursor[1]}%`, scale: String(shrink) });
      elements.push(mark);
    }
    promptBox.replaceChildren(...elements);
  }

  /** Shows what changed. */
  async update() {
    const { app } = this;
    if (!app.state || !app.shows("photo")) return;
    this.drawPrompts();
    if (this.requests) this.clearCandidate();
    const { transients } = app, wanted = () => `${app.photo}/${app.state?.revision}/${app.transients}`;
    if (this.labelled === wanted() || this.labelling) return;
    this.labelling = true;
    try {
      const photo = app.photo, map = await (transients ? app.run.transients(photo) : app.run.labels(photo));
      if (photo === app.photo && transients === app.transients) {
        paint(labels, map, label => transients ? TRANSIENT : label === ANSWER ? ANSWER_COLOUR : app.colourOf(label));
        this.labelled = `${photo}/${map.revision}/${transients}`;
      }
    } catch (error) {
      app.failed(error);
      return;
    } finally {
      this.labelling = false;
    }
    if (this.labelled !== wanted()) this.update();
  }
}

/** The strip of all photos. */
export class Strip {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.list = of("photos");
    /** Photos that show the answer or the selected object, by pixels. @type {number[] | null} */
    this.showing = null;
    this.shownFor = "";
    /** Settles once the photos that are wanted are counted. @type {Promise<void> | undefined} */
    this.counts = undefined;
    /** Why they could not be counted. @type {unknown} */
    this.failure = null;
    const search = /** @type {HTMLInputElement} */ (of("search"));
    search.placeholder = text("search");
    search.addEventListener("input", () => this.draw());
    const sort = /** @type {HTMLSelectElement} */ (of("sort"));
    for (const way of ["sort_name", "sort_angle"]) sort.append(new Option(text(way), way));
    sort.addEventListener("change", () => this.draw());
    of("showing").addEventListener("change", async () => {
      // Others may be wanted meanwhile.
      for (let counts = this.update(); ; counts = this.update()) {
        await counts;
        if (counts === this.update()) break;
      }
      const wanted = /** @type {HTMLInputElement} */ (of("showing")).checked && !this.showing;
      if (wanted && this.failure) app.failed(this.failure);
      else if (wanted) app.say(text("showing_none"));
      this.draw();
    });
  }

  /** The photos in the order of the strip. */
  order() {
    const { description } = this.app;
    const search = /** @type {HTMLInputElement} */ (of("search")).value.toLowerCase();
    const only = /** @type {HTMLInputElement} */ (of("showing")).checked, { showing } = this;
    let all = description.photos.map((_, i) => i).filter(i => description.photos[i].name.toLowerCase().includes(search));
    if (only && showing) all = all.filter(i => showing[i] > 24);
    if (/** @type {HTMLSelectElement} */ (of("sort")).value === "sort_angle") {
      const angle = (/** @type {number} */ i) => this.app.angleOf(i);
      all.sort((a, b) => angle(a) - angle(b));
    }
    return all;
  }

  draw() {
    const { app } = this;
    const items = this.order().map(i => {
      const li = document.createElement("li"), button = document.createElement("button"), img = document.createElement("img");
      button.type = "button";
      button.title = app.description.photos[i].name;
      button.classList.toggle("has", (this.showing?.[i] ?? 0) > 24);
      button.setAttribute("aria-label", app.description.photos[i].name);
      button.setAttribute("aria-current", String(i === app.photo));
      img.loading = "lazy";
      img.alt = "";
      showImage(img, app.run.photo(i, 160));
      button.append(img);
      button.addEventListener("click", () => app.openPhoto(i));
      li.append(button);
      return li;
    });
    this.list.replaceChildren(...items);
  }

  /** Marks the photo that is open. */
  mark() {
    const { app } = this, name = app.description.photos[app.photo].name;
    for (const button of this.list.querySelectorAll("button")) {
      const current = button.title === name;
      button.setAttribute("aria-current", String(current));
      if (current) button.scrollIntoView({ block: "nearest", inline: "nearest" });
    }
  }

  /** The photo some steps after the open one. @param {number} steps */
  neighbour(steps) {
    const all = this.order(), at = all.indexOf(this.app.photo);
    return all[(at + steps + all.length) % all.length] ?? this.app.photo;
  }

  /** Finds out which photos show the answer, if only those are wanted, or else the selected object. Who calls it again before that is
   * known gets the same promise. */
  update() {
    const { app } = this, item = app.selected(), answer = app.state?.answer;
    const only = /** @type {HTMLInputElement} */ (of("showing")).checked && answer?.state === "done" ? answer : null;
    const wanted = only ? `answer ${only.number}` : item ? `${item.id}/${item.selection}` : "";
    if (wanted !== this.shownFor) {
      this.shownFor = wanted;
      // Nobody needs those of an answer that has been replaced.
      this.counting?.abort();
      this.counting = new AbortController();
      this.counts = this.count(wanted, only ? app.run.photosOf(ANSWER_ID, this.counting.signal) : item ? app.photosOf(item) : null);
    }
    return this.counts;
  }

  /** @param {string} wanted @param {Promise<number[]> | null} found */
  async count(wanted, found) {
    /** @type {unknown} */
    let failure = null;
    const showing = await found?.catch(error => {
      failure = error;
      return null;
    });
    // Another one may be wanted by now.
    if (wanted !== this.shownFor) return;
    this.showing = showing ?? null;
    this.failure = failure;
    this.draw();
  }
}
