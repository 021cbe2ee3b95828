// Opens a page of the Prefect user interface, as a user does, and says which of its pictures are drawn.
//
// The one argument is a request, in JSON:
//   {"login": address that signs in, "address": of the page, "wait": for so many pictures, "text": for these words,
//    "screenshot": a PNG of the page}
// Prints
//   {"text": of the page, "pictures": [{"name": its alternative text, "width", "height": of the picture itself,
//    "box": [left, top, width, height] on the screenshot, in pixels}, ...], "links": addresses}
import { inBrowser, signIn } from "./browser.mjs";

const { login, address, wait, text, screenshot } = JSON.parse(process.argv[2]);
const PICTURES = "img[src^='data:']";
const LONGEST = { timeout: 60_000 };

const result = await inBrowser({}, { width: 1200, height: 4600 }, async (page) => {
  await signIn(page, login, address);
  await page.getByText(text).first().waitFor(LONGEST);
  await page.waitForFunction(
    ([pictures, wait]) => [...document.querySelectorAll(pictures)].filter((one) => one.naturalWidth > 0).length >= wait,
    [PICTURES, wait],
    LONGEST,
  );
  await page.screenshot({ path: screenshot });
  const pictures = await page.locator(PICTURES).evaluateAll((images) => images.map((image) => {
    const { left, top, width, height } = image.getBoundingClientRect();
    return { name: image.alt, width: image.naturalWidth, height: image.naturalHeight, box: [left, top, width, height] };
  }));
  const links = await page.locator("a").evaluateAll((all) => all.map((link) => link.href));
  return { text: await page.locator("body").innerText(), pictures, links };
});
console.log(JSON.stringify(result));
