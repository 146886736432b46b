// Uses a page's viewer as a reader does.
//
// Answers the address after a drag on the surface and after one beside it, what the controls say,
// the copied texts with other numbers, and whether the still picture shows where there is no WebGL2.

import { pathToFileURL } from "node:url";
import { withoutWebGL } from "./without_webgl.mjs";

export default async function (browser, path) {
  const address = pathToFileURL(path).href;
  const page = await browser.newPage({ viewport: { width: 1000, height: 900 } });
  const messages = [];
  page.on("console", (message) => messages.push(message.text()));
  page.on("pageerror", (error) => messages.push(String(error)));
  await page.goto(address);
  await page.waitForSelector(".viewer.drawn");
  const seen = { messages };
  const text = (selector) => page.locator(selector).allInnerTexts();
  seen.notes = await text("#notes li");
  seen.fixed = await page.locator("#still").isVisible();
  seen.disabled = await page.locator(".number input[type=range]:disabled").count();
  seen.reasons = await text(".number .reason");
  seen.verdict = (await text("#verdict"))[0];
  const state = async () => {
    await page.waitForTimeout(200);
    return new URL(page.url()).hash.slice(1);
  };
  // A busy machine takes its time to put the address back.
  const restored = async () => {
    await page.waitForFunction(() => location.hash.length < 2, undefined, { timeout: 10000 }).catch(() => {});
    return state();
  };
  const box = await page.locator("#canvas").boundingBox();
  const drag = async (from, to) => {
    await page.mouse.move(box.x + from[0] * box.width, box.y + from[1] * box.height);
    await page.mouse.down();
    await page.mouse.move(box.x + to[0] * box.width, box.y + to[1] * box.height, { steps: 3 });
    await page.mouse.up();
    return state();
  };
  await page.mouse.move(box.x + 0.2 * box.width, box.y + 0.5 * box.height);
  seen.pointer = (await text("#pointer"))[0];
  seen.on_surface = await drag([0.2, 0.5], [0.275, 0.35]);
  seen.beside = await drag([0.02, 0.03], [0.06, 0.03]);
  seen.unlike = await page.locator(".pane:visible").count();
  await page.click("#own");
  seen.own = await restored();
  const numbers = page.locator(".number:not(.unknown) input[type=number]");
  for (let i = 0; i < await numbers.count(); i++) {
    await numbers.nth(i).fill(i === (await numbers.count()) - 1 ? "77" : String(0.1 + 0.05 * i));
    await numbers.nth(i).blur();
  }
  await state();
  seen.copied = {};
  for (const format of ["json", "mtl", "three", "glsl"]) {
    await page.click(`[data-format=${format}]`);
    await page.waitForTimeout(100);
    seen.copied[format] = { text: await page.inputValue("#text"), losses: await text("#losses li") };
  }
  await page.click("#reset");
  seen.reset = await restored();
  seen.without = await withoutWebGL(browser, address);
  return seen;
}
