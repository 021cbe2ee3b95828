// The Khronos glTF validator.
// Usage: node validate.mjs FILE.glb ...
// Prints {errors, warnings, infos, hints: counts over all files, messages: [{file, code, message, pointer, severity}]};
// severity 0 is an error, 1 a warning.
import { readFile } from "node:fs/promises";
import { validateBytes } from "gltf-validator";

const total = { errors: 0, warnings: 0, infos: 0, hints: 0, messages: [] };
for (const file of process.argv.slice(2)) {
  const content = new Uint8Array(await readFile(file));
  const { issues } = await validateBytes(content, { maxIssues: 1000, writeTimestamp: false });
  total.errors += issues.numErrors;
  total.warnings += issues.numWarnings;
  total.infos += issues.numInfos;
  total.hints += issues.numHints;
  total.messages.push(...issues.messages.map((message) => ({ file, ...message })));
}
console.log(JSON.stringify(total));
