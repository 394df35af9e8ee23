// Colours of distilled Gaussians under a light, as seasonscapes/gaussians/appearance.py.
import { luminance } from "./exposure.js";

const BODIES = 2;
const srgb = Float32Array.from({ length: 256 }, (_, level) => {
  const value = level / 255;
  return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
});

/** A model as `scene.layer()` gives it; `orderAt(east, north)` tells when a place loses its snow, 0 to 1, or null. */
export function makeGaussians({ about, arrays }, orderAt) {
  const { count, kind, days, azimuths } = about;
  const data = (name) => arrays[name].data;
  const physical = kind !== "sun";
  const network = kind !== "physical";
  const rank = arrays.sky_scale.shape[0];
  const axes = data("axes");
  const means = data("means");
  const order = new Float32Array(count).fill(0.5);
  if (days.length > 1) for (let n = 0; n < count; n++) order[n] = orderAt(means[3 * n], means[3 * n + 1]) ?? 0.5;
  const albedo = new Float32Array(3 * count);
  const surroundings = new Float32Array(3 * count);
  let season = null;

  /** Albedo of a day of the year, as the page's ground. */
  function setDay(at) {
    const { before, after, share } = between(days, at);
    const key = `${before}:${after}:${share.toFixed(3)}`;
    if (key === season) return;
    season = key;
    const [from, to] = [before, after].map((k) => 3 * count * k);
    const [stored, around] = [data("albedo"), data("surroundings")];
    for (let n = 0; n < count; n++) {
      let [change, sum] = [0, 0];
      for (let c = 0; c < 3; c++) {
        const step = srgb[stored[to + 3 * n + c]] - srgb[stored[from + 3 * n + c]];
        change += [0.2126, 0.7152, 0.0722][c] * step;
        sum += step;
      }
      const when = sum < 0 ? order[n] : 1 - order[n];
      const line = Math.min(Math.max((share - (0.1 + 0.8 * when)) / 0.2 + 0.5, 0), 1);
      const strong = smoothstep(0.08, 0.25, Math.abs(change));
      const own = share > 0 ? share + strong * (line - share) : 0;
      for (let c = 0; c < 3; c++) {
        const k = 3 * n + c;
        const first = srgb[stored[from + k]];
        albedo[k] = first + own * (srgb[stored[to + k]] - first);
        const wide = srgb[around[from + k]];
        surroundings[k] = wide + share * (srgb[around[to + k]] - wide);
      }
    }
  }

  /** Radiance [cd/m²] of all Gaussians: (3 N). `light` holds bodies, sky coefficients (rank, 3), skyLx, globalLx, day. */
  function radiance(light, { withNetwork = true } = {}) {
    setDay(light.day);
    const bodies = light.bodies.map((each) => ({ ...each, size: luminance(each.normal) })).filter(({ size }) => size > 1e-4 * light.globalLx);
    bodies.sort((a, b) => b.size - a.size);
    const shown = bodies.slice(0, BODIES).map(({ direction, normal }) => ({ direction, normal: normal.map((v) => v / light.globalLx) }));
    const skyLight = Float32Array.from(light.sky, (value, k) => (value * Math.PI * data("sky_scale")[Math.floor(k / 3)]) / light.globalLx);
    const bounceLight = new Float32Array(15);
    for (let c = 0; c < 3; c++) {
      for (const { direction, normal } of shown) for (let k = 0; k < 4; k++) bounceLight[3 * k + c] += (k ? direction[k - 1] : 1) * normal[c];
      bounceLight[12 + c] = light.skyLx[c] / light.globalLx;
    }
    for (let k = 0; k < 15; k++) bounceLight[k] *= data("bounce_scale")[Math.floor(k / 3)];
    const looks = shown.map(({ direction }) => {
      const at = ((Math.atan2(direction[0], direction[1]) * azimuths) / (2 * Math.PI) + azimuths) % azimuths;
      const column = Math.floor(at);
      return { elevation: Math.asin(direction[2]), left: column % azimuths, right: (column + 1) % azimuths, fraction: at - column };
    });
    const correct = network && withNetwork ? makeNetwork(light, shown) : null;
    const [normals, horizon, sky, bounce] = ["normals", "horizon", "sky", "bounce"].map(data);
    const [logColour, logGain, shift, logSoftness, openSky] = ["log_colour", "log_gain", "shift", "log_softness", "open_sky"].map(data);
    const unit = light.globalLx / Math.PI;
    const result = new Float32Array(3 * count);
    const features = new Float32Array(8);
    const base = new Float32Array(3);
    for (let n = 0; n < count; n++) {
      for (let c = 0; c < 3; c++) base[c] = albedo[3 * n + c] * Math.exp(logColour[3 * n + c]);
      if (physical) {
        const irradiance = [0, 0, 0];
        features.fill(0);
        shown.forEach(({ direction, normal }, b) => {
          const look = looks[b];
          const cosine = normals[3 * n] * direction[0] + normals[3 * n + 1] * direction[1] + normals[3 * n + 2] * direction[2];
          const [left, right] = [horizon[azimuths * n + look.left], horizon[azimuths * n + look.right]];
          const angle = (left + (right - left) * look.fraction) * about.horizon_step_rad + about.horizon_low_rad;
          const seen = Math.max(cosine, 0) / (1 + Math.exp(-(look.elevation - angle - shift[n]) / Math.exp(logSoftness[n])));
          for (let c = 0; c < 3; c++) irradiance[c] += seen * normal[c];
          if (b === 0) [features[0], features[1]] = [seen, cosine];
        });
        for (let c = 0; c < 3; c++) {
          let [fromSky, fromGround] = [0, 0];
          for (let r = 0; r < rank; r++) fromSky += (sky[rank * n + r] - 128) * skyLight[3 * r + c];
          for (let k = 0; k < 5; k++) fromGround += (bounce[5 * n + k] - 128) * bounceLight[3 * k + c];
          fromSky = Math.max(fromSky, 0) * Math.exp(logGain[2 * n]);
          fromGround = Math.max(fromGround, 0) * surroundings[3 * n + c] * Math.exp(logGain[2 * n + 1]);
          irradiance[c] += fromSky + fromGround;
          if (c === 1) [features[3], features[4]] = [fromSky, fromGround];
        }
        features[2] = openSky[n];
        for (let c = 0; c < 3; c++) {
          features[5 + c] = normals[3 * n + c];
          base[c] *= irradiance[c];
        }
      }
      if (correct) correct(n, base, features);
      for (let c = 0; c < 3; c++) result[3 * n + c] = unit * Math.max(base[c], 0);
    }
    return result;
  }

  /** The network under a light: what depends on the light alone is summed once. */
  function makeNetwork(light, shown) {
    const layers = [0, 1, 2].map((k) => ({ weight: data(`weight${k}`), bias: data(`bias${k}`), inputs: arrays[`weight${k}`].shape[1], outputs: arrays[`weight${k}`].shape[0] }));
    const own = arrays.features.shape[1];
    const time = timeFeatures(light, shown);
    const first = layers[0];
    const fixed = Float32Array.from(first.bias);
    for (let h = 0; h < first.outputs; h++) for (let k = 0; k < time.length; k++) fixed[h] += first.weight[h * first.inputs + own + 3 + k] * time[k];
    const [a, b, last] = layers.map(({ outputs }) => new Float32Array(outputs));
    const inputs = new Float32Array(own + 3 + (physical ? 8 : 0));
    const columns = Int32Array.from(inputs, (_, k) => (k < own + 3 ? k : k + time.length));
    const stored = data("features");
    return (n, base, features) => {
      for (let k = 0; k < own; k++) inputs[k] = stored[own * n + k];
      inputs.set(base, own);
      if (physical) inputs.set(features, own + 3);
      for (let h = 0; h < first.outputs; h++) {
        let sum = fixed[h];
        for (let k = 0; k < inputs.length; k++) sum += first.weight[h * first.inputs + columns[k]] * inputs[k];
        a[h] = Math.max(sum, 0);
      }
      for (const [layer, from, to] of [[layers[1], a, b], [layers[2], b, last]]) {
        for (let h = 0; h < layer.outputs; h++) {
          let sum = layer.bias[h];
          for (let k = 0, w = h * layer.inputs; k < layer.inputs; k++, w++) sum += layer.weight[w] * from[k];
          to[h] = layer === layers[1] ? Math.max(sum, 0) : sum;
        }
      }
      for (let c = 0; c < 3; c++) base[c] = (1 + last[c]) * base[c] + about.shift_of_network * last[3 + c];
    };
  }

  /** Indices of the Gaussians from the farthest to the nearest, along a direction. */
  function backToFront(position, forward, indices) {
    const depth = new Float32Array(count);
    let [low, high] = [Infinity, -Infinity];
    for (let n = 0; n < count; n++) {
      const z = (means[3 * n] - position[0]) * forward[0] + (means[3 * n + 1] - position[1]) * forward[1] + (means[3 * n + 2] - position[2]) * forward[2];
      depth[n] = z;
      low = Math.min(low, z);
      high = Math.max(high, z);
    }
    // A counting sort over 65,536 steps of depth: within a step, discs blend in any order.
    const scale = 65535 / Math.max(high - low, 1e-6);
    const starts = new Uint32Array(65537);
    const bucket = new Uint16Array(count);
    for (let n = 0; n < count; n++) {
      bucket[n] = 65535 - Math.floor((depth[n] - low) * scale);
      starts[bucket[n] + 1] += 1;
    }
    for (let k = 0; k < 65536; k++) starts[k + 1] += starts[k];
    for (let n = 0; n < count; n++) indices[starts[bucket[n]]++] = n;
  }

  return { about, count, means, axes, opacity: data("opacity"), rank, fromSky: data("from_sky"), radiance, backToFront };
}

