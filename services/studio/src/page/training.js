// The training: its photos and its curves, until there is a scene to show.

import { element } from "./objects.js";
import { text } from "./strings.js";
import { HEIGHT, WIDTH, plot } from "./tables.js";

/** @typedef {import("./main.js").App} App */
/** @typedef {import("./api.js").Moment} Moment */

/** Long side of the photos in pixels. */
const SIDE = 320;

const of = (/** @type {string} */ id) => /** @type {HTMLElement} */ (document.getElementById(id));

/** A curve with its last value. @param {Moment[]} moments @param {"loss" | "psnr"} name @param {(value: number) => string} words */
function curve(moments, name, words) {
  const known = moments.filter(moment => Number.isFinite(moment[name])), values = known.map(moment => moment[name]);
  const [low, high] = [Math.min(...values), Math.max(...values)], first = known[0], last = known[known.length - 1];
  const at = (/** @type {Moment} */ moment) => {
    const x = (moment.step - first.step) / (last.step - first.step || 1) * WIDTH;
    return `${x.toFixed(1)} ${((1 - (moment[name] - low) / (high - low || 1)) * HEIGHT).toFixed(1)}`;
  };
  const label = text("curve_of", text(`curve_${name}`), words(values[0]), words(values[values.length - 1]), first.step, last.step);
  return plot(label, `${text(`curve_${name}`)}: ${words(values[values.length - 1])}`, `M${known.map(at).join("L")}`);
}

/** The curves of a training; none where it has just started. @param {Moment[]} moments */
export function curves(moments) {
  if (moments.filter(moment => Number.isFinite(moment.loss) && Number.isFinite(moment.psnr)).length < 2) return [];
  return [curve(moments, "loss", value => value.toPrecision(3)), curve(moments, "psnr", value => `${value.toFixed(1)} dB`)];
}

/** What is shown in the stead of photo and scene as long as there is no scene. */
export class TrainingPane {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.photos = "";
    of("early").append(
      element("h2", {}, text("early")), element("p", { id: "early-words", className: "quiet" }),
      element("div", { id: "early-curves", className: "curves" }), element("ul", { id: "early-photos" }));
  }

  /** Shows the photos and the curves as they are now; returns whether there are any. */
  async show() {
    const { run } = this.app, training = await run.training().catch(() => null);
    if (!training || run !== this.app.run) return false;
    const { photos, history } = training, last = history[history.length - 1];
    const words = photos.length ? text("early_photos", photos.length) : "";
    of("early-words").textContent = last ? `${words} ${text("early_step", last.step, last.splats)}` : words;
    of("early-curves").replaceChildren(...curves(history));
    const key = `${run.name}/${photos.join("/")}`;
    if (key !== this.photos) {
      this.photos = key;
      of("early-photos").replaceChildren(...photos.map((name, i) =>
        element("li", {}, element("img", { loading: "lazy", alt: name, title: name, src: run.earlyPhoto(i, SIDE) }))));
    }
    return photos.length + history.length > 0;
  }
}
