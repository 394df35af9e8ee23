// Heights on the CPU: pyramids for the march, slopes, chunks of the mesh by distance, times of the sun at a point.
import * as THREE from "three";
import { RAD } from "./frames.js";

export const CELLS = 32;

export function makeTerrain(arrays, about) {
  const { west_m, south_m, step_m, low_m, height_scale_m } = about.grid;
  const [rows, columns] = arrays.heights.shape;
  const stored = arrays.heights.data;
  const up = new Float32Array(rows * columns);
  const known = new Uint8Array(rows * columns);
  let [low, high] = [Infinity, -Infinity];
  for (let k = 0; k < up.length; k++) {
    known[k] = stored[k] ? 255 : 0;
    up[k] = low_m + Math.max(stored[k] - 1, 0) * height_scale_m;
    if (stored[k]) {
      low = Math.min(low, up[k]);
      high = Math.max(high, up[k]);
    }
  }
  const at = (c, r) => up[Math.min(Math.max(r, 0), rows - 1) * columns + Math.min(Math.max(c, 0), columns - 1)];

  function slopes() {
    const half = new Uint16Array(rows * columns * 2);
    for (let r = 0; r < rows; r++) {
      for (let c = 0; c < columns; c++) {
        const [c0, c1, r0, r1] = [Math.max(c - 1, 0), Math.min(c + 1, columns - 1), Math.max(r - 1, 0), Math.min(r + 1, rows - 1)];
        const k = 2 * (r * columns + c);
        half[k] = THREE.DataUtils.toHalfFloat((at(c1, r) - at(c0, r)) / ((c1 - c0) * step_m));
        half[k + 1] = THREE.DataUtils.toHalfFloat((at(c, r1) - at(c, r0)) / ((r1 - r0) * step_m));
      }
    }
    return half;
  }

  /** Greatest height of each cell, of each 2 x 2 cells, and so on. */
  function pyramid() {
    // A power of two, so that the levels are those of a texture.
    let side = 1;
    while (side < Math.max(columns, rows) - 1) side *= 2;
    let values = new Float32Array(side * side).fill(low);
    for (let r = 0; r < rows - 1; r++) {
      for (let c = 0; c < columns - 1; c++) {
        if (known[r * columns + c]) values[r * side + c] = Math.max(at(c, r), at(c + 1, r), at(c, r + 1), at(c + 1, r + 1));
      }
    }
    const levels = [{ data: values, width: side, height: side }];
    while (side > 1) {
      side /= 2;
      const next = new Float32Array(side * side);
      for (let r = 0; r < side; r++) {
        for (let c = 0; c < side; c++) {
          const k = 4 * r * side + 2 * c;
          next[r * side + c] = Math.max(values[k], values[k + 1], values[k + 2 * side], values[k + 2 * side + 1]);
        }
      }
      values = next;
      levels.push({ data: values, width: side, height: side });
    }
    return levels;
  }

  // Finer heights, where the page has them.
  let tiles = null;

  function heightAt(east, north) {
    const x = Math.min(Math.max((east - west_m) / step_m, 0), columns - 1.001);
    const y = Math.min(Math.max((north - south_m) / step_m, 0), rows - 1.001);
    const fine = tiles?.heightAt(x, y);
    if (fine != null) return fine;
    const [c, r] = [Math.floor(x), Math.floor(y)];
    const [fx, fy] = [x - c, y - r];
    return (at(c, r) * (1 - fx) + at(c + 1, r) * fx) * (1 - fy) + (at(c, r + 1) * (1 - fx) + at(c + 1, r + 1) * fx) * fy;
  }

  const inside = (east, north) => {
    const c = Math.round((east - west_m) / step_m);
    const r = Math.round((north - south_m) / step_m);
    return c >= 0 && r >= 0 && c < columns && r < rows && known[r * columns + c] > 0;
  };

  function slopeAt(east, north) {
    const s = step_m;
    return [
      (heightAt(east + s, north) - heightAt(east - s, north)) / (2 * s),
      (heightAt(east, north + s) - heightAt(east, north - s)) / (2 * s),
    ];
  }

  /** Elevation [deg] of the ground's horizon from a point, towards an azimuth. */
  function horizonDeg(east, north, azimuthDeg) {
    const [de, dn] = [Math.sin(azimuthDeg * RAD), Math.cos(azimuthDeg * RAD)];
    const start = heightAt(east, north) + 0.02 * step_m;
    let tangent = -0.2;
    let t = 0.25 * step_m;
    const most = Math.hypot(columns, rows) * step_m;
    while (t < most) {
      const [e, n] = [east + de * t, north + dn * t];
      if (!inside(e, n)) break;
      tangent = Math.max(tangent, (heightAt(e, n) - start) / t);
      // No nearer look than a third of a cell, and no finer than some hundredths of a degree far away.
      t += Math.max(0.3 * step_m, 0.0015 * t);
      if ((high - start) / t < tangent) break;
    }
    return Math.atan(tangent) / RAD;
  }

  /** The first point of the ground along a ray, or null. */
  function hit(origin, d) {
    const reach = Math.hypot(columns, rows) * step_m * 1.5;
    let t = d[2] < 0 ? Math.max((high + 1 - origin[2]) / d[2], 0) : 0;
    let previous = t;
    while (t < reach) {
      const p = [0, 1, 2].map((k) => origin[k] + t * d[k]);
      if (d[2] > 0 && p[2] > high) return null;
      if (inside(p[0], p[1]) && p[2] <= heightAt(p[0], p[1])) {
        let [a, b] = [previous, t];
        for (let k = 0; k < 20; k++) {
          const m = 0.5 * (a + b);
          const q = [0, 1, 2].map((j) => origin[j] + m * d[j]);
          if (q[2] <= heightAt(q[0], q[1])) b = m;
          else a = m;
        }
        return [0, 1, 2].map((k) => origin[k] + b * d[k]);
      }
      previous = t;
      t += Math.max(0.4 * step_m, 0.0005 * t);
    }
    return null;
  }

  return { up, known, rows, columns, low, high, step: step_m, west: west_m, south: south_m, slopes, pyramid, heightAt, slopeAt, inside, horizonDeg, hit, setTiles: (made) => (tiles = made), tiles: () => tiles };
}

