// Civil time of the place, events of a day, and the state that the address holds.
import { MoonPhase, SearchMoonPhase } from "astronomy-engine";

export const MINUTE = 60000;
export const DAY = 86400000;

export function makeClock(zone) {
  const parts = new Intl.DateTimeFormat("en-CA", {
    timeZone: zone, hourCycle: "h23", year: "numeric", month: "2-digit", day: "2-digit", hour: "2-digit", minute: "2-digit", second: "2-digit",
  });
  const split = (time) => Object.fromEntries(parts.formatToParts(new Date(time)).map(({ type, value }) => [type, Number(value)]));
  const asUtc = (p) => Date.UTC(p.year, p.month - 1, p.day, p.hour, p.minute, p.second);
  const offset = (time) => asUtc(split(time)) - Math.floor(time / 1000) * 1000;

  /** The instant of a civil date and minutes after its midnight. */
  function instant(year, month, day, minutes = 0) {
    const wall = Date.UTC(year, month - 1, day) + minutes * MINUTE;
    let guess = wall - offset(wall);
    guess = wall - offset(guess);
    return guess;
  }
  const civil = (time) => {
    const p = split(time);
    return { ...p, minutes: p.hour * 60 + p.minute };
  };
  const text = (time) => `${pad(civil(time).hour)}:${pad(civil(time).minute)}`;
  const date = (time) => new Intl.DateTimeFormat("en-GB", { timeZone: zone, day: "numeric", month: "long", year: "numeric" }).format(new Date(time));
  return { instant, civil, text, date, zone };
}

const pad = (value) => String(value).padStart(2, "0");

export function dayOfYear({ year, month, day }) {
  return Math.round((Date.UTC(year, month - 1, day) - Date.UTC(year, 0, 1)) / DAY) + 1;
}

/** Between which of dated pictures, in the order of the year, a day of the year lies, and how far. */
export function seasonOf(dated, at) {
  const days = dated.map(({ date }) => dayOfYear({ year: 2024, month: Number(date.slice(5, 7)), day: Number(date.slice(8)) }));
  if (days.length < 2) return { before: 0, after: 0, share: 0 };
  const last = days.reduce((found, day, k) => (day <= at ? k : found), -1);
  const before = last < 0 ? days.length - 1 : last;
  const after = (before + 1) % days.length;
  const gap = (days[after] - days[before] + 366) % 366 || 366;
  return { before, after, share: ((at - days[before] + 366) % 366) / gap };
}

/** Instants at which a function of time crosses a level, by halving. */
export function crossings(value, from, to, step) {
  const found = [];
  let [before, last] = [from, value(from)];
  for (let time = from + step; time <= to; time += step) {
    const now = value(time);
    if (last < 0 !== now < 0) {
      let [a, b] = [before, time];
      for (let k = 0; k < 12; k++) {
        const middle = 0.5 * (a + b);
        if (value(middle) < 0 === last < 0) a = middle;
        else b = middle;
      }
      found.push({ time: b, rising: now >= 0 });
    }
    [before, last] = [time, now];
  }
  return found;
}

/** Times at which more than half of the sun's disc comes above the ground's horizon at a point, or goes below it. */
export function sunAt(terrain, ephemeris, point, from, to) {
  const [se, sn] = terrain.slopeAt(point[0], point[1]);
  const value = (instant) => {
    const sun = ephemeris.sun(instant);
    if (sun.elevation < -1) return -1;
    const margin = sun.elevation - terrain.horizonDeg(point[0], point[1], sun.azimuth);
    // The ground must face the sun, too.
    const d = sun.direction;
    return Math.min(margin, 100 * (d[2] - se * d[0] - sn * d[1]));
  };
  return crossings(value, from, to, 2 * MINUTE);
}

export function fullMoons(from, to) {
  const list = [];
  let time = SearchMoonPhase(180, new Date(from), 40);
  while (time && time.date.getTime() < to) {
    list.push(time.date.getTime());
    time = SearchMoonPhase(180, new Date(time.date.getTime() + 25 * DAY), 40);
  }
  return list;
}

/** The instant within half a day at which the moon stands highest. */
export function highestMoon(ephemeris, time) {
  let best = time;
  for (let t = time - DAY / 2; t < time + DAY / 2; t += 10 * MINUTE) if (ephemeris.moon(t).elevation > ephemeris.moon(best).elevation) best = t;
  return best;
}

export const moonName = (time) => {
  const names = ["new moon", "waxing crescent", "first quarter", "waxing gibbous", "full moon", "waning gibbous", "last quarter", "waning crescent"];
  return names[Math.round(MoonPhase(new Date(time)) / 45) % 8];
};

/** `#v=1&t=…Z&cam=lat,lon,height,heading,pitch,fov&ev=auto&haze=1&mesh=1` as values; null for another format. */
export function readAddress(hash) {
  const given = new URLSearchParams(hash.replace(/^#/, ""));
  if (given.get("v") !== "1") return null;
  const state = {};
  const time = Date.parse(given.get("t") ?? "");
  if (Number.isFinite(time)) state.time = time;
  const numbers = (given.get("cam") ?? "").split(",").map(Number);
  if (numbers.length === 6 && numbers.every(Number.isFinite) && Math.abs(numbers[0]) <= 90 && numbers[5] >= 1 && numbers[5] <= 169) {
    const [latitude, longitude, height, heading, pitch, fov] = numbers;
    state.camera = { latitude, longitude, height, heading, pitch, fov };
  }
  const ev = given.get("ev");
  if (ev !== null) state.ev = ev === "auto" || !Number.isFinite(Number(ev)) ? "auto" : Number(ev);
  const haze = Number(given.get("haze") ?? "1");
  if (haze >= 0 && haze <= 20) state.haze = haze;
  const divider = Number(given.get("mesh") ?? "1");
  if (divider >= 0 && divider <= 1) state.divider = divider;
  return state;
}

export function writeAddress({ time, camera, ev, haze, divider }) {
  const stamp = new Date(time).toISOString().replace(/(:00)?\.000Z$/, "Z");
  const { latitude, longitude, height, heading, pitch, fov } = camera;
  const where = [latitude.toFixed(6), longitude.toFixed(6), height.toFixed(1), heading.toFixed(2), pitch.toFixed(2), fov.toFixed(2)];
  return `#v=1&t=${stamp}&cam=${where.join(",")}&ev=${ev === "auto" ? "auto" : ev.toFixed(2)}` + (haze === 1 ? "" : `&haze=${haze.toFixed(2)}`) + (divider === 1 ? "" : `&mesh=${divider.toFixed(2)}`);
}
