// What of a page is seen where the browser has no WebGL2.
export async function withoutWebGL(browser, address) {
  const page = await browser.newPage();
  await page.addInitScript(() => { HTMLCanvasElement.prototype.getContext = () => null; });
  await page.goto(address);
  return { still: await page.locator("#still").isVisible(), viewer: await page.locator("#viewer").isVisible() };
}
