// The page: reads the scene, keeps the state of time, camera and exposure, and draws when something changed.
import { makeControls } from "./controls.js";
import { loadScene } from "./data.js";
import { luminance, meteredEv, whiteOf } from "./exposure.js";
import { makeEphemeris } from "./ephemeris.js";
import { RAD, makeFrame } from "./frames.js";
import { makeGaussians } from "./gaussians.js";
import { makeLight } from "./light.js";
import { makeRenderer } from "./renderer.js";
import { makeTerrain } from "./terrain.js";
import { makeTiles } from "./tiles.js";
import { MINUTE, DAY, crossings, dayOfYear, fullMoons, highestMoon, makeClock, moonName, readAddress, seasonOf, sunAt, writeAddress } from "./times.js";

const element = (id) => document.getElementById(id);
const still = new URLSearchParams(location.search).has("still") || document.documentElement.dataset.still === "1";
const reduced = matchMedia("(prefers-reduced-motion: reduce)").matches;

/** Hold a request open, by which the program that serves this page knows that it is shown. */
async function stayOpen() {
  try {
    const reader = (await fetch("open")).body.getReader();
    while (!(await reader.read()).done);
  } catch (error) {
    if (!(error instanceof TypeError)) throw error;
  }
  element("status").textContent = "seasonscapes view has ended: dates that were not shown before cannot be loaded.";
}

start().catch((error) => {
  element("status").textContent = `The place cannot be shown: ${error.message}`;
  document.body.dataset.failed = error.message;
  console.error(error);
});