/** One chunk of CELLS x CELLS cells with skirts; instances move and scale it. */
export function chunkGeometry() {
  const side = CELLS + 1;
  const positions = [];
  for (let y = 0; y < side; y++) for (let x = 0; x < side; x++) positions.push(x, y, 0);
  const index = [];
  for (let y = 0; y < CELLS; y++) {
    for (let x = 0; x < CELLS; x++) {
      const k = y * side + x;
      index.push(k, k + 1, k + side + 1, k, k + side + 1, k + side);
    }
  }
  const rim = [];
  for (let x = 0; x < CELLS; x++) rim.push([x, 0]);
  for (let y = 0; y < CELLS; y++) rim.push([CELLS, y]);
  for (let x = CELLS; x > 0; x--) rim.push([x, CELLS]);
  for (let y = CELLS; y > 0; y--) rim.push([0, y]);
  const first = positions.length / 3;
  for (const [x, y] of rim) positions.push(x, y, 1);
  rim.forEach(([x, y], k) => {
    const next = (k + 1) % rim.length;
    const [a, b] = [y * side + x, rim[next][1] * side + rim[next][0]];
    index.push(a, first + k, first + next, a, first + next, b);
  });
  const geometry = new THREE.InstancedBufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
  geometry.setIndex(index);
  return geometry;
}

/** The chunks (column, row, step, slot of a tile or -1) to draw from an eye: finer ones near it. */
export function chooseChunks(terrain, eye, detail, frustum) {
  const chosen = [];
  const tiles = terrain.tiles();
  tiles?.begin();
  const box = new THREE.Box3();
  const sideCells = Math.max(terrain.columns, terrain.rows) - 1;
  let step = 1;
  while (step * CELLS < sideCells) step *= 2;
  const visit = (c, r, s, slot) => {
    if (c >= terrain.columns - 1 || r >= terrain.rows - 1) return;
    const [x0, y0] = [terrain.west + c * terrain.step, terrain.south + r * terrain.step];
    const size = s * CELLS * terrain.step;
    box.min.set(x0, y0, terrain.low - 100);
    box.max.set(x0 + size, y0 + size, terrain.high + 1);
    if (!frustum.intersectsBox(box)) return;
    const distance = box.distanceToPoint(eye);
    if (distance < detail * size) {
      // Below the grid's own step the finer cells are a tile's, once it is loaded.
      const finer = s > 1 ? null : tiles?.find(Math.round(Math.log2(2 / s)), c, r, distance);
      if (s > 1 || finer) {
        const half = (s / 2) * CELLS;
        for (const [dc, dr] of [[0, 0], [half, 0], [0, half], [half, half]]) visit(c + dc, r + dr, s / 2, finer ? finer.slot : -1);
        return;
      }
    }
    chosen.push([c, r, s, slot]);
  };
  visit(0, 0, step, -1);
  tiles?.load();
  return chosen;
}
