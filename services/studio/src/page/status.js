// Progress of a run or a batch, as operators see it: the same view as `segwild top` and `segwild status --json`.

import { getJson, send } from "./api.js";
import { element } from "./objects.js";
import { text } from "./strings.js";

/** @typedef {import("./main.js").App} App */

/** Milliseconds between two views. */
const AGAIN = 2000;

const pane = /** @type {HTMLElement} */ (document.getElementById("status"));

/** @param {number | null | undefined} seconds */
const duration = seconds => seconds == null ? "" : seconds < 90 ? `${seconds.toFixed(1)} s` : `${(seconds / 60).toFixed(1)} min`;
/** @param {number | null | undefined} bytes */
const mib = bytes => bytes == null ? "" : `${Math.round(bytes / 2 ** 20)} MiB`;

/** A table. @param {string[]} heads @param {(Node | string)[][]} rows */
function table(heads, rows) {
  const head = heads.map(name => element("th", { scope: "col" }, text(name)));
  const body = rows.map(([first, ...rest]) => element("tr", {}, element("th", { scope: "row" }, first), ...rest.map(cell => element("td", {}, cell))));
  return element("table", {}, element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...body));
}

/** The progress pane. */
export class StatusPane {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /** Shows the view, and goes on as long as the pane is open. */
  async show() {
    clearTimeout(this.timer);
    const view = await getJson("/api/v1/status").catch(error => ({ kind: "", error: error.message }));
    if (this.app.view !== "status") return;
    const parts = { run: () => this.run(view), batch: () => this.batch(view) };
    const made = parts[/** @type {keyof typeof parts} */ (view.kind)]?.() ?? [element("p", {}, text("no_status"))];
    pane.replaceChildren(...made);
    this.timer = setTimeout(() => this.show(), AGAIN);
  }

  /** @param {any} run */
  run(run) {
    const psnr = run.numbers["geometry.psnr_db"];
    const facts = [run.state, psnr == null ? "" : `${psnr.toFixed(1)} dB`, run.left_s == null ? "" : text("status_left", duration(run.left_s)), mib(run.rss_bytes), run.still_s > 5 ? text("status_still", duration(run.still_s)) : ""];
    const stages = run.stages.map((/** @type {any} */ s) => [
      s.name, s.state, this.bar(s.name, s.total ? s.done / s.total : Number(s.state === "done"), s.total ? `${s.done}/${s.total}` : ""),
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
    if (lines.length) parts.push(element("ul", {}, ...lines.map(line => element("li", {}, line))));
    return parts;
  }

  /** @param {any} batch */
  batch(batch) {
    const rows = batch.scenes.map((/** @type {any} */ s) => {
      const share = s.run ? s.run.stages.reduce((/** @type {number} */ sum, /** @type {any} */ t) => sum + (t.state === "done" ? 1 : t.total ? t.done / t.total : 0), 0) / s.run.stages.length : 0;
      const retry = () => this.retry(s.name);
      const error = s.state === "dead" ? element("span", {}, `${s.error ?? ""} `, element("button", { type: "button", click: retry, "aria-label": text("retry_of", s.name) }, text("retry"))) : s.error ?? s.why ?? "";
      const open = element("button", { type: "button", click: () => this.app.open(s.name), disabled: !s.run }, s.name);
      return [open, s.state, this.bar(s.name, s.state === "done" ? 1 : share, ""), `${s.failures}/${s.attempts}`, mib(s.run?.rss_bytes), duration(s.wall_s), error];
    });
    const used = text("status_used", batch.used.cores, batch.budget.cores, mib(batch.used.memory_bytes), mib(batch.budget.memory_bytes));
    return [element("h2", {}, `${batch.name}: ${used}`), table(["status_scene", "status_state", "status_done", "status_failures", "status_memory", "status_time", "status_waits"], rows)];
  }

  /** @param {string} name @param {number} share @param {string} words */
  bar(name, share, words) {
    return element("span", {}, element("progress", { max: 1, value: share, "aria-label": name }), ` ${words}`);
  }

  /** Gives a scene that was given up another chance. @param {string} scene */
  async retry(scene) {
    const retried = send(`/api/v1/scenes/${encodeURIComponent(scene)}/retry`, { method: "POST" });
    await retried.then(() => this.app.say(text("retried", scene)), error => this.app.failed(error));
    this.show();
  }
}
