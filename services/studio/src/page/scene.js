// The 3D view: its camera, who draws it, clicks and strokes in it.

import { add, centreOf, cross, dot, fitted, length, pose, project, rotate, scale, scaled, subtract, transposed, turned, unit } from "./geometry.js";
import { FRAME, LEAST_SPLATS, SplatBudget } from "./budget.js";
import { Cursor } from "./cursor.js";
import { ANSWER, ANSWER_COLOUR, covered, paint } from "./overlay.js";
import { HIDDEN, SplatView } from "./splats.js";
import { text } from "./strings.js";
import { SIZED, drawStroke } from "./tools.js";

/** @typedef {import("./main.js").App} App */
/** @typedef {import("./api.js").View} View */

/** Pixels that a pointer moves before a click becomes a drag. */
const DRAG = 5;
/** Milliseconds in which a second click makes a double one. */
const DOUBLE = 220;
/** Milliseconds without motion after which a view is drawn at full size. */
const REST = 120;
/** Milliseconds that a pointer rests before the candidate under it is requested. */
const SETTLED = 30;
/** Longest sides of a view in which a pixel is picked, and in which a candidate is requested. */
const PICKED = 2048;
const HOVERED = 512;
/** Milliseconds from which a frame at full size is late: what has changed is shown in a small one before. */
const LATE = 100;
/** Longest side that the server draws, in motion and at rest. */
const SIDES = [480, 1280];
/** Longest side of what stands behind the browser's splats: it is smooth, so a small image will do. */
const BACKGROUND = 96;
/** Times the splats of the last frame that arrive before another one is rendered. */
const GROWN = 1.5;
/** Times an object's own extent that its view has. */
const MARGIN = 1.3;
/** Frames in which the number of splats of a moving camera is found. */
const MEASURED = 8;
/** Cameras that are shown. */
const MOST_CAMERAS = 400;
/** Bytes of changes of splats that are kept. */
const MOST_CHANGES = 64 << 20;
/** Sides under which a pane is hidden or folded. */
const LEAST = 8;
/** The label of splats that are not shown. */
const HIDDEN_LABEL = 254;

const of = (/** @type {string} */ id) => /** @type {HTMLElement} */ (document.getElementById(id));
const space = of("space"), frame = /** @type {HTMLImageElement} */ (of("frame"));
const cameras = /** @type {HTMLCanvasElement} */ (of("cameras")), stroke = of("scene-stroke"), mark = of("scene-cursor");
const candidate = /** @type {HTMLCanvasElement} */ (of("scene-candidate"));

