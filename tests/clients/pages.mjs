// Opens pages from the disk on a phone and on a desk, in light and dark, and reports what axe and the layout say.
//
// The one argument is a request, in JSON:
//   {"pages": [file, ...], "widths": [pixels, ...], "schemes": ["light", "dark"], "screenshots": folder or none}
// Prints, by "NAME WIDTH SCHEME",
//   {"violations": of axe's rules, "wide": whether the page scrolls sideways, "mains": number of main landmarks,
//    "embedded": of the viewer in a frame of the page, whether its panel is folded; null without one}
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import path from "node:path";
import { pathToFileURL } from "node:url";
import { inBrowser } from "./browser.mjs";

const { pages, widths = [390, 1280], schemes = ["light", "dark"], screenshots } = JSON.parse(process.argv[2]);
const AXE = await readFile(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf-8");
const HEIGHT = 844;

const look = (page) => page.evaluate(async () => {
  const { violations } = await axe.run(document, { iframes: false });
  return {
    violations: violations.map(({ id, nodes }) => `${id}: ${nodes.map((node) => node.html.slice(0, 100)).join(" | ")}`),
    wide: document.documentElement.scrollWidth > innerWidth,
    mains: document.querySelectorAll("main, [role=main]").length,
  };
});

const seen = await inBrowser({}, { width: widths[0], height: HEIGHT }, async (page) => {
  const seen = {};
  for (const file of pages) {
    await page.goto(pathToFileURL(file).href);
    await page.evaluate(() => window.dg4d?.ready);
    await page.evaluate(AXE);
    for (const colorScheme of schemes) {
      await page.emulateMedia({ colorScheme });
      // the viewer chooses its theme once and then has a button
      await page.evaluate((scheme) => window.dg4d && (document.documentElement.dataset.theme = scheme), colorScheme);
      for (const width of widths) {
        await page.setViewportSize({ width, height: HEIGHT });
        const name = `${path.basename(file, ".html")} ${width} ${colorScheme}`;
        const [, frame] = page.frames();
        await frame?.evaluate(() => dg4d.ready);
        const embedded = frame ? await frame.evaluate(() => document.body.hasAttribute("data-folded")) : null;
        seen[name] = { ...(await look(page)), embedded };
        if (screenshots) await page.screenshot({ path: path.join(screenshots, `${name}.png`), fullPage: true });
      }
    }
  }
  return seen;
});
console.log(JSON.stringify(seen));
