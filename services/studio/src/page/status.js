// Progress of a run, a batch or a farm, as operators see it: the same view as `segwild top` and `segwild status --json`.

import { Refused, getJson, send } from "./api.js";
import { farm } from "./farm.js";
import { element } from "./objects.js";
import { text } from "./strings.js";
import { bar, duration, mib, reason, table } from "./tables.js";

/** @typedef {import("./main.js").App} App */

/** Milliseconds between two views. */
const AGAIN = 2000;

const pane = /** @type {HTMLElement} */ (document.getElementById("status"));

/** What a button is called. @param {Element} button */
const called = button => button.getAttribute("aria-label") ?? button.textContent;

/** Shows parts in the stead of others; the button that has the focus keeps it. @param {Node[]} parts */
function replace(parts) {
  const held = pane.contains(document.activeElement) && document.activeElement?.matches("button") ? called(document.activeElement) : null;
  pane.replaceChildren(...parts);
  if (held !== null) [...pane.querySelectorAll("button")].find(button => called(button) === held)?.focus({ preventScroll: true });
}

/** The progress pane. */
export class StatusPane {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.round = 0;
    /** Whether the server shows a farm and no folder: the status is the farm's then. */
    this.alone = false;
    this.seen = /** @type {Record<string, any>} */ ({});
  }

  /** Shows the view, each part when it comes, and goes on as long as the pane is open. */
  async show() {
    clearTimeout(this.timer);
    const round = ++this.round;
    const read = async (/** @type {string} */ name) => {
      const get = (/** @type {string} */ path) => getJson(`/api/v1/${path}`).catch(error => {
        if (error instanceof Refused) return { kind: "", error: error.message };
        throw error;
      });
      let seen = await get(name);
      // A folder of runs has no progress of its own.
      if (name === "status" && seen.kind === "" && this.app.run.name) seen = await get(`status?run=${encodeURIComponent(this.app.run.name)}`);
      if (round !== this.round || this.app.view !== "status") return;
      this.seen[name] = seen;
      if (name === "status") this.alone = !!seen.farm;
      replace(this.parts(this.seen.status, this.seen.farm));
    };
    await Promise.all((this.alone ? ["farm"] : ["status", "farm"]).map(read)).catch(error => this.app.failed(error));
    if (round !== this.round || this.app.view !== "status") return;
    this.timer = setTimeout(() => this.show(), AGAIN);
  }

  /** What is shown of a run or a batch, and of a farm; what was not read yet is undefined. @param {any} view @param {any} of @returns {Node[]} */
  parts(view, of) {
    const kinds = { run: () => this.run(view), batch: () => this.batch(view), "": () => [element("p", {}, text("no_status"))] };
    // Without a folder the status is the farm's.
    const own = !view || (of !== null && (view.farm || !view.kind)) ? [] : kinds[/** @type {keyof typeof kinds} */ (view.kind)]();
    if (!of) return own;
    return [...own, ...of.error ? [element("p", {}, text("farm_silence", of.error))] : farm(of, scene => this.retry(scene, "farm/"))];
  }

  /** @param {any} run */
  run(run) {
    const psnr = run.numbers["geometry.psnr_db"];
    const facts = [run.state, psnr == null ? "" : `${psnr.toFixed(1)} dB`, run.left_s == null ? "" : text("status_left", duration(run.left_s)), mib(run.rss_bytes), run.still_s > 5 ? text("status_still", duration(run.still_s)) : ""];
    const stages = run.stages.map((/** @type {any} */ s) => [
      s.name, s.state, bar(s.name, s.total ? s.done / s.total : Number(s.state === "done"), s.total ? `${s.done}/${s.total}` : ""),
      s.rate > 0 ? `${s.rate.toFixed(1)}/s` : "", duration(s.eta_s ?? (s.state === "done" ? s.wall_s : null)), s.error ?? s.why ?? "",
    ]);
    const workers = run.actors.flatMap((/** @type {any} */ a) => [[
      a.name, `${Math.round(100 * a.utilization)} %`, String(a.messages), String(a.retries), String(a.quarantined),
      a.error ?? a.last_error ?? a.workers.map((/** @type {any} */ w) => w.why ?? w.item).filter(Boolean).join("; "),
    ]]);
    const boxes = run.mailboxes.map((/** @type {any} */ m) => [m.name, `${m.depth}/${m.capacity}`, `${mib(m.bytes)} / ${mib(m.capacity_bytes)}`]);
    const lines = [...run.failures.map((/** @type {any} */ f) => `${f.stage}: ${f.photo}: ${f.error}`), ...run.events.map((/** @type {any} */ e) => e.message)];
    const parts = [element("h2", {}, `${run.name}: ${facts.filter(Boolean).join(", ")}`), table(["status_stage", "status_state", "status_done", "status_rate", "status_time", "status_waits"], stages)];
    if (run.running && workers.length) parts.push(table(["status_actor", "status_busy", "status_messages", "status_retries", "status_given_up", "status_waits"], workers));
    if (run.running && boxes.length) parts.push(table(["status_mailbox", "status_messages", "status_bytes"], boxes));
    if (lines.length) parts.push(element("ul", {}, ...[...new Set(lines)].map(line => element("li", {}, line))));
    return parts;
  }

  /** @param {any} batch */
  batch(batch) {
    const rows = batch.scenes.map((/** @type {any} */ s) => {
      const share = s.run ? s.run.stages.reduce((/** @type {number} */ sum, /** @type {any} */ t) => sum + (t.state === "done" ? 1 : t.total ? t.done / t.total : 0), 0) / s.run.stages.length : 0;
      const open = element("button", { type: "button", click: () => this.app.open(s.name), disabled: !s.run }, s.name);
      return [open, s.state, bar(s.name, s.state === "done" ? 1 : share, ""), `${s.failures}/${s.attempts}`, mib(s.run?.rss_bytes), duration(s.wall_s), reason(s, scene => this.retry(scene, ""))];
    });
    const used = text("status_used", batch.used.cores, batch.budget.cores, mib(batch.used.memory_bytes), mib(batch.budget.memory_bytes));
    return [element("h2", {}, `${batch.name}: ${used}`), table(["status_scene", "status_state", "status_done", "status_failures", "status_memory", "status_time", "status_waits"], rows)];
  }

  /** Gives a scene that was given up another chance. @param {string} scene @param {"" | "farm/"} where */
  async retry(scene, where) {
    const retried = send(`/api/v1/${where}scenes/${encodeURIComponent(scene)}/retry`, { method: "POST" });
    await retried.then(() => this.app.say(text(where ? "farm_retried" : "retried", scene)), error => this.app.failed(error));
    this.show();
  }
}
