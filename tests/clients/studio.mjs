// Uses the studio as a user does, in Chromium.
//
// The one argument is a request, in JSON:
//   {"login": address that signs in to the studio, "story": name of a function below, ...what it needs}
// Prints what the story saw, with {"complaints": errors of the pages}.
import { readFile, writeFile } from "node:fs/promises";
import { createRequire } from "node:module";
import path from "node:path";
import { launch } from "./browser.mjs";

const request = JSON.parse(process.argv[2]);
const AXE = createRequire(import.meta.url).resolve("axe-core/axe.min.js");
const PHONE = { width: 390, height: 844 };

async function open(context, complaints) {
  const page = await context.newPage();
  page.on("pageerror", (error) => complaints.push(String(error)));
  page.on("console", (message) => {
    if (message.type() === "error" && !/status of 4|ERR_CONNECTION/.test(message.text())) {
      complaints.push(`${message.location().url}: ${message.text()}`);
    }
  });
  await page.route((url) => url.protocol.startsWith("http") && url.hostname !== "127.0.0.1", (route) => {
    complaints.push(`asked for ${route.request().url()}`);
    return route.abort();
  });
  await page.goto(request.login);
  await page.waitForURL((url) => url.pathname === "/dg4d/studio");
  return page;
}

// Violations of axe in the page itself; the viewer is tested elsewhere. Scripts of the driver pass the page's policy.
async function violations(page) {
  await page.evaluate(await readFile(AXE, "utf-8"));
  const found = await page.evaluate(() => axe.run(document, { iframes: false }));
  return found.violations.map(({ id, nodes }) => `${id}: ${nodes.map((node) => node.html.slice(0, 100)).join(" | ")}`);
}

// Files dropped on the page, as a file manager does.
async function drop(page, files) {
  const given = await Promise.all(files.map(async (file) => [path.basename(file), (await readFile(file)).toString("base64")]));
  const data = await page.evaluateHandle((given) => {
    const transfer = new DataTransfer();
    for (const [name, content] of given) {
      transfer.items.add(new File([Uint8Array.from(atob(content), (letter) => letter.charCodeAt(0))], name));
    }
    return transfer;
  }, given);
  await page.dispatchEvent("#drop", "drop", { dataTransfer: data });
}

const wide = (page) => page.evaluate(() => document.documentElement.scrollWidth > innerWidth);
const ended = (page, states) => page.waitForFunction(
  (states) => states.includes(document.querySelector("#state").textContent), states, { timeout: 240000 });
const cutOut = (page) => page.waitForFunction(() => document.querySelector("#stage-wait").hidden, null, { timeout: 60000 });

