// Opens a page as a reader would: node open_page.mjs PAGE.html SCREENSHOT.png
//
// On standard output, as JSON: every request beyond the page itself, every message of the console, the page's size, its
// text, and how many pictures did not load.

import { resolve } from "node:path";
import { pathToFileURL } from "node:url";
import { launch } from "./browser.mjs";

const address = pathToFileURL(resolve(process.argv[2])).href;
const browser = await launch();
try {
  const page = await browser.newPage({ viewport: { width: Number(process.argv[4] ?? 1000), height: 800 } });
  const requests = [];
  const messages = [];
  page.on("request", (request) => {
    if (request.url() !== address && !request.url().startsWith("data:")) requests.push(request.url());
  });
  page.on("console", (message) => messages.push(message.text()));
  page.on("pageerror", (error) => messages.push(String(error)));
  await page.goto(address);
  const seen = await page.evaluate(() => ({
    text: document.body.innerText,
    pictures: document.images.length,
    broken: Array.from(document.images).filter((image) => !image.complete || image.naturalWidth === 0).length,
    width: document.documentElement.scrollWidth,
    height: document.documentElement.scrollHeight,
  }));
  await page.screenshot({ path: process.argv[3], fullPage: true });
  process.stdout.write(JSON.stringify({ requests, messages, ...seen }));
} finally {
  await browser.close();
}
