// Opens a page as a reader would.
//
// Answers every request beyond the page itself, every message of the console, the page's size, its
// text, and how many pictures did not load.

import { pathToFileURL } from "node:url";

export default async function (browser, path, screenshot, width = 1000) {
  const address = pathToFileURL(path).href;
  const page = await browser.newPage({ viewport: { width, height: 800 } });
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
  await page.screenshot({ path: screenshot, fullPage: true });
  return { requests, messages, ...seen };
}
