// Sky, air, sun and moon of an instant, from the tables of seasonscapes/sky/light_tables.py.
import { RAD, angles, direction } from "./frames.js";

const EXPONENT_ABOVE = 2.5;
const EXPONENT_BELOW = 3;
const CHANNELS = 10;
export const SKY_AZIMUTHS = 96;
export const AIR_AZIMUTHS = 32;
const AIR_BELOW = 8;
const SKY_BELOW = 20;
const GAMMA = 0.0279 / (2 - 0.0279);

export function makeLight(arrays, about) {
  const knots = arrays.light_elevation_deg.data;
  const heights = arrays.light_height_m.data;
  const [S, H, K, C] = arrays.light_sky.shape;
  const [, , AK, M, AC] = arrays.light_air.shape;
  const horizons = arrays.light_horizon_rad.data;
  const distances = arrays.light_distance_m.data;
  const aerosolDepth = about.sky.aerosol_depth;
  const gamma = GAMMA;
  const night = arrays.night;
  const patches = makePatches();

  /** Index and fraction in a sorted list. */
  function between(list, value) {
    const x = Math.min(Math.max(value, list[0]), list[list.length - 1]);
    let low = 0;
    while (low < list.length - 2 && list[low + 1] < x) low++;
    return [low, (x - list[low]) / (list[low + 1] - list[low])];
  }

  /** Indices and weights of a cubic through the knots around a value, with the slopes of its neighbours. */
  function cubic(list, value) {
    const [k, f] = between(list, value);
    const last = list.length - 1;
    const width = list[k + 1] - list[k];
    const [before, after] = [Math.max(k - 1, 0), Math.min(k + 2, last)];
    const [first, second] = [f * (1 - f) ** 2 * width, f * f * (f - 1) * width];
    const weights = new Map();
    const give = (index, weight) => weights.set(index, (weights.get(index) ?? 0) + weight);
    give(k, (1 + 2 * f) * (1 - f) ** 2);
    give(k + 1, f * f * (3 - 2 * f));
    for (const [slope, low, high] of [[first, before, k + 1], [second, k, after]]) {
      // A parabola's slope at the middle of three knots; a straight one at an end.
      const middle = slope === first ? k : k + 1;
      if (low === middle || high === middle) {
        give(high, slope / (list[high] - list[low]));
        give(low, -slope / (list[high] - list[low]));
        continue;
      }
      const [a, b] = [list[middle] - list[low], list[high] - list[middle]];
      give(low, (-slope * b) / (a * (a + b)));
      give(middle, (slope * (b - a)) / (a * b));
      give(high, (slope * a) / (b * (a + b)));
    }
    return [...weights].filter(([, weight]) => weight !== 0);
  }

  /** Components of a table at an elevation and a height: the last axis has CHANNELS values. */
  function components(table, sizes, inner, elevation, height) {
    const [h, fh] = between(heights, height);
    const corners = [];
    for (const [s, ws] of cubic(knots, elevation)) {
      for (const [dh, wh] of [[0, 1 - fh], [1, fh]]) if (wh > 0) corners.push([s, h + dh, ws * wh]);
    }
    const result = new Float32Array(inner);
    const lists = sizes.shape.length === 2 ? 1 : sizes.shape[2];
    for (let list = 0; list < lists; list++) {
      // Sizes fall by powers of ten with the sun and rise with height: their geometric mean.
      const size = Math.exp(corners.reduce((sum, [cs, ch, weight]) => sum + weight * Math.log(sizes.data[(cs * H + ch) * lists + list]), 0));
      for (const [cs, ch, weight] of corners) add(table, cs, ch, list, lists, inner, weight, size, result);
    }
    return result;
  }

  function add(table, s, h, list, lists, inner, weight, size, result) {
    const base = (s * H + h) * inner;
    if (lists === 1) {
      for (let k = 0; k < inner; k++) result[k] += weight * (k % CHANNELS === 9 ? 1 : size) * table[base + k];
      return;
    }
    // Lists are distances, which lie between rows and terms.
    const rows = inner / (lists * AC * CHANNELS);
    for (let row = 0; row < rows; row++) {
      const start = (row * lists + list) * AC * CHANNELS;
      for (let k = 0; k < AC * CHANNELS; k++) {
        result[start + k] += weight * (k % CHANNELS === 9 ? 1 : size) * table[base + start + k];
      }
    }
  }

  const horizonAt = (height) => {
    const [h, f] = between(heights, height);
    return horizons[h] * (1 - f) + horizons[h + 1] * f;
  };

  /** Values (rows, azimuths, CHANNELS) of a cosine series at absolute azimuths, for a luminary at `azimuth`. */
  function spread(series, rows, terms, count, azimuth) {
    const result = new Float32Array(rows * count * CHANNELS);
    const cosines = new Float32Array(count * terms);
    for (let a = 0; a < count; a++) {
      for (let c = 0; c < terms; c++) cosines[a * terms + c] = Math.cos(c * ((a * 360) / count - azimuth) * RAD);
    }
    for (let row = 0; row < rows; row++) {
      for (let a = 0; a < count; a++) {
        const out = (row * count + a) * CHANNELS;
        for (let c = 0; c < terms; c++) {
          const cosine = cosines[a * terms + c];
          const from = (row * terms + c) * CHANNELS;
          for (let k = 0; k < CHANNELS; k++) result[out + k] += cosine * series[from + k];
        }
      }
    }
    return result;
  }

  const gasPhase = (cosine) => (3 / (16 * Math.PI * (1 + 2 * gamma))) * (1 + 3 * gamma + (1 - gamma) * cosine * cosine);

  function aerosolPhase(cosine, depth) {
    const { data, shape } = arrays.phase;
    const [rows, columns] = shape;
    const x = Math.sqrt(Math.acos(Math.min(Math.max(cosine, -1), 1)) / Math.PI) * (columns - 1);
    const y = Math.sqrt(Math.min(Math.max(depth / 6, 0), 1)) * (rows - 1);
    const [x0, y0] = [Math.min(Math.floor(x), columns - 2), Math.min(Math.floor(y), rows - 2)];
    const [fx, fy] = [x - x0, y - y0];
    const at = (r, c) => data[r * columns + c];
    return (at(y0, x0) * (1 - fx) + at(y0, x0 + 1) * fx) * (1 - fy) + (at(y0 + 1, x0) * (1 - fx) + at(y0 + 1, x0 + 1) * fx) * fy;
  }

  /** Radiance of components at a cosine from the luminary, times a colour. */
  function radiance(values, offset, cosine, colour) {
    const gas = gasPhase(cosine);
    return [0, 1, 2].map((k) => {
      const phase = aerosolPhase(cosine, values[offset + 9] * aerosolDepth[k]);
      return colour[k] * (values[offset + k] * gas + values[offset + 3 + k] * phase + values[offset + 6 + k]);
    });
  }

  function scaled(values, colour) {
    const result = values.slice();
    for (let k = 0; k < result.length; k += CHANNELS) {
      for (let c = 0; c < 9; c++) result[k + c] *= colour[c % 3];
    }
    return result;
  }

  /** Add the radiance of a second luminary, its phase functions evaluated at the nodes, to the light that has none. */
  function merge(first, second, directions, body) {
    for (let k = 0, n = 0; k < first.length; k += CHANNELS, n++) {
      const d = directions[n];
      const cosine = d[0] * body.direction[0] + d[1] * body.direction[1] + d[2] * body.direction[2];
      const light = radiance(second, k, cosine, body.colour);
      for (let c = 0; c < 3; c++) first[k + 6 + c] += light[c];
    }
  }

  function rowElevations(horizon, below, above) {
    const list = [];
    for (let k = 0; k < below; k++) list.push(horizon - 1e-5 - (Math.PI / 2 + horizon - 1e-5) * (1 - k / (below - 1)) ** EXPONENT_BELOW);
    for (let k = 0; k < above; k++) list.push(horizon + 1e-5 + (Math.PI / 2 - horizon - 1e-5) * (k / (above - 1)) ** EXPONENT_ABOVE);
    return list.map((value) => value / RAD);
  }

  function gridDirections(elevations, count, repeat = 1) {
    const list = [];
    for (const elevation of elevations) {
      for (let m = 0; m < repeat; m++) for (let a = 0; a < count; a++) list.push(direction((a * 360) / count, elevation));
    }
    return list;
  }

  /** The sky as seen from a height: (K, SKY_AZIMUTHS, CHANNELS) with the sun's light unmerged. */
  function sky(bodies, height) {
    const horizon = horizonAt(height);
    const directions = gridDirections(rowElevations(horizon, SKY_BELOW, K - SKY_BELOW), SKY_AZIMUTHS);
    let total = null;
    for (const body of bodies) {
      const series = components(arrays.light_sky.data, arrays.light_sky_size, K * C * CHANNELS, body.elevation, height);
      const grid = spread(series, K, C, SKY_AZIMUTHS, body.azimuth);
      if (!total) total = scaled(grid, body.colour);
      else merge(total, grid, directions, body);
    }
    return { grid: total, horizon };
  }

  /** The air before a viewer at a height: (K', M, AIR_AZIMUTHS, CHANNELS) and optical depth (K', M, 3). */
  function air(bodies, height) {
    const horizon = horizonAt(height);
    const directions = gridDirections(rowElevations(horizon, AIR_BELOW, AK - AIR_BELOW), AIR_AZIMUTHS, M);
    let total = null;
    for (const body of bodies) {
      const inner = AK * M * AC * CHANNELS;
      const series = components(arrays.light_air.data, arrays.light_air_size, inner, body.elevation, height);
      const grid = spread(series, AK * M, AC, AIR_AZIMUTHS, body.azimuth);
      if (!total) total = scaled(grid, body.colour);
      else merge(total, grid, directions, body);
    }
    const depth = new Float32Array(AK * M * 3);
    const [s, fs] = between(knots, bodies[0].elevation);
    const [h, fh] = between(heights, height);
    for (const [ds, ws] of [[0, 1 - fs], [1, fs]]) {
      for (const [dh, wh] of [[0, 1 - fh], [1, fh]]) {
        const base = ((s + ds) * H + h + dh) * depth.length;
        for (let k = 0; k < depth.length; k++) depth[k] += ws * wh * arrays.light_depth.data[base + k];
      }
    }
    return { grid: total, depth, horizon };
  }

  function rowOf(elevationRad, horizon, below, above) {
    if (elevationRad >= horizon) {
      const up = Math.min((elevationRad - horizon) / (Math.PI / 2 - horizon), 1) ** (1 / EXPONENT_ABOVE) * (above - 1);
      const row = Math.min(Math.floor(up), above - 2);
      return [below + row, up - row];
    }
    const low = (1 - Math.min((horizon - elevationRad) / (Math.PI / 2 + horizon), 1) ** (1 / EXPONENT_BELOW)) * (below - 1);
    const row = Math.min(Math.floor(low), below - 2);
    return [row, low - row];
  }

  /** Radiance [cd/m²] of the sky of `sky(...)` in a direction, without discs. */
  function skyRadiance({ grid, horizon }, towards, first, height) {
    const [azimuth, elevation] = angles(towards);
    const [row, fr] = rowOf(elevation * RAD, horizon, SKY_BELOW, K - SKY_BELOW);
    const x = (azimuth / 360) * SKY_AZIMUTHS;
    const [a0, fa] = [Math.floor(x) % SKY_AZIMUTHS, x - Math.floor(x)];
    const a1 = (a0 + 1) % SKY_AZIMUTHS;
    const values = new Float32Array(CHANNELS);
    for (const [r, wr] of [[row, 1 - fr], [row + 1, fr]]) {
      for (const [a, wa] of [[a0, 1 - fa], [a1, fa]]) {
        const from = (r * SKY_AZIMUTHS + a) * CHANNELS;
        for (let k = 0; k < CHANNELS; k++) values[k] += wr * wa * grid[from + k];
      }
    }
    const cosine = towards[0] * first[0] + towards[1] * first[1] + towards[2] * first[2];
    const background = nightRadiance(elevation, height);
    return radiance(values, 0, cosine, [1, 1, 1]).map((value, k) => Math.max(value, 0) + background[k]);
  }

  function nightRadiance(elevation, height) {
    const rows = night.shape[1];
    const y = Math.min(Math.max(((90 - elevation) / 180) * rows - 0.5, 0), rows - 1.001);
    const [row, f] = [Math.floor(y), y - Math.floor(y)];
    const [h, fh] = between(heights, height);
    return [0, 1, 2].map((k) => {
      const at = (i, r) => night.data[(i * rows + r) * 3 + k];
      return (at(h, row) * (1 - f) + at(h, row + 1) * f) * (1 - fh) + (at(h + 1, row) * (1 - f) + at(h + 1, row + 1) * f) * fh;
    });
  }

  /** Normal illuminance [lx] of the sun at 1 au, at an apparent elevation. */
  function direct(elevation) {
    const list = arrays.direct_deg.data;
    if (elevation < list[0]) return [0, 0, 0];
    const [k, f] = between(list, elevation);
    return [0, 1, 2].map((c) => arrays.direct_lx.data[3 * k + c] * (1 - f) + arrays.direct_lx.data[3 * k + 3 + c] * f);
  }

  /** Mean radiances (patches, 3) of the sky over the lit surface, and its illuminance of level ground [lx]. */
  function patchSky(bodies) {
    const whole = sky(bodies, about.surface_m);
    const means = new Float64Array(patches.length * 3);
    const level = [0, 0, 0];
    patches.forEach(({ directions, solidAngle }, p) => {
      for (const d of directions) {
        const light = skyRadiance(whole, d, bodies[0].direction, about.surface_m);
        for (let c = 0; c < 3; c++) means[3 * p + c] += light[c] / directions.length;
      }
      const up = directions.reduce((sum, d) => sum + Math.max(d[2], 0), 0) / directions.length;
      for (let c = 0; c < 3; c++) level[c] += means[3 * p + c] * solidAngle * up;
    });
    return { means, level };
  }

  /** `fromSky.T @ means`: (rank, 3). */
  function project(fromSky, rank, means) {
    const result = new Float64Array(rank * 3);
    for (let p = 0; p < patches.length; p++) {
      for (let r = 0; r < rank; r++) for (let c = 0; c < 3; c++) result[3 * r + c] += fromSky[p * rank + r] * means[3 * p + c];
    }
    return result;
  }

  /** Coefficients (rank, 3) of the lit surface's sky, its illuminance of level ground [lx], and its patches. */
  function skyCoefficients(bodies) {
    const { means, level } = patchSky(bodies);
    return { coefficients: project(arrays.from_sky.data, arrays.from_sky.shape[1], means), level, means };
  }

  /** Extinction of the aerosol over that of all air at a height, by colour. */
  function hazeShare(height = about.surface_m) {
    const scale = about.sky.aerosol_scale_m;
    const fade = Math.exp(-Math.max(height - about.sky.ground_m, 0) / scale) / scale;
    const gas = Math.exp(-height / 8000) / 8000;
    return about.sky.aerosol_extinction.map((depth, k) => {
      const haze = depth * fade;
      return haze / (haze + about.sky.gas_depth[k] * gas);
    });
  }

  return {
    sky, air, direct, skyCoefficients, project, skyRadiance, nightRadiance, hazeShare,
    rows: { sky: K, skyBelow: SKY_BELOW, air: AK, airBelow: AIR_BELOW }, distances, gamma, aerosolDepth,
  };
}

