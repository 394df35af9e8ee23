// Finer heights near the eye: tiles that are loaded when cells of the grid would look larger than asked for.
import * as THREE from "three";

const SLOTS = 48;
const AT_ONCE = 4;

/** `read(name)` gives a tile's file; `changed()` is called when one has arrived. */
export function makeTiles(terrain, about, read, changed) {
  const { cells, list } = about;
  const side = cells + 3;
  const known = new Map(list.map(([level, column, row, low, scale]) => [`${level}-${column}-${row}`, { level, column, row, low, scale, slot: -1, used: 0, state: "away" }]));
  const deepest = Math.max(...list.map(([level]) => level));
  const slots = new Array(SLOTS).fill(null);
  const heights = layered(new Float32Array(side * side * SLOTS), THREE.RedFormat, THREE.FloatType, THREE.NearestFilter);
  const slopes = layered(new Uint16Array(side * side * SLOTS * 2), THREE.RGFormat, THREE.HalfFloatType, THREE.LinearFilter);
  // Of each slot: column and row of the tile's corner in nodes of the grid, and nodes of the tile for one of the grid.
  const places = Array.from({ length: SLOTS }, () => new THREE.Vector3());
  let [frame, loading] = [0, 0];
  let full = false; // All slots are drawn: nothing more is loaded until the eye moves.
  let wanted = [];

  function layered(data, format, type, filter) {
    const made = new THREE.DataArrayTexture(data, side, side, SLOTS);
    [made.format, made.type, made.minFilter, made.magFilter] = [format, type, filter, filter];
    [made.unpackAlignment, made.needsUpdate] = [1, true];
    return made;
  }

  /** The tile of a level over a node of the grid, where it is loaded; else it is asked for, and null. */
  function find(level, c, r, distance) {
    const span = cells / 2 ** level;
    const tile = known.get(`${level}-${Math.floor(c / span)}-${Math.floor(r / span)}`);
    if (!tile) return null;
    if (tile.state === "here") {
      tile.used = frame;
      return tile;
    }
    if (tile.state === "away" && !full) wanted.push([distance, tile]);
    return null;
  }

  const begin = () => {
    frame += 1;
    wanted = [];
  };

  /** Load the nearest of the tiles that were asked for since `begin`. */
  function load() {
    wanted.sort((a, b) => a[0] - b[0]);
    for (const [, tile] of wanted) {
      if (loading >= AT_ONCE) return;
      if (tile.state === "away") fetchTile(tile);
    }
  }

  async function fetchTile(tile) {
    tile.state = "coming";
    loading += 1;
    try {
      keep(tile, new Uint16Array(await read(`tile-${tile.level}-${tile.column}-${tile.row}.bin`)));
    } catch (error) {
      // The grid's own heights are shown instead; a tile that is missing is not asked for again.
      tile.state = "missing";
      console.error(error);
    } finally {
      loading -= 1;
    }
    changed();
  }

  function keep(tile, stored) {
    if (stored.length !== side * side) throw new Error(`tile ${tile.level}-${tile.column}-${tile.row}: ${stored.length} heights, expected ${side * side}`);
    let slot = slots.indexOf(null);
    if (slot < 0) {
      // The one that was not drawn for longest; where all are drawn now, this one is dropped.
      const oldest = slots.reduce((best, each) => (each.used < best.used ? each : best));
      if (oldest.used >= frame - 1) {
        tile.state = "away";
        full = true;
        return;
      }
      slot = oldest.slot;
      [oldest.state, oldest.slot, oldest.up] = ["away", -1, null];
    }
    slots[slot] = tile;
    const up = Float32Array.from(stored, (value) => tile.low + value * tile.scale);
    const step = terrain.step / 2 ** tile.level;
    const slope = slopes.image.data;
    for (let r = 0; r < side; r++) {
      for (let c = 0; c < side; c++) {
        const [c0, c1, r0, r1] = [Math.max(c - 1, 0), Math.min(c + 1, side - 1), Math.max(r - 1, 0), Math.min(r + 1, side - 1)];
        const k = 2 * ((slot * side + r) * side + c);
        slope[k] = THREE.DataUtils.toHalfFloat((up[r * side + c1] - up[r * side + c0]) / ((c1 - c0) * step));
        slope[k + 1] = THREE.DataUtils.toHalfFloat((up[r1 * side + c] - up[r0 * side + c]) / ((r1 - r0) * step));
      }
    }
    heights.image.data.set(up, slot * side * side);
    for (const made of [heights, slopes]) {
      made.addLayerUpdate(slot);
      made.needsUpdate = true;
    }
    const scale = 2 ** tile.level;
    places[slot].set((tile.column * cells) / scale, (tile.row * cells) / scale, scale);
    Object.assign(tile, { state: "here", slot, up, used: frame });
  }

  /** Height [m] at a node of the grid, of the finest tile that is loaded there; null where there is none. */
  function heightAt(x, y) {
    for (let level = deepest; level > 0; level--) {
      const span = cells / 2 ** level;
      const tile = known.get(`${level}-${Math.floor(x / span)}-${Math.floor(y / span)}`);
      if (tile?.state !== "here") continue;
      const [u, v] = [(x - tile.column * span) * 2 ** level + 1, (y - tile.row * span) * 2 ** level + 1];
      const [c, r] = [Math.min(Math.floor(u), side - 2), Math.min(Math.floor(v), side - 2)];
      const [fx, fy] = [u - c, v - r];
      const at = (i, j) => tile.up[j * side + i];
      return (at(c, r) * (1 - fx) + at(c + 1, r) * fx) * (1 - fy) + (at(c, r + 1) * (1 - fx) + at(c + 1, r + 1) * fx) * fy;
    }
    return null;
  }

  const busy = () => loading > 0 || (!full && wanted.some(([, tile]) => tile.state === "away"));
  const count = () => slots.filter((each) => each).length;
  return { heights, slopes, places, begin, find, load, heightAt, busy, count, moved: () => (full = false) };
}
