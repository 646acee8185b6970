// A farm, as operators see it: its machines, its scenes, what was done over time. The same view as `segwild status --farm`.

import { element } from "./objects.js";
import { text } from "./strings.js";
import { HEIGHT, WIDTH, bar, duration, mib, plot, reason, table } from "./tables.js";

/** Scenes of a state that are listed. */
const MOST_SCENES = 200;
/** States in the order in which they are listed: what a person can act on comes first. */
const STATES = ["dead", "running", "waiting", "done"];

/** Scenes done over time, as steps. @param {{done: number, seconds: number}[]} past */
function throughput(past) {
  const most = Math.max(1, ...past.map(sample => sample.done));
  const steps = past.map((sample, k) => `V${((1 - sample.done / most) * HEIGHT).toFixed(1)}H${((k + 1) / past.length * WIDTH).toFixed(1)}`);
  const words = text("farm_past", past.reduce((sum, sample) => sum + sample.done, 0), duration(past.length * past[0].seconds), most, duration(past[0].seconds));
  return element("div", { className: "curves" }, plot(words, words, `M0 ${HEIGHT}${steps.join("")}`));
}

/** What of something is used. @param {any} used @param {any} whole */
const share = (used, whole) => whole == null ? `${used}` : text("farm_of", used, whole);

/** A machine. @param {any} w */
function machine(w) {
  const { used, whole } = w, cores = share(used.cores, whole?.cores);
  return [
    w.name, whole?.cores ? bar(text("farm_cores", w.name), used.cores / whole.cores, cores) : cores, share(mib(used.memory_bytes), whole && mib(whole.memory_bytes)),
    [share(used.accelerators, whole?.accelerators), w.accelerator].filter(Boolean).join(" "), String(w.held), duration(w.seen_s), w.paused ?? "",
    w.done_per_hour.toFixed(1), String(w.done), String(w.failed), String(w.silent),
  ];
}

/** The parts that show a farm. @param {any} batch @param {(scene: string) => void} retry @returns {Node[]} */
export function farm(batch, retry) {
  const { workers, past, log, done_per_hour, left_s, oldest_waiting_s } = batch.farm;
  const of = (/** @type {string} */ state) => batch.scenes.filter((/** @type {any} */ s) => s.state === state);
  const counts = STATES.map(state => [of(state).length, state]).filter(([n]) => n).map(([n, state]) => `${n} ${state}`);
  const facts = [...counts, done_per_hour > 0 && text("farm_rate", done_per_hour.toFixed(1)), left_s != null && text("status_left", duration(left_s)),
    oldest_waiting_s > 0 && text("farm_oldest", duration(oldest_waiting_s)), batch.retries && text("farm_retries", batch.retries), batch.leases_expired && text("farm_silences", batch.leases_expired)];
  const listed = STATES.flatMap(state => of(state).slice(0, MOST_SCENES)), more = batch.scenes.length - listed.length;
  const scenes = listed.map((/** @type {any} */ s) => [s.name, s.state, s.worker ?? "", duration(s.wall_s), `${s.failures}/${s.attempts}`, reason(s, retry)]);
  /** @type {Node[]} */
  const parts = [element("h2", {}, text("farm", batch.name)), element("p", {}, facts.filter(Boolean).join(", "))];
  if (log?.void_records) parts.push(element("p", {}, text("farm_void", log.void_records)));
  if (past.length) parts.push(throughput(past));
  parts.push(workers.length
    ? table(["farm_machine", "farm_used", "status_memory", "farm_accelerators", "farm_scenes", "farm_seen", "farm_paused", "farm_hourly", "status_done", "status_failures", "farm_silent"], workers.map(machine))
    : element("p", {}, text("farm_no_machine")));
  if (scenes.length) parts.push(table(["status_scene", "status_state", "farm_machine", "status_time", "status_failures", "status_waits"], scenes));
  if (more > 0) parts.push(element("p", {}, text("farm_more", more)));
  return parts;
}
