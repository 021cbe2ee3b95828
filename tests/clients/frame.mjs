// Opens an asset as a notebook shows it, in a frame of a page.
//
// The one argument is a file with the HTML of the cell.
// Prints {"ready": true if the viewer in the frame plays, "drawn": share of the canvas that is not transparent,
//   "reached": true if a script in the frame reaches the page around it, "requests": addresses of other hosts}
import { readFile } from "node:fs/promises";
import { inBrowser } from "./browser.mjs";

const routes = { "/page.html": { html: `<!doctype html>${await readFile(process.argv[2], "utf-8")}` } };
const result = await inBrowser(routes, { width: 800, height: 600 }, async (page, origin) => {
  const requests = [];
  page.on("request", (request) => requests.push(request.url()));
  await page.goto(`${origin}/page.html`);
  const frame = page.frames()[1];
  await frame.waitForFunction(() => globalThis.dg4d);
  return {
    ready: await frame.evaluate(() => dg4d.ready.then(() => true, () => false)),
    drawn: await frame.evaluate(() => {
      dg4d.draw();
      const copy = document.createElement("canvas");
      copy.width = copy.height = 64;
      const context = copy.getContext("2d");
      context.drawImage(document.querySelector("canvas"), 0, 0, 64, 64);
      const alphas = context.getImageData(0, 0, 64, 64).data.filter((_, i) => i % 4 === 3);
      return alphas.reduce((sum, alpha) => sum + (alpha > 0), 0) / alphas.length;
    }),
    reached: await frame.evaluate(() => {
      try {
        return Boolean(parent.document.title !== undefined);
      } catch {
        return false;
      }
    }),
    requests: requests.filter((address) => !address.startsWith(origin) && !/^(blob|data|about):/.test(address)),
  };
});
console.log(JSON.stringify(result));
