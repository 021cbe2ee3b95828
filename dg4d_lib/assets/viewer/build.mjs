// Builds page.html, the template that `viewer_page.py` fills: markup, style and program in one file.
// Usage: node build.mjs [OUTPUT]; equal sources and packages give equal bytes.
import { readFileSync, writeFileSync } from "node:fs";
import path from "node:path";
import { build } from "esbuild";

const here = import.meta.dirname;
const read = (...parts) => readFileSync(path.join(here, ...parts), "utf8");

const common = { absWorkingDir: here, bundle: true, minify: true, write: false, legalComments: "none", target: "es2022" };
const program = await build({ ...common, entryPoints: ["src/main.js"], format: "iife", loader: { ".vert": "text", ".frag": "text" } });
const style = await build({ ...common, entryPoints: ["src/style.css"] });
const licenses = [
  "The viewer is part of dg4d (Apache-2.0). It holds three.js and, as distributed with it, meshoptimizer's decoder,",
  "Copyright (C) 2016-2026 Arseny Kapoulkine, both under this license:\n",
  read("node_modules", "three", "LICENSE").trim(),
].join("\n");

const parts = { licenses, style: style.outputFiles[0].text.trim(), script: program.outputFiles[0].text.trim() };
const page = read("src", "page.html").replace(/@(licenses|style|script)@/g, (_, name) => parts[name]);
writeFileSync(process.argv[2] ?? path.join(here, "page.html"), page);
console.log(JSON.stringify({ bytes: Buffer.byteLength(page) }));
