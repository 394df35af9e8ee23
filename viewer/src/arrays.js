// Arrays of scene.bin: half-precision numbers become single ones.

const HALF = makeHalfTable();

/** A view of one array, or its numbers in single precision. */
export function unpack(buffer, { offset, shape, type }) {
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
