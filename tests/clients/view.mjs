// Opens a viewer page from the disk, as a user does, and tries it out.
//
// The one argument is a request, in JSON:
//   {"page": file, "width": pixels, "height": pixels, "webgl2": false to have none,
//    "reducedMotion": "reduce" for users who ask for it,
//    "shots": [{"show": mode, "time": seconds, "file": a PNG of the canvas, with alpha}, ...],
//    "deeds": [["press", key] or ["drag", dx, dy] or ["wheel", dy] or ["wait", seconds] or ["focus", selector] or
//    ["lose"] and restore the WebGL context while paused, after which the page looks the same, or ["screen", pixels per
//    point] of the one that the window moves to, ...], "screenshot": file}
// Prints
//   {"notice": text, "requests": addresses, "size": [width, height] of the canvas, "states": what dg4d.state() gives when
//    the page is ready and after every deed, "drawn": digests of the picture and "sizes" of the canvas at these moments,
//    "video": its seconds, "facts": text of the panel}
import { createHash } from "node:crypto";
import { writeFile } from "node:fs/promises";
import { pathToFileURL } from "node:url";
import { inBrowser } from "./browser.mjs";

const request = JSON.parse(process.argv[2]);
const { page: file, width, height, webgl2 = true, shots = [], deeds = [], screenshot } = request;
const { reducedMotion = "no-preference" } = request;

// The canvas keeps its picture only until the browser has shown it, so it is drawn anew.
const picture = (page) => page.evaluate(() => (dg4d.draw(), document.querySelector("canvas").toDataURL("image/png")));
const content = (address) => Buffer.from(address.split(",")[1], "base64");

async function act(page, [deed, ...details]) {
  const canvas = page.locator("canvas");
  if (deed === "press") await page.keyboard.press(details[0]);
  if (deed === "wait") await page.waitForTimeout(1000 * details[0]);
  if (deed === "focus") await page.focus(details[0]);
  if (deed === "lose") {
    await page.evaluate(() => dg4d.seek(0));
    const before = await page.screenshot();
    await page.evaluate(async () => {
      const loss = document.querySelector("canvas").getContext("webgl2").getExtension("WEBGL_lose_context");
      loss.loseContext();
      await new Promise((done) => setTimeout(done, 100));
      loss.restoreContext();
    });
    await page.waitForTimeout(500);
    if (!before.equals(await page.screenshot())) throw new Error("the picture is gone with the WebGL context");
  }
  if (deed === "screen") {
    const session = await page.context().newCDPSession(page);
    const screen = { width, height, deviceScaleFactor: details[0], mobile: false };
    await session.send("Emulation.setDeviceMetricsOverride", screen);
    // An emulated screen, unlike a real one, lets queries change only when something else does.
    for (const contrast of ["more", null]) await page.emulateMedia({ contrast });
    await page.waitForTimeout(300);
  }
  if (deed === "wheel") await canvas.hover().then(() => page.mouse.wheel(0, details[0]));
  if (deed === "drag") {
    const box = await canvas.boundingBox();
    const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
    await page.mouse.move(x, y);
    await page.mouse.down();
    await page.mouse.move(x + details[0], y + details[1], { steps: 4 });
    await page.mouse.up();
    await page.waitForTimeout(300);
  }
}

const result = await inBrowser({}, { width, height }, async (page) => {
  const requests = [];
  page.on("request", (request) => requests.push(request.url()));
  if (!webgl2) {
    await page.addInitScript(() => {
      const given = HTMLCanvasElement.prototype.getContext;
      HTMLCanvasElement.prototype.getContext = function (kind, ...options) {
        return kind === "webgl2" ? null : given.call(this, kind, ...options);
      };
    });
  }
  await page.emulateMedia({ reducedMotion });
  await page.goto(pathToFileURL(file).href);
  const ready = await page.evaluate(() => dg4d.ready.then(() => true, () => false));
  const [states, drawn, sizes] = [[], [], []];
  const note = async () => {
    sizes.push(await page.evaluate(() => [document.querySelector("canvas").width, document.querySelector("canvas").height]));
    states.push(await page.evaluate(() => dg4d.state()));
    drawn.push(createHash("sha256").update(content(await picture(page))).digest("hex"));
  };
  if (ready) {
    await note();
    for (const deed of deeds) {
      await act(page, deed);
      await note();
    }
    for (const { show, time, file: target } of shots) {
      await page.evaluate(([show, time]) => (dg4d.show(show), dg4d.seek(time)), [show, time]);
      await writeFile(target, content(await picture(page)));
    }
  }
  if (screenshot) await page.screenshot({ path: screenshot });
  return {
    notice: (await page.locator("#notice").isVisible()) ? await page.locator("#notice").innerText() : "",
    requests: requests.filter((url) => !/^(blob|data):/.test(url)),
    size: sizes[0] ?? null,
    sizes,
    states,
    drawn,
    video: await page.evaluate(() => document.querySelector("video").currentTime),
    facts: await page.locator("#facts").evaluate((element) => element.textContent),
  };
});
console.log(JSON.stringify(result));
