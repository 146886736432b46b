// A headless Chromium that draws in software and reaches nothing but what a test hands it, until standard input ends.
//
// A line there is JSON, the name of a program of this folder and what it is called with; a line of standard output is
// what that answers, or {error}.

import { existsSync } from "node:fs";
import { createInterface } from "node:readline";
import { chromium } from "playwright-core";

const found = [process.env.CHROMIUM, "/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"];
const browser = await chromium.launch({
  executablePath: found.find((path) => path && existsSync(path)),
  args: ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
});
for await (const line of createInterface({ input: process.stdin })) {
  const late = setTimeout(() => process.exit(1), 300_000);
  const [name, ...called] = JSON.parse(line);
  const answer = await import(`./${name}.mjs`)
    .then((program) => program.default(browser, ...called))
    .catch((error) => ({ error: String(error.stack) }));
  process.stdout.write(`${JSON.stringify(answer)}\n`);
  await Promise.all(browser.contexts().map((context) => context.close()));
  clearTimeout(late);
}
await browser.close();
