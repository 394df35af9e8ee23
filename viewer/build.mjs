// Builds seasonscapes/viewer_page/viewer.js and the notices of what it contains; `node build.mjs FOLDER` writes elsewhere.
import { build } from "esbuild";
import { mkdir, readFile, writeFile } from "node:fs/promises";

const folder = process.argv[2] ?? new URL("../seasonscapes/viewer_page/", import.meta.url).pathname;
await mkdir(folder, { recursive: true });
await build({
  absWorkingDir: new URL(".", import.meta.url).pathname,
  entryPoints: ["src/main.js"],
  outfile: `${folder}/viewer.js`,
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2020",
  legalComments: "none",
  charset: "ascii",
  logLevel: "warning",
});
// astronomy-engine states its licence in the first comment of its program.
async function licence(name) {
  const at = (file) => readFile(new URL(`node_modules/${name}/${file}`, import.meta.url), "utf8");
  if (name !== "astronomy-engine") return at("LICENSE");
  return (await at("astronomy.js")).match(/MIT License[\s\S]*?SOFTWARE\.\n(?=\*\/)/)[0].replace(/^ {4}/gm, "");
}
const licences = [];
for (const name of ["three", "astronomy-engine"]) {
  const about = JSON.parse(await readFile(new URL(`node_modules/${name}/package.json`, import.meta.url)));
  const text = await licence(name);
  licences.push(`${name} ${about.version} (${about.license})\n\n${text.trim()}\n`);
}
await writeFile(`${folder}/NOTICES.txt`, `viewer.js contains\n\n${licences.join("\n")}`);
