// Draws a page's surface in other states.
//
// The job is a list of {page, states}; a state is what stands after # in the page's address. Answers,
// per page, {canvases, requests, messages}, a canvas being {width, height, pixels}, RGBA codes in
// base64, row 0 at the top.

import { pathToFileURL } from "node:url";

export default async function (browser, job) {
  const answers = [];
  for (const { page: path, states } of job) {
    const page = await browser.newPage({ viewport: { width: 1000, height: 800 } });
    const [requests, messages, canvases] = [[], [], []];
    page.on("console", (message) => messages.push(message.text()));
    page.on("pageerror", (error) => messages.push(String(error)));
    page.on("request", (request) => { if (!/^(file|data):/.test(request.url())) requests.push(request.url()); });
    await page.goto(pathToFileURL(path).href);
    await page.waitForSelector(".viewer.drawn");
    for (const state of states) {
      canvases.push(await page.evaluate(async (state) => {
        if (location.hash.slice(1) !== state) location.hash = state;
        for (let frame = 0; frame < 3; frame++) await new Promise(requestAnimationFrame);
        const canvas = document.getElementById("canvas");
        const gl = canvas.getContext("webgl2");
        const { width, height } = canvas;
        const codes = new Uint8Array(4 * width * height);
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, codes);
        let letters = "";
        for (let row = height - 1; row >= 0; row--) {
          letters += String.fromCharCode(...codes.subarray(4 * width * row, 4 * width * (row + 1)));
        }
        return { width, height, pixels: btoa(letters) };
      }, state));
    }
    answers.push({ canvases, requests, messages });
    await page.close();
  }
  return answers;
}
