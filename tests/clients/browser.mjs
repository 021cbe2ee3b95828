// A headless Chromium whose pages see the files of chosen folders at 127.0.0.1, and nothing else.
import { existsSync } from "node:fs";
import { readFile } from "node:fs/promises";
import { createServer } from "node:http";
import path from "node:path";
import { chromium } from "playwright-core";

const PLACES = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"];
const FLAGS = [
  "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
  "--disable-component-update", "--disable-sync",
];
const KINDS = {
  ".html": "text/html", ".js": "text/javascript", ".mjs": "text/javascript", ".json": "application/json",
  ".wasm": "application/wasm", ".glb": "model/gltf-binary", ".png": "image/png", ".jpg": "image/jpeg",
};

// The path of the browser: $CHROMIUM, or the first of the usual names on the PATH.
function findBrowser() {
  const folders = (process.env.PATH ?? "").split(path.delimiter);
  const candidates = [process.env.CHROMIUM, ...PLACES.flatMap((name) => folders.map((at) => path.join(at, name)))];
  return candidates.find((candidate) => candidate && existsSync(candidate));
}

// Serves {"/prefix/": folder, "/name.glb": file, "/page.html": {html: "..."}}; resolves to {origin, close}.
export async function serve(routes) {
  const server = createServer(async (request, response) => {
    const place = decodeURIComponent(new URL(request.url, "http://localhost").pathname);
    const prefix = Object.keys(routes).find((key) => (key.endsWith("/") ? place.startsWith(key) : place === key));
    try {
      const route = routes[prefix];
      const content = route.html ?? (await readFile(path.join(route, place.slice(prefix.length))));
      const kind = KINDS[path.extname(place)] ?? "application/octet-stream";
      response.writeHead(200, { "Content-Type": kind });
      response.end(content);
    } catch {
      response.writeHead(place === "/favicon.ico" ? 204 : 404).end();
    }
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  return { origin: `http://127.0.0.1:${server.address().port}`, close: () => server.close() };
}

// Opens a page of the Prefect server on the way of its sign-in. Prefect forgets the secret if it is asked for a second
// page while it checks the secret for the first.
export async function signIn(page, login, address) {
  const url = new URL(login);
  url.searchParams.set("next", address);
  await page.goto(url.href);
  await page.waitForURL((url) => !url.pathname.startsWith("/dg4d/"));
}

// A headless browser; ends the program with {"missing": ...} where there is none. Only 127.0.0.1 can be reached.
export async function launch(flags = []) {
  const executablePath = findBrowser();
  if (!executablePath) {
    console.log(JSON.stringify({ missing: "no chromium or google-chrome on the PATH (or named by $CHROMIUM)" }));
    process.exit(0);
  }
  return chromium.launch({ executablePath, args: [...FLAGS, ...flags] });
}

// Runs `work(page, origin)` with a page that sees `routes`; gives its result. What the page complains about is thrown.
export async function inBrowser(routes, { width, height }, work) {
  const browser = await launch();
  const server = await serve(routes);
  try {
    const page = await browser.newPage({ viewport: { width, height } });
    const complaints = [];
    page.on("console", (message) => {
      if (message.type() === "error" && !message.location().url.endsWith("/favicon.ico")) complaints.push(message.text());
    });
    page.on("pageerror", (error) => complaints.push(String(error)));
    page.on("requestfailed", (request) => complaints.push(`${request.url()}: ${request.failure()?.errorText}`));
    await page.route((url) => url.protocol.startsWith("http") && url.hostname !== "127.0.0.1", (route) => route.abort());
    const result = await work(page, server.origin);
    if (complaints.length > 0) throw new Error(`the page complained:\n${complaints.join("\n")}`);
    return result;
  } finally {
    await browser.close();
    server.close();
  }
}
