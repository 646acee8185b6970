// The keyboard's cursor in a pane: clicks, boxes and the marks of tools without a pointer.

import { text } from "./strings.js";
import { drawStroke } from "./tools.js";

/** @typedef {import("./main.js").App} App */
/** @typedef {import("./tools.js").Modifiers} Modifiers */
/**
 * What a pane does for its cursor. Positions are pixels of `size`.
 * @typedef {object} CursorPane
 * @property {Element} stroke where a mark shows while it is made
 * @property {() => {width: number, height: number}} size
 * @property {() => number} brush
 * @property {() => void} moved shows the cursor, and what a click there would select
 * @property {() => number | null} candidate the share of the pane that a click would select, if that is known
 * @property {() => boolean} searching whether it is being found out
 * @property {(at: number[], inside: boolean) => unknown} click
 * @property {(a: number[], b: number[]) => unknown} box
 * @property {(tool: string, path: number[][], how: Modifiers) => Promise<void>} region
 */

const MIDDLE = [0.5, 0.5];
/** Shares of a side that a key moves the cursor, and moves it a little. */
export const STEP = 0.02;
export const FINE = 0.004;
/** Points of a mark at most: the server takes 4096. */
const MOST_POINTS = 4000;
/** Milliseconds at rest after which the position is announced. */
const REST = 500;
/** The keys that a pointer has held, for what a tool does. @type {Record<string, Modifiers>} */
const HOW = {
  add: { ctrlKey: false, metaKey: false, shiftKey: false },
  subtract: { ctrlKey: true, metaKey: false, shiftKey: false },
  intersect: { ctrlKey: true, metaKey: false, shiftKey: true },
};

/** The cursor of a pane. */
export class Cursor {
  /** @param {App} app @param {CursorPane} pane */
  constructor(app, pane) {
    this.app = app;
    this.pane = pane;
    /** Where it is, in shares; null until it is used. @type {number[] | null} */
    this.at = null;
    /** The mark that is being made: `box`, or a tool; empty without one. */
    this.shape = "";
    /** @type {number[][]} */
    this.path = [];
    /** Whether it is at rest, and was not announced there. */
    this.rested = false;
  }

  /** Where it is, in pixels of the pane. */
  position() {
    const { width, height } = this.pane.size(), [x, y] = this.at ?? MIDDLE;
    return [x * width, y * height];
  }

  /** @param {number} dx @param {number} dy */
  move(dx, dy) {
    const clamp = (/** @type {number} */ v) => Math.min(0.999, Math.max(0.001, v)), [x, y] = this.at ?? MIDDLE;
    this.at = [clamp(x + dx), clamp(y + dy)];
    if (this.shape === "lasso" || this.shape === "brush") {
      if (this.path.length < MOST_POINTS) this.path.push(this.position());
    } else if (this.shape) this.path[1] = this.position();
    this.pane.moved();
    this.draw();
    clearTimeout(this.announcing);
    this.rested = false;
    this.announcing = setTimeout(() => {
      this.rested = true;
      if (!this.pane.searching()) this.announce();
    }, REST);
  }

  /** What a click at the cursor would select is known: it is announced, if the cursor rested meanwhile. */
  answered() {
    if (this.rested) this.announce();
  }

  /** Says where it is, and how much a click would select. */
  announce() {
    this.rested = false;
    if (!this.at) return;
    const where = text("cursor_at", ...this.percent()), share = this.pane.candidate();
    this.app.say(share === null ? where : `${where} ${text("cursor_candidate", (100 * share).toFixed(1))}`);
  }

  percent() {
    return (this.at ?? MIDDLE).map(v => Math.round(100 * v));
  }

  /** Clicks, or starts and ends the mark of a tool. @param {"add" | "subtract" | "intersect"} how */
  press(how) {
    const { tool } = this.app;
    this.at ??= MIDDLE;
    if (tool === "prompt") {
      if (how !== "intersect") this.pane.click(this.position(), how === "add");
      this.pane.moved();
      return;
    }
    if (tool !== "sphere" && this.shape !== tool) return this.start(tool);
    const path = tool === "sphere" ? [this.position(), this.position()] : this.path;
    this.end();
    this.mark(tool, path, HOW[how]);
  }

  /** Marks, and says what has become of it. @param {string} tool @param {number[][]} path @param {Modifiers} how */
  async mark(tool, path, how) {
    const { app } = this, before = app.state?.revision;
    await this.pane.region(tool, path, how);
    const item = app.selected() ?? app.state?.objects.at(-1);
    // A refusal has its own message.
    if (app.state?.revision === before) return;
    app.say(app.transients ? text("marked_transients") : text("marked", item?.name ?? "", item?.splats ?? 0));
  }

  /** One corner of a box, then the other. */
  corner() {
    this.at ??= MIDDLE;
    if (this.shape !== "box") return this.start("box");
    const [a] = this.path;
    this.end();
    this.pane.box(a, this.position());
    this.app.say(text("box_done"));
  }

  /** @param {string} shape */
  start(shape) {
    this.end();
    this.shape = shape;
    this.path = [this.position(), this.position()];
    this.pane.moved();
    this.draw();
    clearTimeout(this.announcing);
    this.rested = false;
    this.app.say(text(shape === "box" ? "box_started" : "mark_started", text(`tool_${shape}`), ...this.percent()), true);
  }

  /** Ends a mark; returns whether there was one. */
  end() {
    const was = this.shape !== "";
    this.shape = "";
    this.path = [];
    if (was) this.pane.stroke.replaceChildren();
    return was;
  }

  /** Forgets where it was. */
  forget() {
    this.end();
    clearTimeout(this.announcing);
    this.rested = false;
    this.at = null;
  }

  /** Draws the mark that is being made. */
  draw() {
    if (this.shape) drawStroke(this.pane.stroke, this.shape, this.path, this.pane.size(), this.pane.brush());
  }
}