async function start() {
  const began = performance.now();
  const scene = await loadScene((share) => (element("status").textContent = `Loading ${Math.round(100 * share)} %`));
  const { about, arrays } = scene;
  const frame = makeFrame(about.frame);
  const clock = makeClock(about.time_zone);
  const ephemeris = makeEphemeris(about.frame.latitude_deg, about.frame.longitude_deg, about.surface_m);
  const terrain = makeTerrain(arrays, about);
  const tiles = about.tiles ? makeTiles(terrain, about.tiles, scene.file, () => tileArrived()) : null;
  if (tiles) terrain.setTiles(tiles);
  const light = makeLight(arrays, about);
  const canvas = element("picture");
  const renderer = makeRenderer(canvas, scene, terrain, light);
  const fine = Math.min(1024, 2 * Math.max(terrain.columns, terrain.rows));
  const coarse = renderer.software ? 384 : fine;
  const sharp = Math.min(2048, 2 * Math.max(terrain.columns, terrain.rows)); // At rest.
  const enough = still ? 16 : renderer.software ? 6 : 12;

  const state = { time: Date.now(), ev: "auto", haze: 1, shownEv: 15, dirty: true, quality: 0, metered: false, point: null, playing: null, divider: 1, learned: false };
  const controls = makeControls(canvas, frame, terrain, () => cameraChanged());
  if (still) {
    document.body.classList.add("still");
    renderer.state.cellPixels = 1;
  }

  // ---- light -------------------------------------------------------------------------------------------------------
  let now = null;
  const albedos = new Map();

  function lightOf(time) {
    const sun = ephemeris.sun(time);
    const moon = ephemeris.moon(time);
    const near = 1 / (sun.distance * sun.distance);
    const sunColour = [near, near, near];
    const moonCounts = sun.elevation <= 0 && moon.elevation >= -9;
    const bodies = [
      { ...sun, colour: sunColour, normal: light.direct(sun.elevation).map((v) => v * near), counts: true, trueDirection: sun.direction },
      { ...moon, colour: moon.ratio, normal: moonCounts ? light.direct(moon.elevation).map((v, k) => v * moon.ratio[k]) : [0, 0, 0], counts: moonCounts },
    ];
    const sky = light.skyCoefficients(bodies.filter((body) => body.counts));
    const threshold = 1e-4 * luminance(sky.level);
    for (const body of bodies) body.lights = luminance(body.normal) > threshold;
    const level = sky.level.map((v, k) => v + bodies.reduce((sum, body) => sum + body.normal[k] * Math.max(body.direction[2], 0), 0));
    return { sun, moon, bodies, sky, level };
  }

  function lightChanged(quality) {
    now = lightOf(state.time);
    // The frame holds radiance over what a grey card would send, so that half precision suffices day and night.
    const scale = 1 / Math.max((0.2 * luminance(now.level)) / Math.PI, 1e-7);
    renderer.setLight(now.bodies, now.sky, scale, quality);
    lightGaussians(!state.playing && quality > coarse);
    state.quality = quality;
    state.metered = false;
    state.dirty = true;
    tell();
  }

  /** The Gaussians' colours; with `withNetwork` what they have learned beyond the physics, which takes a while. */
  function lightGaussians(withNetwork) {
    if (!gaussians || state.divider === 1) return;
    const sky = light.project(gaussians.fromSky, gaussians.rank, now.sky.means);
    const day = dayOfYear(clock.civil(state.time)) + clock.civil(state.time).minutes / 1440;
    const told = { bodies: now.bodies.filter(({ lights }) => lights), sky, skyLx: now.sky.level, globalLx: luminance(now.level), day };
    renderer.state.splats.light(gaussians.radiance(told, { withNetwork }));
    state.learned = withNetwork;
    state.dirty = true;
  }

  async function setDivider(value) {
    state.divider = Math.min(Math.max(value, 0), 1);
    element("divider").value = Math.round(100 * state.divider);
    const said = state.divider === 1 ? "the mesh alone" : state.divider === 0 ? "the Gaussians alone" : `mesh left of ${Math.round(100 * state.divider)} %, Gaussians right of it`;
    element("divider-value").value = said;
    element("divider").setAttribute("aria-valuetext", said);
    remember();
    if (state.divider < 1 && !gaussians) {
      loadingGaussians ??= scene.layer((share) => (element("status").textContent = `Loading the Gaussians ${Math.round(100 * share)} %`));
      const layer = await loadingGaussians;
      if (!gaussians) {
        gaussians = makeGaussians(layer, orderAt);
        renderer.setGaussians(gaussians);
        element("status").textContent = "";
      }
    }
    renderer.state.divider = state.divider;
    if (now) lightGaussians(true);
    state.metered = false;
    state.dirty = true;
  }
  let gaussians = null;
  let loadingGaussians = null;

  /** When a place loses its snow among its neighbours, 0 to 1; null where the page knows one date alone. */
  function orderAt(east, north) {
    if (!arrays.snow_order) return null;
    const [rows, columns] = arrays.snow_order.shape;
    const c = Math.min(Math.max(Math.floor(((east - terrain.west) / ((terrain.columns - 1) * terrain.step)) * columns), 0), columns - 1);
    const r = Math.min(Math.max(Math.floor(((north - terrain.south) / ((terrain.rows - 1) * terrain.step)) * rows), 0), rows - 1);
    return arrays.snow_order.data[r * columns + c] / 255;
  }

  async function albedoChanged() {
    const { before, after, share } = seasonOf(about.albedo, dayOfYear(clock.civil(state.time)));
    const key = `${before}:${after}:${share.toFixed(3)}`;
    if (key === state.albedoKey) return;
    state.albedoKey = key;
    const wanted = share > 0 ? [before, after] : [before];
    const textures = await Promise.all(wanted.map(albedoTexture));
    if (state.albedoKey !== key) return;
    renderer.setAlbedo(textures[0], textures[1] ?? null, share);
    for (const [index, promise] of albedos) {
      if (wanted.includes(index) || albedos.size <= 4) continue;
      albedos.delete(index);
      promise.then((texture) => { texture.image.close?.(); texture.dispose(); });
    }
    state.metered = false;
    state.dirty = true;
  }

  function albedoTexture(index) {
    if (!albedos.has(index)) {
      const options = { imageOrientation: "flipY", premultiplyAlpha: "none", colorSpaceConversion: "none" };
      const { file, gain_rgb } = about.albedo[index];
      albedos.set(index, scene.picture(file).then((blob) => createImageBitmap(blob, options)).then((bitmap) => renderer.albedoTexture(bitmap, gain_rgb)));
    }
    return albedos.get(index);
  }

  // ---- camera and exposure -----------------------------------------------------------------------------------------
  function cameraChanged() {
    const { forward, up } = controls.axes();
    tiles?.moved();
    renderer.setCamera(controls.camera.position, forward, up, controls.camera.fov);
    state.metered = false;
    state.dirty = true;
    remember();
  }

  function expose() {
    if (state.ev === "auto") {
      if (!state.metered) {
        const wanted = meteredEv(renderer.luminances());
        const jump = reduced || still || !state.playing || Math.abs(wanted - state.shownEv) > 4;
        state.shownEv = jump ? wanted : state.shownEv + 0.3 * (wanted - state.shownEv);
        state.metered = true;
      }
    } else state.shownEv = state.ev;
    renderer.setExposure(state.shownEv, whiteOf(now.bodies[0].normal));
    element("ev-value").value = state.shownEv.toFixed(1);
    if (state.ev === "auto") element("ev").value = state.shownEv.toFixed(1);
    element("ev").setAttribute("aria-valuetext", `EV ${state.shownEv.toFixed(1)}${state.ev === "auto" ? ", automatic" : ""}`);
  }

  /** A finer piece of ground is there: draw again, with the same light. */
  function tileArrived() {
    state.dirty = true;
  }

  // ---- drawing -----------------------------------------------------------------------------------------------------
  let settle = 0;
  function loop() {
    requestAnimationFrame(loop);
    if (!state.paused) step();
  }
  function step() {
    if (state.playing) play();
    if (state.dirty) {
      state.dirty = false;
      settle = 0;
      renderer.reset();
    }
    if (!renderer.shared.uAlbedoA.value) return;
    if (state.quality < sharp && settle === 1 && !state.playing) {
      state.quality = state.quality < fine ? fine : sharp;
      renderer.see(state.quality);
      renderer.relight();
      if (!state.learned) lightGaussians(true);
      state.dirty = false;
      settle = 0;
    }
    if (settle < enough) {
      settle += 1;
      renderer.draw(controls.camera.height);
      if (!document.body.dataset.first) {
        renderer.finish();
        document.body.dataset.first = performance.now().toFixed(0);
      }
      if (settle === 1 || settle === enough) {
        if (settle > 1) state.metered = false;
        expose();
      }
      renderer.show();
      if (settle === enough && !tiles?.busy()) {
        renderer.finish();
        document.body.dataset.ready = String(Number(document.body.dataset.ready ?? 0) + 1);
      }
    }
  }

  function fit() {
    const box = element("stage").getBoundingClientRect();
    const ratio = still || renderer.software ? 1 : Math.min(devicePixelRatio, 2);
    const size = still ? stillSize() : [Math.max(box.width, 16) * ratio, Math.max(box.height, 16) * ratio];
    let [width, height] = size.map(Math.round);
    if (renderer.software && !still) {
      const share = Math.min(1, Math.sqrt(400000 / (width * height)));
      [width, height] = [Math.round(width * share), Math.round(height * share)];
    }
    if (canvas.width !== width || canvas.height !== height || !state.fitted) {
      state.fitted = true;
      renderer.resize(width, height);
      state.dirty = true;
    }
  }
  const stillSize = () => (new URLSearchParams(location.search).get("size") ?? "512x512").split("x").map(Number);

  // ---- what the page tells -----------------------------------------------------------------------------------------
  const compass = (azimuth) => ["N", "NNE", "NE", "ENE", "E", "ESE", "SE", "SSE", "S", "SSW", "SW", "WSW", "W", "WNW", "NW", "NNW"][Math.round(azimuth / 22.5) % 16];
  const lux = (value) => (value >= 100 ? Math.round(value).toLocaleString("en-GB") : value >= 1 ? value.toFixed(1) : value.toPrecision(2));
  const above = (degrees) => `${Math.abs(degrees).toFixed(1)}° ${degrees >= 0 ? "above" : "below"} the horizon`;

  function tell() {
    const { sun, moon, bodies, sky, level } = now;
    const said = `${clock.date(state.time)}, ${clock.text(state.time)}, sun ${above(sun.elevation)}, ${compass(sun.azimuth)}`;
    element("when").value = `${clock.date(state.time)}, ${clock.text(state.time)}`;
    const civil = clock.civil(state.time);
    element("hour").value = civil.minutes;
    element("hour").setAttribute("aria-valuetext", said);
    element("day").value = dayOfYear(civil);
    element("day").setAttribute("aria-valuetext", said);
    element("exact").value = `${String(civil.year).padStart(4, "0")}-${two(civil.month)}-${two(civil.day)}T${two(civil.hour)}:${two(civil.minute)}`;
    const sunLevel = luminance(bodies[0].normal) * Math.max(sun.direction[2], 0);
    const rows = [
      ["Sun", `${above(sun.elevation)}, ${compass(sun.azimuth)} (${sun.azimuth.toFixed(1)}°)`],
      ["Moon", `${above(moon.elevation)}, ${compass(moon.azimuth)}, ${moonName(state.time)}, ${Math.round(100 * moon.fraction)} % lit`],
      ["Sunlight on level ground", `${lux(sunLevel)} lx`],
      ["Skylight on level ground", `${lux(luminance(sky.level))} lx`],
      ["Together, with the moon", `${lux(luminance(level))} lx`],
      ["Time zone", clock.zone],
    ];
    const body = document.createElement("tbody");
    for (const [name, value] of rows) {
      const row = body.insertRow();
      const head = document.createElement("th");
      head.scope = "row";
      head.textContent = name;
      row.append(head);
      row.insertCell().textContent = value;
    }
    element("light").tBodies[0].replaceWith(body);
    marks();
    remember();
  }
  const two = (value) => String(value).padStart(2, "0");

  let marked = "";
  function marks() {
    const civil = clock.civil(state.time);
    const key = `${civil.year}-${civil.month}-${civil.day}`;
    if (marked === key) return;
    marked = key;
    const from = clock.instant(civil.year, civil.month, civil.day);
    const to = from + DAY;
    const elevation = (time) => ephemeris.sun(time).trueElevation;
    const events = crossings((time) => elevation(time) + 50 / 60, from, to, 20 * MINUTE);
    const golden = crossings((time) => elevation(time) - 6, from, to, 20 * MINUTE);
    const low = crossings((time) => elevation(time) + 4, from, to, 20 * MINUTE);
    const list = [
      ...events.map(({ time, rising }) => [rising ? "Sunrise" : "Sunset", time]),
      ...low.filter((each) => each.rising).map(({ time }) => ["Golden hour, morning", time]),
      ...golden.filter((each) => !each.rising).map(({ time }) => ["Golden hour, evening", time]),
    ];
    const strip = element("hour-marks");
    strip.replaceChildren();
    const percent = (time) => (100 * (time - from)) / DAY;
    const bar = (className, left, width) => {
      const mark = document.createElement("i");
      if (className) mark.className = className;
      mark.style.left = `${left}%`;
      if (width) mark.style.width = `${width}%`;
      strip.append(mark);
    };
    events.forEach(({ time }) => bar("", percent(time)));
    for (const rising of [true, false]) {
      const [a, b] = [low, golden].map((each) => each.find((one) => one.rising === rising)?.time);
      if (a && b) bar("band", percent(Math.min(a, b)), Math.abs(percent(b) - percent(a)));
    }
    const buttons = element("events");
    buttons.replaceChildren();
    for (const [name, time] of list.sort((a, b) => a[1] - b[1])) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = `${name} ${clock.text(time)}`;
      button.addEventListener("click", () => setTime(time));
      buttons.append(button);
    }
    const days = element("day-marks");
    const yearStart = clock.instant(civil.year, 1, 1);
    if (days.dataset.year !== String(civil.year)) {
      days.dataset.year = String(civil.year);
      days.replaceChildren();
      const length = (clock.instant(civil.year + 1, 1, 1) - yearStart) / DAY;
      element("day").max = Math.round(length);
      for (const time of fullMoons(yearStart, yearStart + length * DAY)) {
        const mark = document.createElement("i");
        mark.className = "moon";
        mark.style.left = `${(100 * (time - yearStart)) / DAY / length}%`;
        days.append(mark);
      }
    }
    if (state.point) tellPoint();
  }

  /** The same within the civil day of an instant. */
  function sunTimes(point, time) {
    const civil = clock.civil(time);
    const from = clock.instant(civil.year, civil.month, civil.day);
    return sunTimesBetween(point, from, from + DAY);
  }
  const sunTimesBetween = (point, from, to) => sunAt(terrain, ephemeris, point, from, to);

  function tellPoint() {
    const [latitude, longitude, height] = frame.toGeodetic(state.point);
    const [se, sn] = terrain.slopeAt(state.point[0], state.point[1]);
    const steep = Math.atan(Math.hypot(se, sn)) / RAD;
    const aspect = (Math.atan2(-se, -sn) / RAD + 360) % 360;
    const times = sunTimes(state.point, state.time);
    let hours = 0;
    let since = null;
    const civil = clock.civil(state.time);
    const midnight = clock.instant(civil.year, civil.month, civil.day);
    if (times.length && !times[0].rising) since = midnight;
    for (const { time, rising } of times) {
      if (rising) since = time;
      else if (since !== null) {
        hours += (time - since) / 3600000;
        since = null;
      }
    }
    if (since !== null) hours += (midnight + DAY - since) / 3600000;
    const spoken = times.map(({ time, rising }) => `${rising ? "comes" : "goes"} ${clock.text(time)}`).join(", ");
    element("place").textContent =
      `${latitude.toFixed(5)}°, ${longitude.toFixed(5)}°, ${height.toFixed(0)} m (${about.datum}). Slope ${steep.toFixed(0)}°` +
      (steep > 1 ? ` towards ${compass(aspect)}` : "") +
      `. Sun on ${clock.date(state.time)}: ${hours.toFixed(1)} h` + (times.length ? `; ${spoken}.` : ".");
  }

  const address = () => writeAddress({ time: state.time, camera: controls.camera, ev: state.ev, haze: state.haze, divider: state.divider });
  function command() {
    const sky = about.sky.name === "clear" ? "" : ` --sky ${about.sky.name}`;
    return `seasonscapes render ${about.view.scene ?? about.name} --at-url "${address()}" --size ${canvas.width}x${canvas.height} --engine path${sky}`;
  }
  /** Meteorological range with the slider's haze [km]. */
  const visibility = () => about.sky.visibility_km / (1 + (state.haze - 1) * light.hazeShare(about.sky.ground_m)[1]);

  let pending = 0;
  function remember() {
    clearTimeout(pending);
    pending = setTimeout(() => {
      const hash = address();
      element("command").textContent = command();
      if (location.hash === hash) return;
      try {
        history.replaceState(null, "", hash);
      } catch {
        // A page inside another document (srcdoc) has no address of its own.
        document.body.dataset.address = hash;
      }
    }, 250);
  }

  // ---- controls ----------------------------------------------------------------------------------------------------
  function setTime(time, quality = fine) {
    state.time = Math.min(Math.max(time, Date.UTC(1900, 0, 2)), Date.UTC(2053, 9, 1));
    lightChanged(quality);
    state.arriving = albedoChanged();
  }
  function stop() {
    state.playing = null;
    element("play-day").setAttribute("aria-pressed", "false");
    element("play-year").setAttribute("aria-pressed", "false");
    if (now) setTime(state.time);
  }
  let last = 0;
  function play() {
    const tick = performance.now();
    if (tick - last < 60) return;
    const seconds = Math.min((tick - last) / 1000, 0.5);
    last = tick;
    if (state.playing === "day") setTime(state.time + seconds * 40 * MINUTE, coarse);
    else setTime(state.time + Math.max(1, Math.round(seconds * 12)) * DAY, coarse);
  }

  element("hour").addEventListener("input", (event) => {
    const civil = clock.civil(state.time);
    setTime(clock.instant(civil.year, civil.month, civil.day, Number(event.target.value)), coarse);
  });
  element("hour").addEventListener("keydown", (event) => {
    const steps = { ArrowLeft: -5, ArrowDown: -5, ArrowRight: 5, ArrowUp: 5, PageUp: 1440, PageDown: -1440 };
    if (!(event.key in steps)) return;
    event.preventDefault();
    setTime(state.time + steps[event.key] * MINUTE, coarse);
  });
  element("day").addEventListener("input", (event) => {
    const civil = clock.civil(state.time);
    setTime(clock.instant(civil.year, 1, Number(event.target.value), civil.minutes), coarse);
  });
  element("exact").addEventListener("change", (event) => {
    const found = /^(\d{4})-(\d\d)-(\d\d)T(\d\d):(\d\d)/.exec(event.target.value);
    if (!found) return;
    const [year, month, day, hour, minute] = found.slice(1).map(Number);
    setTime(clock.instant(year, month, day, 60 * hour + minute));
  });
  element("full-moon").addEventListener("click", () => {
    const next = fullMoons(state.time + DAY, state.time + 40 * DAY)[0];
    if (next) setTime(highestMoon(ephemeris, next));
  });
  for (const kind of ["day", "year"]) {
    element(`play-${kind}`).addEventListener("click", () => {
      const on = state.playing === kind;
      stop();
      if (on) return;
      state.playing = kind;
      last = performance.now();
      element(`play-${kind}`).setAttribute("aria-pressed", "true");
    });
  }
  about.cameras.forEach(({ name }, k) => element("camera").append(new Option(name, String(k))));
  const useCamera = (k) => {
    const c = about.cameras[k];
    controls.set({ latitude: c.latitude_deg, longitude: c.longitude_deg, height: c.height_m, heading: c.heading_deg, pitch: c.pitch_deg, fov: c.fov_deg });
  };
  element("camera").addEventListener("change", (event) => {
    element("walk").checked = controls.mode.walk = false;
    useCamera(Number(event.target.value));
  });
  element("walk").addEventListener("change", (event) => {
    controls.mode.walk = event.target.checked;
    if (event.target.checked) controls.drop();
  });
  element("haze").addEventListener("input", (event) => setHaze(Number(event.target.value)));
  function setHaze(value) {
    state.haze = value;
    renderer.ground.uniforms.uHaze.value = value;
    element("haze").value = value;
    const said = about.sky.visibility_km ? `× ${value.toFixed(2)}, sight ${visibility().toFixed(0)} km` : `× ${value.toFixed(2)}`;
    element("haze-value").value = said;
    element("haze").setAttribute("aria-valuetext", said);
    state.dirty = true;
    remember();
  }
  element("gaussians").hidden = !about.gaussians;
  element("divider").addEventListener("input", (event) => (state.arriving = setDivider(Number(event.target.value) / 100).catch(failed)));
  const failed = (error) => (element("status").textContent = `The Gaussians cannot be shown: ${error.message}`);
  function setEv(ev) {
    state.ev = ev;
    element("auto").checked = ev === "auto";
    if (ev !== "auto") element("ev").value = ev;
    state.metered = false;
    state.dirty = true;
    remember();
  }
  element("auto").addEventListener("change", (event) => setEv(event.target.checked ? "auto" : state.shownEv));
  element("ev").addEventListener("input", (event) => setEv(Number(event.target.value)));
  const choose = (x, y) => {
    const point = terrain.hit(controls.camera.position, renderer.ray(x, y));
    state.point = point;
    renderer.mark(point, 7);
    state.dirty = true;
    if (point) tellPoint();
    else element("place").textContent = "There is no ground there.";
  };
  controls.onClick(choose);
  canvas.addEventListener("keydown", (event) => {
    if (event.key === "Enter") choose(0, 0);
  });
  const copy = (id, content) =>
    element(id).addEventListener("click", async () => {
      const text = content();
      try {
        await navigator.clipboard.writeText(text);
        element("status").textContent = "Copied";
      } catch {
        element("command").textContent = text;
        getSelection().selectAllChildren(element("command"));
        element("status").textContent = "Selected below: copy it with the keyboard";
      }
      setTimeout(() => (element("status").textContent = ""), 2500);
    });
  copy("copy-command", command);
  copy("copy-address", () => location.href);
  element("panel").addEventListener("submit", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextlost", () => (element("status").textContent = "The graphics device was lost; load the page again."));

  function restore(given) {
    if (given?.camera) controls.set(given.camera);
    else if (!controls.camera.height) {
      const named = about.cameras.findIndex(({ name }) => name === about.view.camera);
      element("camera").value = String(Math.max(named, 0));
      useCamera(Math.max(named, 0));
    }
    setHaze(given?.haze ?? 1);
    setEv(given?.ev ?? "auto");
    if (about.gaussians) state.layered = setDivider(given?.divider ?? about.view.divider ?? 1).catch(failed);
    const first = about.view.time ? Date.parse(about.view.time) : noon();
    setTime(given?.time ?? first, coarse);
  }
  function noon() {
    const civil = clock.civil(Date.now());
    return clock.instant(civil.year, civil.month, civil.day, 15 * 60);
  }
  addEventListener("hashchange", () => restore(readAddress(location.hash)));
  addEventListener("resize", fit);
  if (!still && typeof ResizeObserver === "function") new ResizeObserver(fit).observe(element("stage"));

  fit();
  restore(readAddress(location.hash) ?? readAddress(about.view.hash ?? ""));
  await state.arriving;
  await state.layered;
  element("status").textContent = "";
  // What measurements use; the page itself does not.
  window.seasonscapes = { about, arrays, state, renderer, controls, ephemeris, terrain, tiles, light, frame, clock, setTime, setEv, setHaze, setDivider, sunTimes, sunTimesBetween, step, expose, command, lightOf, now: () => now, fine, sharp, useCamera };
  loop();
  step();
  if (about.view.watched) stayOpen();
  document.body.dataset.started = (performance.now() - began).toFixed(0);
}
