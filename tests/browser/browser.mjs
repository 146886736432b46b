// A headless Chromium that draws in software and reaches nothing but what a test hands it.

import { existsSync } from "node:fs";
import { chromium } from "playwright-core";

export function executable() {
  const found = [process.env.CHROMIUM, "/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"];
  return found.find((path) => path && existsSync(path));
}

export function launch() {
  const args = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"];
  return chromium.launch({ executablePath: executable(), args });
}

// What of a page is seen where the browser has no WebGL2.
export async function withoutWebGL(browser, address) {
  const page = await browser.newPage();
  await page.addInitScript(() => { HTMLCanvasElement.prototype.getContext = () => null; });
  await page.goto(address);
  return { still: await page.locator("#still").isVisible(), viewer: await page.locator("#viewer").isVisible() };
}
