// Metering and white balance of the look `photo`, as seasonscapes/exposure.py.

const LUMINANCE = [0.212639, 0.7151687, 0.0721923];
const METER_CONSTANT = 12.5 / 100;
export const luminance = (rgb) => rgb[0] * LUMINANCE[0] + rgb[1] * LUMINANCE[1] + rgb[2] * LUMINANCE[2];

/** The colour that is made neutral, for the sun's normal illuminance. */
export function whiteOf(normal) {
  if (!(normal[1] > 0)) return [1, 1, 1];
  const w = [Math.min(normal[0] / normal[1], 1.14), 1, Math.max(normal[2] / normal[1], 0.86)];
  const y = luminance(w);
  return w.map((value) => value / y);
}

/** The EV100 of a camera's metering of luminances [cd/m²]. */
export function meteredEv(luminances) {
  const values = luminances.filter((v) => v > 0 && Number.isFinite(v)).sort((a, b) => a - b);
  if (!values.length) return 15;
  const percentile = (p) => {
    const x = (p / 100) * (values.length - 1);
    const k = Math.floor(x);
    return values[k] + (x - k) * ((values[k + 1] ?? values[k]) - values[k]);
  };
  const [low, high] = [percentile(2), percentile(98)];
  const middle = values.filter((v) => v >= low && v <= high);
  let ev = Math.log2(Math.exp(middle.reduce((sum, v) => sum + Math.log(v), 0) / middle.length) / METER_CONSTANT);
  ev += Math.min(Math.max(0.25 * (4 - ev), 0), 3);
  if (ev < 4) return ev - Math.min(Math.max((4 - ev) / 13, 0), 0.6);
  const highlight = Math.max((percentile(97) * 1.6) / (1.2 * 2 ** ev), 1e-6);
  return ev - Math.min(Math.max(Math.log2(0.8 / highlight), -0.3), 0.9);
}
