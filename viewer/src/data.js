// A scene's description, arrays and pictures: from the page's own folder, or from the page itself.
import { unpack } from "./arrays.js";

/** Read the scene; `report(share)` is called while the large file arrives. */
export async function loadScene(report) {
  const embedded = document.getElementById("scene.json");
  const read = embedded ? readEmbedded : readFile;
  const about = embedded ? JSON.parse(embedded.textContent) : JSON.parse(new TextDecoder().decode(await readFile("scene.json")));
  const binary = await read("scene.bin", report);
  const arrays = unpackAll(binary, about.arrays);
  const picture = async (file) => new Blob([await read(file)], { type: "image/webp" });
  /** The distilled Gaussians, which are read when they are asked for. */
  const layer = async (told) => {
    const { file, arrays: entries, ...facts } = about.gaussians;
    return { about: facts, arrays: unpackAll(await read(file, told), entries) };
  };
  return { about, arrays, picture, layer, file: read };
}

function unpackAll(binary, entries) {
  return Object.fromEntries(Object.entries(entries).map(([name, entry]) => [name, unpack(binary, entry)]));
}

async function readFile(name, report) {
  const reply = await fetch(name);
  if (!reply.ok) throw new Error(`${name}: the server answers ${reply.status}`);
  if (!report || !reply.body) return reply.arrayBuffer();
  const total = Number(reply.headers.get("Content-Length")) || 0;
  const pieces = [];
  let got = 0;
  const reader = reply.body.getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    pieces.push(value);
    got += value.length;
    if (total) report(got / total);
  }
  return new Blob(pieces).arrayBuffer();
}

function readEmbedded(name) {
  const element = document.getElementById(name);
  if (!element) throw new Error(`${name} is not in this page`);
  const text = atob(element.textContent.trim());
  const bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  return bytes.buffer;
}
