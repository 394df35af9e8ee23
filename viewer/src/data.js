// A scene's description, arrays and pictures: from the page's own folder, or from the page itself.

const HALF = makeHalfTable();

/** Read the scene; `report(share)` is called while the large file arrives. */
export async function loadScene(report) {
  const embedded = document.getElementById("scene.json");
  const read = embedded ? readEmbedded : readFile;
  const about = embedded ? JSON.parse(embedded.textContent) : JSON.parse(new TextDecoder().decode(await readFile("scene.json")));
  const binary = await read("scene.bin", report);
  const arrays = {};
  for (const [name, entry] of Object.entries(about.arrays)) arrays[name] = view(binary, entry);
  return { about, arrays, picture: async (file) => new Blob([await read(file)], { type: "image/webp" }) };
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

function view(buffer, { offset, shape, type }) {
  const count = shape.reduce((product, side) => product * side, 1);
  const Kind = { u8: Uint8Array, u16: Uint16Array, f16: Uint16Array, f32: Float32Array }[type];
  const stored = new Kind(buffer, offset, count);
  if (type !== "f16") return { shape, data: stored };
  const data = new Float32Array(count);
  for (let k = 0; k < count; k++) data[k] = HALF[stored[k]];
  return { shape, data };
}

function makeHalfTable() {
  const table = new Float32Array(65536);
  for (let bits = 0; bits < 65536; bits++) {
    const sign = bits & 0x8000 ? -1 : 1;
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    if (exponent === 31) table[bits] = fraction ? NaN : sign * Infinity;
    else table[bits] = sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
  }
  return table;
}