const stories = {
  // drop -> correct -> convert -> play -> download, with the checks of axe and of the width of a phone on each page
  async convert(page, context) {
    const seen = { violations: [], wide: [] };
    const check = async (name) => {
      seen.violations.push(...(await violations(page)).map((text) => `${name}: ${text}`));
      const size = page.viewportSize();
      await page.setViewportSize(PHONE);
      if (await wide(page)) seen.wide.push(name);
      await page.setViewportSize(size);
      await page.emulateMedia({ colorScheme: "dark" });
      seen.violations.push(...(await violations(page)).map((text) => `${name}, dark: ${text}`));
      await page.emulateMedia({ colorScheme: "light" });
    };
    await check("front");
    await drop(page, [request.picture]);
    await page.waitForURL(/drafts/);
    await cutOut(page);
    const canvas = page.locator("#stage");
    const box = await canvas.boundingBox();
    await page.click("label:has(input[value=remove])");
    await page.mouse.move(box.x + 4, box.y + 4);
    await page.mouse.down();
    await page.mouse.move(box.x + box.width / 2, box.y + 4, { steps: 3 });
    await page.mouse.up();
    await page.click("label:has(input[value=keep])");
    await canvas.focus();
    for (const key of ["ArrowDown", " ", "ArrowRight", " "]) await page.keyboard.press(key);
    seen.undo = await page.isEnabled("#undo");
    await page.check("input[value=wave]");
    await page.fill("input[name=name]", request.name);
    await check("draft");
    await page.click("#go");
    await page.waitForURL(/runs/);
    const other = await context.newPage(); // a second tab shows the same
    await other.goto(page.url());
    await ended(page, ["done", "failed"]);
    await ended(other, ["done", "failed"]);
    seen.states = [await page.textContent("#state"), await other.textContent("#state")];
    seen.steps = await page.locator("#steps li.done").count();
    await check("run");
    await page.click("#open");
    await page.waitForURL(/assets/);
    await check("asset");
    const viewer = page.frames().at(-1);
    await viewer.waitForFunction(() => globalThis.dg4d);
    seen.viewer = await viewer.evaluate(() => dg4d.ready.then(() => dg4d.state(), String));
    seen.reached = await viewer.evaluate(() => {
      try {
        return localStorage.length >= 0;
      } catch {
        return false;
      }
    });
    seen.again = await page.locator("[data-again]").allInnerTexts();
    const waiting = page.waitForEvent("download");
    await page.click("text=asset.glb");
    const download = await waiting;
    seen.downloaded = [download.suggestedFilename(), (await readFile(await download.path())).length];
    return seen;
  },

  // a conversion whose process is killed goes on; the page tells so
  async killed(page) {
    await drop(page, [request.picture]);
    await page.waitForURL(/drafts/);
    await cutOut(page);
    await page.click("#go");
    await page.waitForURL(/runs/);
    await page.waitForFunction(() => !document.querySelector("#reason").hidden, null, { timeout: 240000 });
    const reason = await page.textContent("#reason");
    await ended(page, ["done", "failed"]);
    return { reason, state: await page.textContent("#state"), hidden: await page.isHidden("#reason") };
  },

  // a full disk while a step runs: the reason is shown, and the conversion can be tried again; a cancelled one, too
  async full(page, context) {
    await drop(page, [request.picture]);
    await page.waitForURL(/drafts/);
    await cutOut(page);
    await page.click("#go");
    await page.waitForURL(/runs/);
    await ended(page, ["failed"]);
    const seen = { reason: await page.textContent("#reason") };
    const first = page.url();
    const other = await context.newPage();
    await other.goto(first);
    await page.click("#retry");
    await page.waitForURL((url) => /runs/.test(url.pathname) && url.href !== first);
    seen.retried = true;
    await other.goto(new URL("/dg4d/studio", first).href);
    seen.listed = await other.locator("#activity strong").allInnerTexts();
    return seen;
  },

  // several pictures are asked about; a refused file leaves its sentence
  async several(page) {
    await drop(page, [request.text]);
    await page.waitForFunction(() => !document.querySelector("#message").hidden);
    const refused = await page.textContent("#message");
    await drop(page, request.pictures);
    await page.waitForSelector("dialog[open]");
    const found = await violations(page);
    await page.click("dialog button[value=views]");
    await page.waitForURL(/drafts/);
    return { refused, violations: found, sides: await page.locator("[data-view]").evaluateAll((all) => all.map((each) => each.value)) };
  },

  // the gallery: first paint, search, filters
  async gallery(page) {
    await page.reload();
    const paint = await page.evaluate(() => new Promise((resolve) => {
      new PerformanceObserver((list) => resolve(list.getEntriesByName("first-contentful-paint")[0].startTime))
        .observe({ type: "paint", buffered: true });
    }));
    const before = await page.locator(".asset").count();
    await page.fill("[name=search]", request.search);
    await page.waitForFunction((before) => document.querySelectorAll(".asset").length < before, before);
    const after = await page.locator(".asset").count();
    await page.fill("[name=search]", "");
    await page.selectOption("[name=verdict]", "failed");
    await page.waitForFunction(() => [...document.querySelectorAll(".asset .badge")].every((each) => each.classList.contains("failed")));
    const failed = await page.textContent("#cards .hint");
    return { paint, before, after, failed, violations: await violations(page), address: page.url() };
  },
};

const complaints = [];
const browser = await launch();
try {
  const context = await browser.newContext({ viewport: { width: 1280, height: 900 }, acceptDownloads: true });
  const page = await open(context, complaints);
  const seen = await stories[request.story](page, context).catch(async (error) => {
    if (request.screenshot) await writeFile(request.screenshot, await page.screenshot());
    throw error;
  });
  console.log(JSON.stringify({ ...seen, complaints }));
} finally {
  await browser.close();
}