/** Reinhart's subdivision of the sky and the rows below the horizon, as seasonscapes/rendering/sky_patches.py. */
function makePatches() {
  const tregenza = [30, 30, 24, 24, 18, 12, 6];
  const lower = [[-2, 30], [-5, 30], [-10, 30], [-20, 24], [-40, 12], [-90, 6]];
  const step = 90 / (tregenza.length * 2 + 0.5);
  const counts = tregenza.flatMap((count) => [count * 2, count * 2]);
  const rows = [[90, counts.length * step, 1]];
  for (let k = counts.length - 1; k >= 0; k--) rows.push([(k + 1) * step, k * step, counts[k]]);
  let top = 0;
  for (const [edge, count] of lower) {
    rows.push([top, edge, count]);
    top = edge;
  }
  const patches = [];
  for (const [high, low, count] of rows) {
    const solidAngle = (2 * Math.PI * (Math.sin(high * RAD) - Math.sin(low * RAD))) / count;
    for (let k = 0; k < count; k++) {
      const directions = [];
      for (const fe of [0.25, 0.75]) {
        for (const fa of [0.25, 0.75]) directions.push(direction(((k + fa) * 360) / count, high + (low - high) * fe));
      }
      patches.push({ directions, solidAngle });
    }
  }
  return patches;
}
