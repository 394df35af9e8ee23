// WGS 84, the scene's local east-north-up frame (with its lift for refraction), and angles; as seasonscapes/frames.py.

const A = 6378137.0;
const F = 1 / 298.257223563;
const E2 = F * (2 - F);
const MEAN_RADIUS = 6371008.8;
export const RAD = Math.PI / 180;

function ecef(latitude, longitude, height) {
  const [sinLat, cosLat] = [Math.sin(latitude * RAD), Math.cos(latitude * RAD)];
  const n = A / Math.sqrt(1 - E2 * sinLat * sinLat);
  const across = (n + height) * cosLat;
  return [across * Math.cos(longitude * RAD), across * Math.sin(longitude * RAD), (n * (1 - E2) + height) * sinLat];
}

/** Rows are east, north and up at a position, in ECEF. */
function axesAt(latitude, longitude) {
  const [sa, ca] = [Math.sin(latitude * RAD), Math.cos(latitude * RAD)];
  const [so, co] = [Math.sin(longitude * RAD), Math.cos(longitude * RAD)];
  return [[-so, co, 0], [-sa * co, -sa * so, ca], [ca * co, ca * so, sa]];
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const times = (matrix, vector) => matrix.map((row) => dot(row, vector));

export function makeFrame({ latitude_deg, longitude_deg, height_m, refraction_k }) {
  const origin = ecef(latitude_deg, longitude_deg, height_m);
  const axes = axesAt(latitude_deg, longitude_deg);
  const lift = (east, north) => (refraction_k * (east * east + north * north)) / (2 * MEAN_RADIUS);

  function fromGeodetic(latitude, longitude, height) {
    const point = ecef(latitude, longitude, height);
    const enu = times(axes, point.map((value, k) => value - origin[k]));
    return [enu[0], enu[1], enu[2] + lift(enu[0], enu[1])];
  }

  function toGeodetic([east, north, up]) {
    const local = [east, north, up - lift(east, north)];
    const [x, y, z] = origin.map((value, k) => value + axes[0][k] * local[0] + axes[1][k] * local[1] + axes[2][k] * local[2]);
    const distance = Math.hypot(x, y);
    let latitude = Math.atan2(z, distance * (1 - E2));
    for (let round = 0; round < 5; round++) {
      const sine = Math.sin(latitude);
      latitude = Math.atan2(z + (E2 * A * sine) / Math.sqrt(1 - E2 * sine * sine), distance);
    }
    const sine = Math.sin(latitude);
    const height = distance * Math.cos(latitude) + z * sine - A * Math.sqrt(1 - E2 * sine * sine);
    return [latitude / RAD, Math.atan2(y, x) / RAD, height];
  }

  /** Unit east, north and up of another place, in this frame. */
  function localAxes(latitude, longitude) {
    const there = axesAt(latitude, longitude);
    const rotated = there.map((row) => axes.map((axis) => dot(row, axis)));
    const [east, north] = times(axes, ecef(latitude, longitude, 0).map((v, k) => v - ecef(latitude_deg, longitude_deg, 0)[k]));
    const g = [(refraction_k / MEAN_RADIUS) * east, (refraction_k / MEAN_RADIUS) * north];
    const sheared = rotated.map((r) => [r[0] - r[2] * g[0], r[1] - r[2] * g[1], r[2] + r[0] * g[0] + r[1] * g[1]]);
    return orthonormal(sheared);
  }

  return { fromGeodetic, toGeodetic, localAxes };
}

/** Gram-Schmidt of rows, in order. */
function orthonormal(rows) {
  const made = [];
  for (const row of rows) {
    let left = [...row];
    for (const done of made) {
      const share = dot(left, done);
      left = left.map((value, k) => value - share * done[k]);
    }
    const length = Math.hypot(...left);
    made.push(left.map((value) => value / length));
  }
  return made;
}

export function direction(azimuthDeg, elevationDeg) {
  const [a, e] = [azimuthDeg * RAD, elevationDeg * RAD];
  return [Math.sin(a) * Math.cos(e), Math.cos(a) * Math.cos(e), Math.sin(e)];
}

export function angles([east, north, up]) {
  return [((Math.atan2(east, north) / RAD) + 360) % 360, Math.atan2(up, Math.hypot(east, north)) / RAD];
}

/** Forward and up vectors of a camera that stands at a position and looks along angles of its own horizon. */
export function cameraAxes(frame, latitude, longitude, headingDeg, pitchDeg) {
  const axes = frame.localAxes(latitude, longitude);
  const world = (v) => [0, 1, 2].map((k) => v[0] * axes[0][k] + v[1] * axes[1][k] + v[2] * axes[2][k]);
  return { forward: world(direction(headingDeg, pitchDeg)), up: world(direction(headingDeg, pitchDeg + 90)), axes };
}
