// Screenshots that are compared with stored ones.

import assert from "node:assert/strict";
import { existsSync, mkdirSync, mkdtempSync, readFileSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { fileURLToPath } from "node:url";

const folder = fileURLToPath(new URL("./golden/", import.meta.url));
/** Whether the stored ones are written instead of compared. */
const writes = process.env.SEGWILD_GOLDEN === "write";
/** Sides of a stored screenshot; a larger one is made smaller. */
const [WIDTH, HEIGHT] = [480, 300];
/** Mean difference of the channels, of 255, that other fonts and processors may make. */
const MEAN = 6;
/** Share of the pixels that may differ by more than `FAR` in a channel: a mask or an object covers more. */
const SHARE = 0.03;
const FAR = 56;

/**
 * Compares a part of the page with its stored screenshot.
 * @param {import("playwright-core").Page} page @param {string} name @param {string} selector
 */
export async function compare(page, name, selector) {
  const file = join(folder, `${name}.png`), how = "SEGWILD_GOLDEN=write cargo test -p segwild-cli --test it the_page_does";
  const screen = (await page.locator(selector).screenshot()).toString("base64");
  const known = existsSync(file) ? readFileSync(file).toString("base64") : null;
  const found = await page.evaluate(async ({ screen, known, width, height, far }) => {
    const pixels = async (/** @type {string} */ png) => {
      const image = new Image(), canvas = document.createElement("canvas");
      image.src = `data:image/png;base64,${png}`;
      await image.decode();
      Object.assign(canvas, { width, height });
      const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
      const s = Math.min(width / image.width, height / image.height, 1);
      context.imageSmoothingQuality = "high";
      context.drawImage(image, 0, 0, image.width * s, image.height * s);
      return { png: canvas.toDataURL("image/png").split(",")[1], data: context.getImageData(0, 0, width, height).data };
    };
    const present = await pixels(screen);
    if (!known) return { png: present.png, mean: 0, share: 0 };
    const { data } = await pixels(known);
    let sum = 0, count = 0;
    for (let i = 0; i < data.length; i += 4) {
      const differences = [0, 1, 2].map(c => Math.abs(data[i + c] - present.data[i + c]));
      sum += differences[0] + differences[1] + differences[2];
      count += Number(Math.max(...differences) > far);
    }
    return { png: present.png, mean: sum / (data.length * 0.75), share: count / (data.length / 4) };
  }, { screen, known, width: WIDTH, height: HEIGHT, far: FAR });
  const bytes = Buffer.from(found.png, "base64");
  if (writes) {
    mkdirSync(folder, { recursive: true });
    writeFileSync(file, bytes);
    return;
  }
  assert.ok(known, `there is no golden/${name}.png to compare the page with: \`${how}\` makes it; view it before you keep it`);
  if (found.mean <= MEAN && found.share <= SHARE) return;
  const present = join(mkdtempSync(join(tmpdir(), "golden-")), `${name}.png`);
  writeFileSync(present, bytes);
  const figures = `mean ${found.mean.toFixed(1)} of ${MEAN}, share ${found.share.toFixed(3)} of ${SHARE}`;
  assert.fail(`the page differs from golden/${name}.png (${figures}): ${present} is how it is now; if that is right, \`${how}\` keeps it`);
}
