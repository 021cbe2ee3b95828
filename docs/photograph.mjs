// Takes a screenshot of a page of the Prefect UI.
//
// The one argument is a request, in JSON:
//   {"login": address that signs in, "address": path of the page, "text": text to wait for, "tab": tab to open, if any, "screenshot": PNG file}
import { launch, signIn } from "../tests/clients/browser.mjs";

const { login, address, text, tab, screenshot } = JSON.parse(process.argv[2]);
const browser = await launch(["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]); // the graph needs WebGL
try {
  const page = await browser.newPage({ viewport: { width: 1280, height: 1080 } });
  page.on("console", (message) => message.type() === "error" && console.error(message.text()));
  page.on("pageerror", (error) => console.error(String(error)));
  await signIn(page, login, address);
  await page.getByText(text).first().waitFor({ timeout: 60_000 });
  if (tab) await page.getByRole("tab", { name: tab }).click();
  await page.waitForTimeout(10_000); // the graph is drawn on a canvas and moves to its place
  await page.screenshot({ path: screenshot });
} finally {
  await browser.close();
}
