// Sun and moon over a place, with the refraction of seasonscapes/sky/ephemeris.py; positions by Astronomy Engine.
import { Body, Equator, HelioVector, Horizon, Illumination, MakeTime, Observer } from "astronomy-engine";
import { RAD, direction } from "./frames.js";

const AU_KM = 149597870.7;
const TURNING = Math.sqrt(10.3) - 5.11;
const FULL_MOON_V = -12.73;
const SUN_V = -26.76;

export function refraction(trueDeg, heightM) {
  const pressure = 1013.25 * (1 - 2.25577e-5 * Math.min(heightM, 30000)) ** 5.25588;
  const clamped = Math.max(trueDeg, TURNING);
  const lift = ((pressure / 1010) * (1.02 / 60)) / Math.tan((clamped + 10.3 / (clamped + 5.11)) * RAD);
  const fade = Math.min(Math.max((trueDeg + 6) / 5, 0), 1);
  return lift * fade * fade * (3 - 2 * fade);
}

export function makeEphemeris(latitude, longitude, heightM) {
  const observer = new Observer(latitude, longitude, heightM);

  function place(body, date) {
    const equator = Equator(body, date, observer, true, true);
    const horizon = Horizon(date, observer, equator.ra, equator.dec);
    const elevation = horizon.altitude + refraction(horizon.altitude, heightM);
    return { azimuth: horizon.azimuth, elevation, trueElevation: horizon.altitude, distance: equator.dist };
  }

  function sun(time) {
    const found = place(Body.Sun, new Date(time));
    const radius = Math.asin(695700 / (found.distance * AU_KM)) / RAD;
    return { ...found, radius, direction: direction(found.azimuth, found.elevation) };
  }

  function moon(time) {
    const date = new Date(time);
    const found = place(Body.Moon, date);
    const light = Illumination(Body.Moon, date);
    const km = found.distance * AU_KM;
    const phase = light.phase_angle;
    const surge = 1 + 0.35 * Math.exp(-phase / 4.06);
    const distances = (km / 384400) * light.helio_dist;
    const magnitude = FULL_MOON_V + 0.026 * phase + 4e-9 * phase ** 4 - 2.5 * Math.log10(surge) + 5 * Math.log10(distances);
    const visual = 10 ** (-0.4 * (magnitude - SUN_V));
    // Reflectance rises with wavelength; the primaries' central wavelengths.
    const ratio = [610, 550, 465].map((nm) => visual * (1 + 1.1 * (nm / 550 - 1)));
    return {
      ...found,
      radius: Math.asin(1737.4 / km) / RAD,
      direction: direction(found.azimuth, found.elevation),
      fraction: light.phase_fraction,
      ratio,
    };
  }

  return { sun, moon };
}

export function sunDistance(time) {
  return HelioVector(Body.Earth, MakeTime(new Date(time))).Length();
}
