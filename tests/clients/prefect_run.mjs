// Uses the Prefect user interface as a person does: signs in, fills in the form of a deployment, cancels its run, opens
// the page of an artifact, and downloads the file that it links to.
//
// The one argument is a request, in JSON:
//   {"login": address that signs in, "deployment": path of its page, "picture", "out": fields of the form,
//    "artifact": path of a page, "link": text of a link on it, "screenshot": a PNG of that page}
// Prints
//   {"state": of the run after it was cancelled, "download": the first bytes in hexadecimal, "elsewhere": addresses on
//    other hosts that a page asked for, "loggedOut": path to which a browser without the secret is sent}
import { readFile } from "node:fs/promises";
import { launch, signIn } from "./browser.mjs";

const { login, deployment, picture, out, artifact, link, screenshot } = JSON.parse(process.argv[2]);
const { origin } = new URL(login);
const LONGEST = { timeout: 60_000 };

const browser = await launch();
try {
  const context = await browser.newContext({ viewport: { width: 1200, height: 1600 } });
  const page = await context.newPage();
  const elsewhere = new Set();
  page.on("request", (request) => {
    if (/^(http|ws)/.test(request.url()) && !request.url().startsWith(origin)) elsewhere.add(request.url());
  });
  page.on("requestfailed", (request) => {
    if (request.failure().errorText === "csp") elsewhere.delete(request.url()); // it never left the browser
  });
  await signIn(page, login, deployment);
  if (page.url().includes("#")) throw new Error("the secret stays in the address");
  await page.getByRole("button", { name: "Run", exact: true }).click(LONGEST);
  await page.getByText("Custom run").click();
  await page.getByLabel("Picture").fill(picture);
  await page.getByLabel("Output folder").fill(out);
  const created = page.waitForResponse((response) => response.url().endsWith("/create_flow_run"));
  await page.getByRole("button", { name: "Submit" }).click();
  const { id } = await (await created).json();
  await page.goto(`${origin}/v2/runs/flow-run/${id}`);
  await page.getByText("Running", { exact: true }).first().waitFor(LONGEST);
  await page.getByRole("button", { name: "Open menu" }).first().click();
  await page.getByRole("menuitem", { name: "Cancel" }).click();
  await page.getByRole("button", { name: "Cancel Flow Run" }).click();
  await page.getByText(/^Cancell(ing|ed)$/).first().waitFor(LONGEST);
  const state = await page.getByText(/^Cancell(ing|ed)$/).first().innerText();

  await page.goto(origin + artifact);
  await page.getByRole("link", { name: link }).first().waitFor(LONGEST);
  await page.screenshot({ path: screenshot });
  const address = await page.getByRole("link", { name: link }).first().getAttribute("href");
  const started = page.waitForEvent("download");
  await page.evaluate((href) => { location.href = href; }, address);
  const download = await readFile(await (await started).path());

  const stranger = await (await browser.newContext()).newPage();
  await stranger.goto(origin + address);
  await stranger.getByText("Not signed in").waitFor(LONGEST);
  console.log(JSON.stringify({
    state, download: download.subarray(0, 8).toString("hex"), elsewhere: [...elsewhere],
    loggedOut: new URL(stranger.url()).pathname,
  }));
} finally {
  await browser.close();
}
