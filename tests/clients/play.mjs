// What the players of animated GLBs share: the request, the page, and pictures of it.
//
// The one argument is a request, in JSON:
//   {"position": [x, y, z], "fov": vertical degrees, "size": pixels, "shading": "color" or "normals",
//    "shows": [{"file": a GLB, "folder": for pictures, "times": [seconds, ...]}, ...]}
// The camera looks at the origin. Writes FOLDER/000.png, ... with alpha, one per time; prints
//   {"shows": [{"animations": names, "duration": seconds}, ...]}
import { writeFile } from "node:fs/promises";
import path from "node:path";
import { inBrowser } from "./browser.mjs";

const IMPORTS = {
  three: "/modules/three/build/three.module.js",
  "three/addons/": "/modules/three/examples/jsm/",
  "@babylonjs/core/": "/modules/@babylonjs/core/",
  "@babylonjs/loaders/": "/modules/@babylonjs/loaders/",
};

// `script`, a module, sets window.open_(url, request), which gives facts and a function from seconds to a data URL.
export async function play(script) {
  const request = JSON.parse(process.argv[2]);
  const html = `<!doctype html><meta charset="utf-8">
    <script type="importmap">${JSON.stringify({ imports: IMPORTS })}</script>
    <script type="module">${script}; window.ready_ = true;</script>`;
  const routes = { "/modules/": path.join(import.meta.dirname, "node_modules"), "/page.html": { html } };
  request.shows.forEach(({ file }, number) => (routes[`/${number}.glb`] = path.resolve(file)));
  const shows = await inBrowser(routes, { width: request.size, height: request.size }, async (page, origin) => {
    await page.goto(`${origin}/page.html`);
    await page.waitForFunction(() => window.ready_);
    const shows = [];
    for (const [number, { folder, times }] of request.shows.entries()) {
      const [facts, pictures] = await page.evaluate(async ([url, request, times]) => {
        const [facts, show] = await window.open_(url, request);
        const pictures = [];
        for (const seconds of times) pictures.push(await show(seconds));
        return [facts, pictures];
      }, [`/${number}.glb`, request, times]);
      shows.push(facts);
      for (const [moment, picture] of pictures.entries()) {
        const name = `${String(moment).padStart(3, "0")}.png`;
        await writeFile(path.join(folder, name), Buffer.from(picture.split(",")[1], "base64"));
      }
    }
    return shows;
  });
  console.log(JSON.stringify({ shows }));
}