/** The 3D view. */
export class ScenePane {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.marks = true;
    this.frusta = true;
    this.flying = false;
    /** Who draws: "server", "browser", or not decided. @type {"server" | "browser" | null} */
    this.drawer = null;
    this.view3 = /** @type {SplatView | null} */ (null);
    /** How many splats the browser renders while the camera moves. */
    this.budget = new SplatBudget();
    /** Ends the arrival of splats. @type {AbortController | null} */
    this.loading = null;
    /** The view whose background is shown. */
    this.backdrop = "";
    /** The background that is on its way. @type {Promise<void> | null} */
    this.requested = null;
    this.loaded = "";
    this.marked = "";
    /** The version of what objects change of the splats that are loaded. */
    this.changed = "";
    /** The state's revision for which changes were requested last. */
    this.changedFor = -1;
    /** The request for changes that is under way. @type {{version: string, stop: AbortController} | null} */
    this.changing = null;
    /** Changes by their versions, the newest last: a switch back requests nothing. @type {Map<string, ArrayBuffer>} */
    this.changes = new Map();
    this.busy = false;
    this.dirty = false;
    /** Whether the state has changed since the last frame. */
    this.fresh = false;
    /** Where the pointer is. @type {number[] | null} */
    this.pointed = null;
    /** The timer after which that is requested; 0 without one. */
    this.settling = 0;
    /** The request for the candidate under it. @type {AbortController | null} */
    this.hovering = null;
    /** The share of the view that the candidate covers. @type {number | null} */
    this.share = null;
    this.cursor = new Cursor(app, {
      stroke,
      size: () => ({ width: space.clientWidth, height: space.clientHeight }),
      brush: () => this.brush(),
      moved: () => this.cursorMoved(),
      candidate: () => this.share,
      searching: () => this.settling !== 0 || this.hovering !== null,
      click: (at, inside) => this.pick(at).then(picked => picked && this.prompt(picked, inside)),
      box: () => {},
      region: (tool, path, how) => this.app.region(tool, path, this.full(), this.brush(), how),
    });
    this.moved = 0;
    this.eye = [0, 0, 0];
    this.forward = [0, 0, 1];
    this.down = [0, 1, 0];
    this.pivot = [0, 0, 1];
    this.clicks = 0;
    new ResizeObserver(() => this.redraw()).observe(space);
    space.addEventListener("pointerdown", event => this.press(event));
    space.addEventListener("pointermove", event => {
      const box = space.getBoundingClientRect();
      this.pointed = event.buttons || event.pointerType === "touch" ? null : [event.clientX - box.left, event.clientY - box.top];
      if (!event.buttons) this.preview();
      this.hover();
    });
    space.addEventListener("pointerleave", () => {
      this.pointed = null;
      this.preview();
      this.hover();
    });
    space.addEventListener("contextmenu", event => event.preventDefault());
    space.addEventListener("wheel", event => {
      event.preventDefault();
      if (event.shiftKey) return this.app.changeLevel((event.deltaY || event.deltaX) > 0 ? 1 : -1);
      this.dolly(Math.exp(-event.deltaY * 0.0015));
    }, { passive: false });
  }

  /** Stands where a photo was taken. @param {number} photo */
  through(photo) {
    const { camera, rotation, translation } = this.app.description.photos[photo];
    this.camera = camera;
    this.exact = { rotation, translation };
    this.eye = centreOf({ rotation, translation });
    this.forward = rotation.slice(6, 9);
    this.down = rotation.slice(3, 6);
    const depth = dot(subtract(this.app.description.centre, this.eye), this.forward);
    this.pivot = add(this.eye, scale(this.forward, Math.max(depth, 0.1)));
    this.clearCandidate();
    this.hover(REST);
    this.redraw();
  }

  /** The view in a frame of a size. @param {number} width @param {number} height @returns {View} */
  view(width, height) {
    const camera = fitted(this.camera ?? this.app.description.photos[0].camera, width, height);
    return { camera, ...(this.exact ?? pose(this.eye, this.forward, this.down)) };
  }

  full() {
    return this.view(Math.max(space.clientWidth, 1), Math.max(space.clientHeight, 1));
  }

  move() {
    this.exact = undefined;
    this.moved = performance.now();
    this.clearCandidate();
    this.hover(REST);
    this.redraw();
  }

  /** A position of the pane as one of a view that the server takes. @param {number[]} at @param {number} most */
  seen(at, most) {
    const view = this.full(), { width, height } = view.camera, camera = scaled(view.camera, Math.min(1, most / Math.max(width, height)));
    return { ...view, camera, at: [at[0] * camera.width / width, at[1] * camera.height / height] };
  }

  clearCandidate() {
    clearTimeout(this.settling);
    this.settling = 0;
    this.hovering?.abort();
    this.hovering = null;
    this.share = null;
    if (candidate.width > 1) paint(candidate, null, () => null);
  }

  /** Shows the candidate under the pointer once it rests. @param {number} [wait] */
  hover(wait = SETTLED) {
    const { app } = this;
    clearTimeout(this.settling);
    if (!this.pointed || app.tool !== "prompt" || !app.state || !app.description.tree || app.photoPane.requests || !app.shows("scene")) {
      return this.clearCandidate();
    }
    this.settling = window.setTimeout(() => this.showCandidate(), wait);
  }

  /** Asks for the candidate; one request at a time, the newest position counts. */
  async showCandidate() {
    const { app, pointed } = this;
    this.settling = 0;
    if (!pointed || this.hovering) return;
    const stop = new AbortController(), { at: [x, y], ...view } = this.seen(pointed, HOVERED), began = performance.now();
    this.hovering = stop;
    try {
      const map = await app.run.hover({ photo: 0, x, y, granularity: app.level, view }, stop.signal);
      app.times.hover_scene = performance.now() - began;
      if (stop.signal.aborted) return;
      paint(candidate, map, () => [255, 255, 255]);
      if (this.pointed === pointed) this.share = covered(map);
    } catch (error) {
      if (!stop.signal.aborted) app.failed(error);
    }
    if (this.hovering !== stop) return;
    this.hovering = null;
    if (this.pointed !== pointed) this.hover();
    else this.cursor.answered();
  }

  /** Shows the keyboard's cursor, and the candidate there. */
  cursorMoved() {
    const [x, y] = this.cursor.at ?? [0, 0];
    mark.hidden = !this.cursor.at;
    mark.style.left = `${100 * x}%`;
    mark.style.top = `${100 * y}%`;
    this.pointed = this.cursor.position();
    // That of the position before is not announced here.
    this.share = null;
    this.preview();
    this.hover();
  }

  /** @param {number} dx @param {number} dy */
  orbit(dx, dy) {
    const { up } = this.app.description, around = this.flying ? this.eye : this.pivot;
    const right = cross(this.down, this.forward);
    const turn = (/** @type {number[]} */ v) => turned(turned(v, up, -dx), unit(right), -dy);
    const forward = turn(this.forward);
    // Never over the pole: up would turn around.
    if (Math.abs(dot(unit(forward), up)) > 0.995) return;
    this.eye = add(around, turn(subtract(this.eye, around)));
    this.forward = forward;
    this.down = turn(this.down);
    this.move();
  }

  /** @param {number} dx @param {number} dy @param {number} dz */
  pan(dx, dy, dz = 0) {
    const reach = length(subtract(this.pivot, this.eye)), right = unit(cross(this.down, this.forward));
    const by = add(add(scale(right, dx * reach), scale(unit(this.down), dy * reach)), scale(unit(this.forward), dz * reach));
    this.eye = add(this.eye, by);
    this.pivot = add(this.pivot, by);
    this.move();
  }

  /** @param {number} factor */
  dolly(factor) {
    this.eye = add(this.pivot, scale(subtract(this.eye, this.pivot), 1 / factor));
    this.move();
  }

  /** Turns to the middle of the scene. */
  frameScene() {
    this.pivot = [...this.app.description.centre];
    this.forward = unit(subtract(this.pivot, this.eye));
    this.down = scale(this.app.description.up, -1);
    this.move();
  }

  /** Goes so near to a point that what lies within a radius of it fills the view. @param {number[]} point @param {number} radius */
  frame(point, radius) {
    const { fx, fy, width, height } = this.full().camera, far = MARGIN * radius * Math.max(2 * fx / width, 2 * fy / height);
    this.pivot = point;
    this.eye = subtract(point, scale(unit(this.forward), Math.max(far, 1e-3)));
    this.move();
  }

  /** Shows the size of a brush or a sphere under the pointer. */
  preview() {
    if (this.cursor.shape) return this.cursor.draw();
    stroke.replaceChildren();
    const size = { width: space.clientWidth, height: space.clientHeight };
    if (this.pointed && SIZED.includes(this.app.tool)) drawStroke(stroke, "sphere", [this.pointed], size, this.brush());
  }

  /** @param {PointerEvent} event */
  press(event) {
    event.preventDefault();
    space.focus({ preventScroll: true });
    space.setPointerCapture(event.pointerId);
    const box = space.getBoundingClientRect(), start = [event.clientX - box.left, event.clientY - box.top];
    // With Alt a tool leaves the camera to the pointer.
    this.pointed = null;
    this.clearCandidate();
    const path = [start], { tool } = this.app, marks = tool !== "prompt" && event.button === 0 && !event.altKey;
    let last = start, far = false;
    const move = (/** @type {PointerEvent} */ e) => {
      const at = [e.clientX - box.left, e.clientY - box.top], [dx, dy] = [at[0] - last[0], at[1] - last[1]];
      far ||= Math.hypot(at[0] - start[0], at[1] - start[1]) > DRAG;
      last = at;
      if (!far && tool === "prompt") return;
      if (marks) {
        if (tool === "lasso" || tool === "brush") path.push(at);
        else path[1] = at;
        return drawStroke(stroke, tool, path, { width: box.width, height: box.height }, this.brush());
      }
      if (event.button === 2 || event.button === 1) this.pan(-dx / box.height, -dy / box.height);
      else this.orbit(dx / box.width * 4, dy / box.height * 3);
    };
    const end = (/** @type {PointerEvent} */ e) => {
      space.removeEventListener("pointermove", move);
      space.removeEventListener("pointerup", end);
      space.removeEventListener("pointercancel", end);
      stroke.replaceChildren();
      if (e.type === "pointercancel") return;
      if (marks) {
        if (path.length < 2) path.push(path[0]);
        return this.app.region(tool, path, this.full(), this.brush(), e);
      }
      if (!far && tool === "prompt") this.click(start, event.button === 2 || event.altKey);
    };
    space.addEventListener("pointermove", move);
    space.addEventListener("pointerup", end);
    space.addEventListener("pointercancel", end);
  }

  brush() {
    return this.app.radius * Math.max(space.clientWidth, space.clientHeight);
  }

  /** @param {number[]} at @param {boolean} outside */
  async click(at, outside) {
    const near = this.frusta ? this.cameraAt(at) : null;
    if (near !== null && !outside) {
      this.through(near);
      return this.app.openPhoto(near);
    }
    // Found while it is not known yet whether it is a double click.
    const count = ++this.clicks, picking = this.pick(at);
    await new Promise(done => setTimeout(done, DOUBLE));
    const double = this.clicks !== count;
    if (double && this.clicks !== count + 1) return;
    // The second click of a double one has waited as well: only the first goes on, as a pivot.
    if (!double && this.doubled === count - 1) return;
    if (double) this.doubled = count;
    const picked = await picking;
    if (!picked) return;
    if (double) return this.turnTo(picked.point);
    await this.prompt(picked, !outside);
  }

  /** The photo that shows best what is at a position, or nothing. @param {number[]} at */
  pick(at) {
    return this.app.run.pick(this.seen(at, PICKED)).catch(error => this.app.failed(error));
  }

  /** Clicks in the photo that shows a position best. @param {{photo: number, x: number, y: number}} picked @param {boolean} inside */
  async prompt(picked, inside) {
    const { app } = this;
    if (picked.photo !== app.photo && !app.state?.draft.prompts.length) await app.openPhoto(picked.photo);
    app.addPoint(picked.photo, [picked.x, picked.y], inside);
  }

  /** Orbits around a point from now on. @param {number[]} point */
  turnTo(point) {
    this.pivot = point;
    this.forward = unit(subtract(this.pivot, this.eye));
    this.move();
  }

  /** Orbits around what is at the keyboard's cursor. */
  async pivotCursor() {
    const picked = await this.pick(this.cursor.position());
    if (picked) this.turnTo(picked.point);
  }

  /** The camera whose centre is drawn at a position. @param {number[]} at */
  cameraAt(at) {
    const view = this.full();
    let best = null, nearest = 9;
    this.app.description.photos.slice(0, MOST_CAMERAS).forEach((photo, i) => {
      const p = project(view, centreOf(photo)), far = p ? Math.hypot(p[0] - at[0], p[1] - at[1]) : Infinity;
      if (far < nearest && length(subtract(centreOf(photo), this.eye)) > 1e-3) [best, nearest] = [i, far];
    });
    return best;
  }

  drawCameras() {
    const { app } = this, view = this.full();
    cameras.width = view.camera.width;
    cameras.height = view.camera.height;
    // Without a stroke the browser may go on to show what the canvas had.
    cameras.hidden = !this.frusta;
    if (!this.frusta) return;
    const context = /** @type {CanvasRenderingContext2D} */ (cameras.getContext("2d"));
    const reach = length(subtract(app.description.centre, this.eye)) * 0.06;
    app.description.photos.slice(0, MOST_CAMERAS).forEach((photo, i) => {
      const { camera, rotation } = photo, apex = centreOf(photo);
      if (length(subtract(apex, this.eye)) < reach * 0.5) return;
      const corner = (/** @type {number} */ x, /** @type {number} */ y) => {
        const ray = [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1];
        return project(view, add(apex, scale(rotate(transposed(rotation), ray), reach)));
      };
      const top = project(view, apex);
      const corners = [corner(0, 0), corner(camera.width, 0), corner(camera.width, camera.height), corner(0, camera.height)];
      if (!top || corners.some(c => !c)) return;
      context.beginPath();
      corners.forEach((c, k) => {
        const next = corners[(k + 1) % 4];
        if (!c || !next) return;
        context.moveTo(top[0], top[1]);
        context.lineTo(c[0], c[1]);
        context.lineTo(next[0], next[1]);
      });
      context.strokeStyle = i === app.photo ? "#ff40a0" : "#ffffffb0";
      context.lineWidth = i === app.photo ? 2 : 1;
      context.stroke();
    });
  }

  /** @param {boolean} [changed] whether the state has changed */
  redraw(changed = false) {
    if (!this.app.description || !this.app.shows("scene")) return;
    this.dirty = true;
    this.fresh ||= changed;
    this.drawCameras();
    if (!this.busy) this.loop();
  }

  /** Draws until the newest view is there, small in motion and whole at rest. */
  async loop() {
    this.busy = true;
    try {
      this.drawer ??= await this.choose();
      let whole = false;
      // A pane that was hidden meanwhile has no size.
      while ((this.dirty || !whole) && space.clientWidth > LEAST && space.clientHeight > LEAST) {
        this.dirty = false;
        const began = performance.now(), here = this.drawer === "browser", still = began - this.moved > REST;
        const first = still && this.fresh && !here && this.app.times.whole > LATE;
        whole = still && !first;
        this.fresh = false;
        await (here ? this.drawHere(whole) : this.drawThere(whole));
        // The browser's splats lie over the frame, which is their background then.
        of("splats").hidden = !here;
        this.app.times.frame = performance.now() - began;
        if (whole) this.app.times.whole = this.app.times.frame;
        of("frame-time").textContent = text("frame_time", Math.round(this.app.times.frame));
        if (!whole && !first && !this.dirty) await new Promise(done => setTimeout(done, REST));
      }
      this.app.ready("scene");
    } catch (error) {
      this.app.failed(error);
    } finally {
      this.busy = false;
    }
    of("rendered-by").textContent = text(this.drawer === "browser" ? "rendered_by_browser" : "rendered_by_server");
  }

  /** Who draws: the browser where it reaches 30 frames a second with enough splats, by measurement. @returns {Promise<"browser" | "server">} */
  async choose() {
    try {
      const view3 = await this.prepare();
      if (view3.software || !view3.arrived) return "server";
      this.budget = new SplatBudget();
      const view = this.full(), times = [];
      for (let k = 0; k < MEASURED; k++) times.push(this.drawMeasured(view3, view));
      return Math.min(...times) < FRAME ? "browser" : "server";
    } catch {
      return "server";
    }
  }

  /** Draws a frame of a moving camera; returns its milliseconds. @param {SplatView} view3 @param {View} view */
  drawMeasured(view3, view) {
    const began = performance.now();
    view3.draw(view, this.budget.splats);
    view3.finish();
    const time = performance.now() - began;
    this.budget.measured(time, view3.rendered);
    return time;
  }

  /** Lets the other one draw. */
  switchDrawer() {
    this.drawer = this.drawer === "browser" ? "server" : "browser";
    this.redraw();
  }

  async prepare() {
    this.view3 ??= new SplatView(/** @type {HTMLCanvasElement} */ (of("splats")));
    const { view3 } = this, wanted = this.shades();
    if (!view3.software && this.loaded !== wanted) await this.load(wanted);
    return view3;
  }

  /** What the colours of the splats depend on. */
  shades() {
    const { app } = this;
    return `${app.run.name}/${app.description.snapshot}/${JSON.stringify(app.state?.appearance)}`;
  }

  /** Takes the splats of the scene; returns once there are enough to show something. @param {string} wanted */
  async load(wanted) {
    const { app, view3 } = this, loading = new AbortController();
    this.loading?.abort();
    this.loading = loading;
    if (!view3) return;
    let shown = false;
    await new Promise((/** @type {(value?: unknown) => void} */ done, failed) => {
      const show = () => {
        if (view3.arrived < Math.min(view3.n || Infinity, LEAST_SPLATS)) return;
        shown = true;
        done();
        // The server's frame is the same however many splats are here; a switch back to them renders all that have arrived.
        if (this.drawer === "server") return;
        if (view3.arrived === view3.n || view3.arrived > GROWN * view3.rendered) this.redraw();
      };
      const arrive = async () => {
        const stream = await app.run.stream("splats", loading.signal);
        this.loaded = wanted;
        this.marked = "";
        this.changed = "";
        this.changedFor = -1;
        if (stream) await view3.receive(stream, show);
      };
      arrive().then(done, error => {
        // Others are on their way then.
        if (loading.signal.aborted) return done();
        this.loaded = "";
        if (shown) app.failed(error);
        failed(error);
      });
    });
  }

  /** Forgets the splats and the changes of a run. */
  forget() {
    this.clearCandidate();
    this.cursor.forget();
    mark.hidden = true;
    this.loading?.abort();
    this.loaded = "";
    this.backdrop = "";
    this.changes.clear();
    this.changing?.stop.abort();
    this.changing = null;
    this.changedFor = -1;
  }

  /** Shows cut shapes and objects' own appearances as the state has them; those that are not here yet are requested. */
  followChanges() {
    const { state } = this.app, version = state?.changes ?? "", known = version ? this.changes.get(version) : null;
    // What changes may be still to come.
    if (!this.view3 || this.view3.arrived < this.view3.n) return;
    if (this.changing && this.changing.version !== version) {
      this.changing.stop.abort();
      this.changing = null;
    }
    if (this.changed === version) return;
    if (known !== undefined) {
      this.view3?.change(known);
      this.changed = version;
    } else if (!this.changing && state && this.changedFor !== state.revision) {
      this.requestChanges(version, state.revision);
    }
  }

  /** @param {string} version @param {number} revision */
  async requestChanges(version, revision) {
    const { app } = this, request = { version, stop: new AbortController() };
    this.changing = request;
    this.changedFor = revision;
    try {
      const { version: found, bytes } = await app.run.changes(request.stop.signal);
      if (this.changing !== request) return;
      // The version is another one where the state has changed since, or splats of an object are lost.
      this.view3?.change(bytes);
      this.changed = found;
      this.changes.delete(found);
      this.changes.set(found, bytes);
      let sum = 0;
      for (const [name, { byteLength }] of [...this.changes].reverse()) {
        sum += byteLength;
        if (sum > MOST_CHANGES && name !== found) this.changes.delete(name);
      }
    } catch (error) {
      if (!request.stop.signal.aborted) app.failed(error);
    }
    if (this.changing !== request) return;
    this.changing = null;
    this.redraw();
  }

  /** @param {boolean} whole */
  async drawThere(whole) {
    const view = this.full(), long = Math.max(view.camera.width, view.camera.height);
    const camera = scaled(view.camera, Math.min(1, SIDES[+whole] / long));
    await this.show(await this.app.run.frame({ ...view, camera, marks: this.marks }));
    this.backdrop = "";
  }

  /** @param {boolean} whole */
  async drawHere(whole) {
    const view3 = await this.prepare(), { app } = this, wanted = this.shades();
    if (this.loaded !== wanted) await this.load(wanted);
    this.followChanges();
    const marked = `${app.state?.revision}/${this.marks}`;
    if (this.marked !== marked) {
      const labels = new Uint8Array(await app.run.bytes("labels"));
      const alone = app.state?.isolated !== null;
      view3.mark(labels, label => {
        if (label === HIDDEN_LABEL) return [0, 0, 0, HIDDEN];
        if (!this.marks || (alone && label !== ANSWER)) return null;
        return label === ANSWER ? ANSWER_COLOUR : app.colourOf(label);
      });
      this.marked = marked;
    }
    const view = this.full();
    // At rest all of them, also those that arrive later.
    if (whole) view3.draw(view);
    else this.drawMeasured(view3, view);
    const background = this.drawBackground(view, whole);
    if (whole) await background;
    else background.catch(error => app.failed(error));
    await new Promise(requestAnimationFrame);
  }

  /**
   * Shows what stands behind the splats of a view: one request at a time. A moving camera does not wait for it, and gets the newest.
   * @param {View} view @param {boolean} whole
   */
  async drawBackground(view, whole) {
    const { app } = this, { run } = app, wanted = `${JSON.stringify(view)}/${app.state?.revision}`;
    if (this.requested && !whole) return;
    await this.requested?.catch(() => {});
    if (this.backdrop === wanted) return;
    const request = async () => {
      const camera = scaled(view.camera, BACKGROUND / Math.max(view.camera.width, view.camera.height));
      const blob = await run.frame({ ...view, camera, marks: false, background: true });
      if (this.drawer !== "browser" || run !== app.run) return;
      await this.show(blob);
      this.backdrop = wanted;
    };
    this.requested = request();
    try {
      await this.requested;
    } finally {
      this.requested = null;
    }
  }

  /** Shows an image of the server's. @param {Blob} blob */
  async show(blob) {
    const url = URL.createObjectURL(blob), before = frame.src;
    frame.src = url;
    await frame.decode().catch(() => {});
    if (before.startsWith("blob:")) URL.revokeObjectURL(before);
  }
}