function timeFeatures({ globalLx, skyLx, day }, shown) {
  const season = (2 * Math.PI * day) / 365.2425;
  const direction = shown[0]?.direction ?? [0, 0, 0];
  const strength = shown[0]?.normal ?? [0, 0, 0];
  const sky = skyLx.map((value) => value / globalLx);
  return [
    ...direction, shown[0] ? 1 : 0, Math.log1p(luminance(strength)), strength[0] - strength[2], luminance(sky), sky[2] - sky[0],
    (Math.log10(globalLx) - 4.5) / 2, Math.sin(season), Math.cos(season), Math.sin(2 * season), Math.cos(2 * season), 1,
  ];
}

/** Between which of some days of the year a day lies, in the order of the year. */
function between(days, at) {
  if (days.length < 2) return { before: 0, after: 0, share: 0 };
  const last = days.reduce((found, day, k) => (day <= at ? k : found), -1);
  const before = last < 0 ? days.length - 1 : last;
  const after = (before + 1) % days.length;
  const gap = (days[after] - days[before] + 365.2422) % 365.2422 || 365.2422;
  return { before, after, share: ((at - days[before] + 365.2422) % 365.2422) / gap };
}

function smoothstep(low, high, x) {
  const t = Math.min(Math.max((x - low) / (high - low), 0), 1);
  return t * t * (3 - 2 * t);
}
