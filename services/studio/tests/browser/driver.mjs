// Starts the server and the browser, and waits for what the page shows.

import { spawn } from "node:child_process";
import { existsSync } from "node:fs";
import { chromium } from "playwright-core";

/** The program, a trained run and a farm (empty where there is no queue), named by whoever starts the tests. */
export const { SEGWILD: program = "", SEGWILD_RUN: run = "", SEGWILD_FARM: farm = "" } = process.env;
/** Debian's browser, unless another is named. */
const executablePath = process.env.CHROMIUM ?? "/usr/bin/chromium";
/** Software WebGL: there is no GPU in CI. */
const args = ["--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"];
/** Milliseconds after which something never comes. */
const LONGEST = 60_000;

/** A server of a run, or of none; it listens at `address`. @param {string[]} [more] @param {string} [folder] */
export async function serve(more = [], folder = run) {
  if (!existsSync(program)) throw new Error(`SEGWILD=${program}: there is no such program`);
  const child = spawn(program, ["serve", ...folder ? [folder] : [], "--listen", "127.0.0.1:0", ...more], { stdio: ["ignore", "pipe", "inherit"] });
  const address = await new Promise((found, failed) => {
    let text = "";
    child.stdout.on("data", bytes => {
      text += bytes;
      const known = /http:\S+/.exec(text);
      if (known) found(known[0]);
    });
    child.on("exit", code => failed(new Error(`segwild serve ended with ${code}`)));
  });
  const ended = new Promise(done => child.on("exit", done));
  return { child, address: /** @type {string} */ (address), ended };
}

/** @returns {Promise<import("playwright-core").Browser>} */
export const browser = () => chromium.launch({ executablePath, args });

/**
 * Opens the page and waits until it shows a photo and the scene.
 * @param {import("playwright-core").Browser} browser @param {string} address @param {import("playwright-core").BrowserContextOptions} [options]
 */
export async function open(browser, address, options = {}) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 800 }, ...options });
  const page = await context.newPage();
  /** @type {string[]} */
  const errors = [];
  page.on("console", message => message.type() === "error" && errors.push(message.text()));
  page.on("pageerror", error => errors.push(String(error)));
  await page.goto(address);
  await until(page, () => Boolean(/** @type {any} */ (window).segwild?.state && /** @type {any} */ (window).segwild.first.photo));
  return { page, errors, context };
}

/**
 * Waits for a condition of the page. The page's policy forbids `eval`, which Playwright's own waiting needs.
 * @template T @param {import("playwright-core").Page} page @param {(argument: T) => unknown} condition @param {T} [argument]
 */
export async function until(page, condition, argument) {
  const end = Date.now() + LONGEST;
  while (Date.now() < end) {
    if (await page.evaluate(/** @type {any} */ (condition), argument).catch(() => false)) return;
    await new Promise(done => setTimeout(done, 20));
  }
  throw new Error(`it never came: ${condition}`);
}

/** The state that the page shows. @param {import("playwright-core").Page} page @returns {Promise<import("../../src/page/api.js").State>} */
export const state = page => page.evaluate(() => /** @type {any} */ (window).segwild.state);

/** Waits until the answer is whole. @param {import("playwright-core").Page} page */
export const answered = page => until(page, () => document.body.dataset.answer === "done");

/**
 * A position in the open photo on the screen where hovering finds a part, nearest to its middle.
 * @param {import("playwright-core").Page} page
 */
export async function middle(page) {
  const box = await page.locator("#image").boundingBox();
  if (!box) throw new Error("the photo is not shown");
  return { x: box.x + box.width / 2, y: box.y + box.height / 2, box };
}
