// Runs the script of the page that signs in, with stand-ins for the browser.
//
// The one argument is JSON: {"page": the file, "hash": of the address, "kept": stored secret, "status": of the answer}
// Prints {"kept": stored secret afterwards, "left": true if another page was opened}
import { readFile } from "node:fs/promises";

const KEY = "prefect-password";
const asked = JSON.parse(process.argv[2]);
const store = new Map(asked.kept ? [[KEY, asked.kept]] : []);
let left = false;
Object.assign(globalThis, {
  localStorage: {
    getItem: (key) => store.get(key) ?? null,
    setItem: (key, value) => store.set(key, value),
    removeItem: (key) => store.delete(key),
  },
  location: {
    hash: asked.hash, search: "", pathname: "/dg4d/login", origin: "http://127.0.0.1:1", replace: () => (left = true),
  },
  history: { replaceState: () => {} },
  document: { getElementById: () => ({}) },
  fetch: async () => ({ ok: asked.status < 300, status: asked.status, text: async () => "" }),
});
const script = /<script[^>]*>(.*)<\/script>/s.exec(await readFile(asked.page, "utf-8"))[1];
await import(`data:text/javascript,${encodeURIComponent(script)}`);
console.log(JSON.stringify({ kept: store.get(KEY) ?? "", left }));
