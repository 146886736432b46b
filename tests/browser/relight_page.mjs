// Uses a page of maps as a reader does.
//
// Answers the light and the readout after a drag to the upper right and after a key, each map's
// legend, and whether the still picture shows where there is no WebGL2.

import { pathToFileURL } from "node:url";
import { withoutWebGL } from "./without_webgl.mjs";

export default async function (browser, path) {
  const address = pathToFileURL(path).href;
  const page = await browser.newPage({ viewport: { width: 1000, height: 900 } });
  const seen = { messages: [], requests: [], legends: {} };
  page.on("console", (message) => seen.messages.push(message.text()));
  page.on("pageerror", (error) => seen.messages.push(String(error)));
  page.on("request", (request) => { if (!/^(file|data):/.test(request.url())) seen.requests.push(request.url()); });
  await page.goto(address);
  await page.waitForSelector(".viewer.drawn");
  const light = async () => {
    await page.waitForTimeout(200);
    return new URLSearchParams(new URL(page.url()).hash.slice(1)).get("light0");
  };
  const box = await page.locator("#canvas").boundingBox();
  await page.mouse.move(box.x + 0.5 * box.width, box.y + 0.5 * box.height);
  await page.mouse.down();
  await page.mouse.move(box.x + 0.75 * box.width, box.y + 0.25 * box.height, { steps: 3 });
  await page.mouse.up();
  seen.dragged = await light();
  seen.pointer = await page.locator("#pointer").innerText();
  await page.locator("#canvas").press("ArrowLeft");
  seen.pressed = await light();
  for (const name of await page.locator("#map option").allInnerTexts()) {
    await page.selectOption("#map", name);
    await page.waitForTimeout(200);
    seen.legends[name] = await page.locator("#legend").innerText();
  }
  seen.without = await withoutWebGL(browser, address);
  return seen;
}
