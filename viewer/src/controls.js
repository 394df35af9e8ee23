// The camera: orbit about a point of the ground, or walk on it; pointer, touch and keys.
import { RAD, angles, cameraAxes } from "./frames.js";

// Eyes above the ground [m]: the rendered mesh may stand a metre or two above the grid of heights.
const CLEARANCE = 3;

export function makeControls(canvas, frame, terrain, changed) {
  const camera = { latitude: 0, longitude: 0, height: 0, heading: 0, pitch: 0, fov: 50, position: [0, 0, 0] };
  const mode = { walk: false };
  const pointers = new Map();
  let pivot = null;

  function set(values) {
    Object.assign(camera, values);
    camera.position = frame.fromGeodetic(camera.latitude, camera.longitude, camera.height);
    changed();
  }

  /** Take a position and a viewing direction of the frame. */
  function place(position, towards) {
    const floor = terrain.inside(position[0], position[1]) ? terrain.heightAt(position[0], position[1]) + CLEARANCE : -Infinity;
    const p = [position[0], position[1], Math.max(position[2], floor)];
    const [latitude, longitude, height] = frame.toGeodetic(p);
    const { axes } = cameraAxes(frame, latitude, longitude, 0, 0);
    const [heading, pitch] = angles(axes.map((axis) => axis[0] * towards[0] + axis[1] * towards[1] + axis[2] * towards[2]));
    Object.assign(camera, { latitude, longitude, height, heading, pitch: Math.min(Math.max(pitch, -89), 89), position: p });
    changed();
  }

  const axes = () => cameraAxes(frame, camera.latitude, camera.longitude, camera.heading, camera.pitch);

  function look(dHeading, dPitch) {
    set({ heading: (camera.heading + dHeading + 360) % 360, pitch: Math.min(Math.max(camera.pitch + dPitch, -89), 89) });
  }

  function move(forward, right, up) {
    const [s, c] = [Math.sin(camera.heading * RAD), Math.cos(camera.heading * RAD)];
    const p = camera.position;
    const next = [p[0] + forward * s + right * c, p[1] + forward * c - right * s, p[2] + up];
    if (mode.walk && terrain.inside(next[0], next[1])) next[2] = terrain.heightAt(next[0], next[1]) + CLEARANCE;
    place(next, axes().forward);
  }

  /** Turn about the pivot. */
  function orbit(dAzimuth, dElevation) {
    if (!pivot) return look(-dAzimuth * 0.3, dElevation * 0.3);
    const off = camera.position.map((value, k) => value - pivot[k]);
    const distance = Math.hypot(...off);
    const [azimuth, elevation] = angles(off);
    const e = Math.min(Math.max(elevation + dElevation, 1), 88) * RAD;
    const a = (azimuth + dAzimuth) * RAD;
    const next = [Math.sin(a) * Math.cos(e), Math.cos(a) * Math.cos(e), Math.sin(e)].map((value, k) => pivot[k] + distance * value);
    // The pivot keeps its place in the picture: the view turns as the position does.
    const turn = (((a / RAD - azimuth + 540) % 360) - 180);
    const rise = e / RAD - elevation;
    const position = [next[0], next[1], next[2]];
    const heading = (camera.heading + turn + 360) % 360;
    const pitch = Math.min(Math.max(camera.pitch - rise, -89), 89);
    const [latitude, longitude, height] = frame.toGeodetic(position);
    const floor = terrain.inside(position[0], position[1]) ? terrain.heightAt(position[0], position[1]) + CLEARANCE : -Infinity;
    if (position[2] < floor) return;
    Object.assign(camera, { latitude, longitude, height, heading, pitch, position });
    changed();
  }

  function zoom(factor) {
    const target = findPivot() ?? camera.position.map((value, k) => value + 1000 * axes().forward[k]);
    const next = camera.position.map((value, k) => target[k] + (value - target[k]) * factor);
    place(next, axes().forward);
  }

  function findPivot() {
    return terrain.hit(camera.position, axes().forward);
  }

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, travelled: 0 });
    pivot = mode.walk ? null : findPivot();
  });
  canvas.addEventListener("pointermove", (event) => {
    const pointer = pointers.get(event.pointerId);
    if (!pointer) return;
    const [dx, dy] = [event.clientX - pointer.x, event.clientY - pointer.y];
    const before = spread();
    [pointer.x, pointer.y] = [event.clientX, event.clientY];
    pointer.travelled += Math.hypot(dx, dy);
    if (pointer.travelled < 3) return;
    const perPixel = camera.fov / canvas.clientWidth;
    if (pointers.size >= 2) {
      const after = spread();
      if (before > 0 && after > 0) zoom(before / after);
    } else if (mode.walk) look(-dx * perPixel, dy * perPixel);
    else if (event.buttons & 2 || event.shiftKey) pan(dx, dy, perPixel);
    else orbit(dx * 0.25, dy * 0.25);
  });
  const spread = () => {
    const list = [...pointers.values()];
    return list.length < 2 ? 0 : Math.hypot(list[0].x - list[1].x, list[0].y - list[1].y);
  };
  function pan(dx, dy, perPixel) {
    const distance = pivot ? Math.hypot(...pivot.map((value, k) => value - camera.position[k])) : 1000;
    move(dy * perPixel * RAD * distance, -dx * perPixel * RAD * distance, 0);
  }
  const clicks = [];
  canvas.addEventListener("pointerup", (event) => {
    const pointer = pointers.get(event.pointerId);
    pointers.delete(event.pointerId);
    if (pointer && pointer.travelled < 3) {
      const box = canvas.getBoundingClientRect();
      clicks.forEach((act) => act((2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height));
    }
  });
  canvas.addEventListener("pointercancel", (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const factor = Math.exp(Math.min(Math.max(event.deltaY, -200), 200) * 0.0015);
    if (mode.walk || event.ctrlKey) set({ fov: Math.min(Math.max(camera.fov * factor, 5), 120) });
    else zoom(factor);
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = mode.walk ? 15 : Math.max(0.02 * Math.abs(camera.height - terrain.low), 20);
    const turn = event.shiftKey ? 10 : 3;
    const actions = {
      ArrowLeft: () => look(-turn, 0), ArrowRight: () => look(turn, 0), ArrowUp: () => look(0, turn), ArrowDown: () => look(0, -turn),
      w: () => move(step, 0, 0), s: () => move(-step, 0, 0), a: () => move(0, -step, 0), d: () => move(0, step, 0),
      e: () => move(0, 0, step), q: () => move(0, 0, -step), "+": () => zoom(0.85), "-": () => zoom(1.15),
    };
    const act = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
  });

  return { camera, mode, set, axes, move, look, onClick: (act) => clicks.push(act), drop: () => move(0, 0, 0) };
}
