"""Albedo in closed form: robust least squares of all photographs' pixels over texels, with gains projected out.

For photograph i and channel c let ``m(a) = T · M a + A`` be the radiance that albedo ``a`` would send to the camera
(`forward`) and ``y`` the picture's linear values. With inverse gain h, ``h y = m(a)``: linear in both. Where a picture
shows sky, h is the ratio of the sky's known radiance to the picture's; the gains of pictures without sky are eliminated
(variable projection: Golub & Pereyra 1973, doi:10.1137/0710036), which leaves one sparse linear system in ``a``, solved
by conjugate gradients. Projecting all gains, sky pixels among the equations, lets the scale of everything shrink: terrain
pixels outnumber the sky's, and any misfit of theirs is least where all is dark.
Residuals are weighed by what camera and model can promise, and re-weighted by Cauchy's function, so that houses, clouds'
shadows and mistaken pixels fade.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from seasonscapes.albedo.footprints import Footprints, seen_weight, thinned_footprints, trace_footprints, whole_pixels
from seasonscapes.albedo.forward import Land, Seen, air_between, ambient_on_texels, seen_by, sky_seen
from seasonscapes.cameras.observation import Observation
from seasonscapes.rendering.reception import luminaries
from seasonscapes.sky.illumination import Illumination

Progress = Callable[[float], None]
# Albedos of nature lie within these; fresh snow is 0.95 at most, lakes and conifers reflect 2 %.
LOWEST, HIGHEST = 0.004, 0.98
# Sky pixels that fix a gain, and how far they keep from sun and moon, whose glare and disc say nothing.
_FEWEST_SKY, _GLARE_DEG = 100, 8.0


@dataclass(frozen=True)
class Trust:
    """What pictures and model promise: standard deviations that weigh the residuals.

    Parameters
    ----------
    model
        Of the modelled radiance, relative: sampling of light, sub-texel relief.
    edge
        Of sunlight where a shadow's edge runs through the pixel, relative: penumbra and terrain are never exact.
    sky
        Of the sky's radiance, relative.
    levels
        Bits of the picture's encoding; ``None`` for linear floats. Rounding and JPEG blur about one level.
    level_noise
        Standard deviation in levels of the encoded picture.
    black, white
        Linear values at and beyond which a pixel says nothing, of 1 that clips; for encoded pictures only.
    """

    model: float = 0.02
    edge: float = 0.15
    sky: float = 0.03
    levels: int | None = None
    level_noise: float = 1.5
    black: float = 0.0015
    white: float = 0.97


LINEAR = Trust()
EIGHT_BIT = Trust(levels=255)


@dataclass(frozen=True)
class Effort:
    """How hard to try: rounds of interreflection and re-weighting, iterations of conjugate gradients in each."""

    rounds: int = 5
    iterations: int = 12
    smoothness: float = 2e-3


@dataclass(frozen=True)
class Shot:
    """One photograph, its light, and where its pixels lie in the footprints of its camera.

    Parameters
    ----------
    observation
        Picture and mask; values are linear in any unit, 1 clips for encoded pictures.
    light
        As seen from its camera.
    footprints, number
        Of its camera, and which of their lights this is.
    seen
        Of its camera.
    gain
        ``(3,)`` known picture value over radiance; ``None`` where exposure and white balance are to be found.
    """

    observation: Observation
    light: Illumination
    footprints: Footprints
    number: int
    seen: Seen
    gain: np.ndarray | None = None


@dataclass(frozen=True)
class AlbedoFit:
    """What was found.

    Parameters
    ----------
    albedo
        ``(R, S, 3)`` float32; where ``seen`` is 0 it is the nearest seen texel's, which is no measurement.
    seen
        ``(R, S)`` float32 pixels that each texel fills, over cameras.
    information
        ``(R, S)`` float32 diagonal of the information matrix, in 1/variance of albedo (green).
    gains
        ``(K, 3)`` picture value over radiance.
    residual
        ``(K,)`` robust relative residual of each photograph: median of |picture / model - 1|.
    cost
        Robust cost a pixel, comparable between fits of the same photographs.
    """

    albedo: np.ndarray
    seen: np.ndarray
    information: np.ndarray
    gains: np.ndarray
    residual: np.ndarray
    cost: float
    history: list[dict] = field(default_factory=list)


def make_shots(land: Land, observations: Sequence[Observation], lights: Sequence[Illumination], *, rays: int = 16,
               gains: Sequence[np.ndarray | None] | None = None, seed: int = 0,
               progress: Progress | None = None) -> list[Shot]:  # fmt: skip
    """Trace the footprints of all cameras, each camera once for all its photographs.

    Parameters
    ----------
    gains
        Known picture value over radiance, ``(3,)`` each; left out, unknown.
    """
    tell = progress or (lambda share: None)
    if len(observations) != len(lights) or not observations:
        raise ValueError(
            f"make_shots: got {len(observations)} photographs and {len(lights)} lights, one of each expected"
        )
    groups: dict[bytes, list[int]] = {}
    for index, one in enumerate(observations):
        camera = one.camera
        size = np.array([camera.width_px, camera.height_px, camera.fx, camera.fy, camera.cx, camera.cy])
        groups.setdefault(size.tobytes() + camera.world_from_camera.tobytes(), []).append(index)
    shots: dict[int, Shot] = {}
    for done, members in enumerate(groups.values()):
        suns = [luminaries(lights[i]) for i in members]
        footprints = trace_footprints(land.occluder, observations[members[0]].camera, land.shape, suns, rays=rays, seed=seed,
                                      progress=lambda share, done=done: tell((done + share) / len(groups)))  # fmt: skip
        seen = seen_by(footprints, seed=seed)
        for number, i in enumerate(members):
            gain = None if gains is None or gains[i] is None else np.broadcast_to(np.asarray(gains[i], float), (3,))
            shots[i] = Shot(observations[i], lights[i], footprints, number, seen, gain)
    return [shots[i] for i in range(len(observations))]


@dataclass
class _Rows:
    """The equations of one photograph; weights change from round to round."""

    shot: Shot
    picture: np.ndarray  # (n, 3)
    usable: np.ndarray  # (n, 3) bool
    noise: np.ndarray  # (n, 3) standard deviation of the picture
    transmittance: np.ndarray
    airlight: np.ndarray
    sky_picture: np.ndarray  # (K, 3)
    sky_radiance: np.ndarray
    ambient: np.ndarray  # (R·S, 3)
    inverse_gain: np.ndarray  # (3,)
    suns: list[np.ndarray]
    weight: np.ndarray | None = None  # (n, 3)

    @property
    def projected(self) -> bool:
        """Whether the gain is eliminated: neither given nor fixed by the sky."""
        return self.shot.gain is None and len(self.sky_picture) < _FEWEST_SKY


def solve_albedo(land: Land, shots: Sequence[Shot], *, trust: Trust = LINEAR, effort: Effort = Effort(),
                 start: np.ndarray | None = None, prior: tuple[np.ndarray, float] | None = None,
                 progress: Progress | None = None) -> AlbedoFit:  # fmt: skip
    """Albedo, exposures and white balances from photographs under known light.

    Parameters
    ----------
    start
        ``(R, S, 3)`` albedo to begin with; left out, a middling grey.
    prior
        Another albedo ``(R, S, 3)`` (from a satellite) and its weight: 1 counts like one good pixel a texel.

    Raises
    ------
    ValueError
        No pixel is usable (all clipped, black or masked), or nothing fixes the exposure: no sky, no air, no known gain.
    """
    tell = progress or (lambda share: None)
    size = land.shape[0] * land.shape[1]
    rows = [_rows(shot, trust, size) for shot in shots]
    _require_usable(rows)
    seen = seen_weight(_unique([shot.footprints for shot in shots]))
    albedo = np.full((size, 3), 0.25, np.float32) if start is None else start.reshape(size, 3).astype(np.float32)
    observed = seen.ravel() > 0.0
    history = []
    for number in range(effort.rounds):
        filled = fill_nearest(albedo.reshape(*land.shape, 3), seen)
        for row in rows:
            row.ambient = ambient_on_texels(land, row.shot.light, filled)
        _weigh(rows, albedo, trust, robust=number > 0)
        albedo, diagonal = _solve(rows, albedo, effort, land.shape, prior)
        albedo = np.clip(albedo, LOWEST, HIGHEST)
        cost, residual = _assess(rows, albedo, trust)
        history.append({"round": number, "cost": cost, "residual": float(np.median(residual))})
        tell((number + 1) / effort.rounds)
    albedo = fill_nearest(albedo.reshape(*land.shape, 3), seen)
    gains = np.stack([1.0 / row.inverse_gain for row in rows])
    information = np.where(observed, diagonal[:, 1], 0.0).reshape(land.shape).astype(np.float32)
    return AlbedoFit(albedo, seen, information, gains, residual, cost, history)


def _unique(items: Sequence) -> list:
    return list({id(item): item for item in items}.values())


def _rows(shot: Shot, trust: Trust, size: int) -> _Rows:
    """Pick the photograph's terrain and sky pixels and say how far each is to be trusted."""
    footprints, observation = shot.footprints, shot.observation
    picture = observation.image.reshape(-1, 3)
    usable = observation.mask.ravel() & np.isfinite(picture).all(axis=1)
    if trust.levels is not None:
        # One clipped channel clips the pixel: demosaicing and JPEG mix the channels.
        usable = usable & (picture.max(axis=1) < trust.white) & (picture.max(axis=1) > trust.black)
    terrain, sky = footprints.pixel, shot.seen.sky.pixel
    whole = whole_pixels(footprints) & usable[terrain]
    transmittance, airlight = air_between(shot.seen, shot.light, len(terrain))
    chosen = usable[sky]
    for body in luminaries(shot.light):
        chosen &= shot.seen.sky.direction @ np.asarray(body.direction) < np.cos(np.radians(_GLARE_DEG))
    sky = sky[chosen]
    radiance = sky_seen(shot.seen, shot.light)[chosen] if len(shot.seen.sky.pixel) else np.zeros((0, 3), np.float32)
    suns = [np.asarray(body.normal_illuminance_lx, np.float32) for body in luminaries(shot.light)]
    values = np.nan_to_num(picture[terrain].astype(np.float32))
    rows = _Rows(shot, values, np.repeat(whole[:, None], 3, axis=1), _picture_noise(values, trust), transmittance, airlight,
                 picture[sky].astype(np.float32), radiance.astype(np.float32), np.zeros((size, 3), np.float32),
                 np.ones(3), suns)  # fmt: skip
    if shot.gain is not None:
        rows.inverse_gain = 1.0 / shot.gain
    elif not rows.projected:
        rows.inverse_gain = _median_ratio(rows.sky_radiance, rows.sky_picture)
    return rows


def _picture_noise(linear: np.ndarray, trust: Trust) -> np.ndarray:
    """Standard deviation of linear values from rounding and compression of their sRGB encoding."""
    if trust.levels is None:
        return np.zeros_like(linear)
    bright = np.maximum(linear, 1e-6)
    slope = np.where(linear <= 0.0031308, 1.0 / 12.92, 2.4 / 1.055 * bright ** (1.0 - 1.0 / 2.4))
    return (trust.level_noise / trust.levels * slope).astype(np.float32)


def _require_usable(rows: list[_Rows]) -> None:
    counts = [int(row.usable[:, 0].sum()) for row in rows]
    if sum(counts) == 0:
        raise ValueError("solve_albedo: no usable pixel in any photograph: all clipped, black or masked")
    dark = [
        row for row in rows if not row.suns and row.ambient.max() <= 0.0 and row.shot.light.sky_radiance.max() <= 0.0
    ]
    if len(dark) == len(rows):
        raise ValueError("solve_albedo: no photograph has any light")
    anchored = any(not row.projected or row.airlight.max() > 0.0 for row in rows)
    if not anchored:
        raise ValueError("solve_albedo: nothing fixes the exposure: give a gain, or photographs that show sky")


# ---------------------------------------------------------------------------------------------- linear parts


def _model(row: _Rows, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radiance ``(n, 3)`` at the camera without airlight, and its directly sunlit part."""
    footprints = row.shot.footprints
    sun = np.zeros((len(footprints.pixel), 3), np.float32)
    for illuminance, values in zip(row.suns, footprints.sunlit[row.shot.number], strict=True):
        sun += (footprints.matrix(values) @ albedo) * illuminance
    total = sun + footprints.matrix(footprints.share) @ (row.ambient * albedo)
    scale = row.transmittance / np.float32(np.pi)
    return total * scale, sun * scale


def _adjoint(row: _Rows, residual: np.ndarray) -> np.ndarray:
    """Transpose of `_model`: ``(n, 3)`` → ``(R·S, 3)``."""
    footprints = row.shot.footprints
    scaled = residual * row.transmittance / np.float32(np.pi)
    total = (footprints.matrix(footprints.share).T @ scaled) * row.ambient
    for illuminance, values in zip(row.suns, footprints.sunlit[row.shot.number], strict=True):
        total += footprints.matrix(values).T @ (scaled * illuminance)
    return total


def _squared_adjoint(row: _Rows) -> np.ndarray:
    """Diagonal of the normal matrix, ``(R·S, 3)``: the preconditioner and the information of each texel."""
    footprints = row.shot.footprints
    scaled = row.weight * (row.transmittance / np.float32(np.pi)) ** 2
    share, texel = footprints.share, footprints.texel
    total = np.empty_like(row.ambient)
    for channel in range(3):
        values = share * row.ambient[texel, channel]
        for illuminance, sunlit in zip(row.suns, footprints.sunlit[row.shot.number], strict=True):
            values = values + sunlit * illuminance[channel]
        total[:, channel] = footprints.matrix(values * values).T @ scaled[:, channel]
    return total


# ---------------------------------------------------------------------------------------------- weights


def _weigh(rows: list[_Rows], albedo: np.ndarray, trust: Trust, *, robust: bool) -> None:
    """Weights of all equations from the present albedo: variances, times Cauchy's where ``robust``."""
    for row in rows:
        model, sun = _model(row, albedo)
        radiance = model + row.airlight
        if row.projected:
            row.inverse_gain = _projected_gain(row, radiance)
        lit = row.shot.footprints.lit[row.shot.number] if row.suns else np.zeros(len(model))
        mixed = np.nan_to_num(4.0 * lit * (1.0 - lit)).astype(np.float32)[:, None]
        noise = row.noise * row.inverse_gain.astype(np.float32)
        floor = 1e-3 * float(np.median(radiance)) + 1e-9
        variance = (trust.model * radiance) ** 2 + (trust.edge * sun * mixed) ** 2 + noise**2 + floor**2
        row.weight = np.where(row.usable, 1.0 / variance, 0.0).astype(np.float32)
        if robust:
            h = row.inverse_gain.astype(np.float32)
            row.weight *= _cauchy((h * row.picture - radiance) * np.sqrt(row.weight), row.usable)


def _cauchy(normal: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Cauchy's weights of residuals that should have unit variance; one doubtful channel makes the pixel doubtful."""
    worst = np.abs(normal).max(axis=1, keepdims=True)
    counted = worst[usable[:, 0]]
    # Where the promise was too bold, the spread found counts instead: 2.385 gives 95 % efficiency for normal errors.
    scale = max(1.0, float(np.median(counted)) / 1.4 if len(counted) else 1.0)
    return 1.0 / (1.0 + (worst / (2.385 * scale)) ** 2)


def _median_ratio(top: np.ndarray, bottom: np.ndarray) -> np.ndarray:
    """Median of top over positive bottom, channel by channel ``(3,)``."""
    sound = [bottom[:, c] > 0.0 for c in range(3)]
    return np.array([np.median(top[k, c] / bottom[k, c]) if k.any() else 1.0 for c, k in enumerate(sound)], float)


def _projected_gain(row: _Rows, radiance: np.ndarray) -> np.ndarray:
    """Inverse gain ``(3,)`` that fits terrain pixels best to a radiance."""
    keep = row.usable[:, 0]
    if row.weight is None:
        return _median_ratio(radiance[keep], row.picture[keep])
    bottom = (row.weight * row.picture**2).sum(axis=0)
    top = (row.weight * row.picture * radiance).sum(axis=0)
    return np.where(bottom > 0.0, top / np.maximum(bottom, 1e-30), row.inverse_gain).astype(float)


# ---------------------------------------------------------------------------------------------- conjugate gradients


def _solve(rows: list[_Rows], start: np.ndarray, effort: Effort, shape: tuple[int, int],
           prior: tuple[np.ndarray, float] | None) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Minimise the weighted squares over albedo, gains projected out. Returns albedo and the normal diagonal."""
    diagonal = np.zeros_like(start)
    target = np.zeros_like(start)
    bottoms = []
    for row in rows:
        diagonal += _squared_adjoint(row)
        if row.projected:
            bottoms.append(np.maximum((row.weight * row.picture**2).sum(axis=0), 1e-30))
            known = (row.weight * row.picture * row.airlight).sum(axis=0)
            right = row.picture * (known / bottoms[-1]) - row.airlight
        else:
            bottoms.append(None)
            right = row.picture * row.inverse_gain.astype(np.float32) - row.airlight
        target += _adjoint(row, row.weight * right)
    typical = np.array([np.median(d[d > 0.0]) if (d > 0.0).any() else 1.0 for d in diagonal.T], np.float32)
    smooth = effort.smoothness * typical
    pull = np.zeros(3, np.float32)
    if prior is not None:
        pull = prior[1] * typical
        target = target + pull * prior[0].reshape(start.shape)

    def normal(a: np.ndarray) -> np.ndarray:
        total = smooth * _laplacian(a, shape) + (pull + 1e-6 * typical) * a
        for row, bottom in zip(rows, bottoms, strict=True):
            model = _model(row, a)[0]
            if bottom is not None:
                model -= row.picture * ((row.weight * row.picture * model).sum(axis=0) / bottom)
            total += _adjoint(row, row.weight * model)
        return total

    preconditioner = 1.0 / (diagonal + 4.0 * smooth + pull + 1e-6 * typical)
    target = target + 1e-6 * typical * start
    return _conjugate_gradients(normal, target, start, preconditioner, effort.iterations), diagonal


def _conjugate_gradients(normal: Callable, target: np.ndarray, x: np.ndarray, preconditioner: np.ndarray,
                         iterations: int) -> np.ndarray:  # fmt: skip
    """Preconditioned conjugate gradients for three independent systems side by side."""
    x = x.copy()
    residual = target - normal(x)
    z = preconditioner * residual
    direction = z.copy()
    rho = _dots(residual, z)
    first = np.maximum(rho, 1e-30)
    for _ in range(iterations):
        if np.all(rho < 1e-8 * first):
            break
        step = normal(direction)
        alpha = rho / np.maximum(_dots(direction, step), 1e-30)
        x += (alpha * direction).astype(np.float32)
        residual = residual - (alpha * step).astype(np.float32)
        z = preconditioner * residual
        after = _dots(residual, z)
        direction = z + (after / np.maximum(rho, 1e-30) * direction).astype(np.float32)
        rho = after
    return x


def _dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nc,nc->c", a.astype(np.float64), b.astype(np.float64))


def _laplacian(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Graph Laplacian of the texel grid: four neighbours."""
    grid = values.reshape(*shape, -1)
    result = np.zeros_like(grid)
    down, across = np.diff(grid, axis=0), np.diff(grid, axis=1)
    result[:-1] -= down
    result[1:] += down
    result[:, :-1] -= across
    result[:, 1:] += across
    return result.reshape(values.shape)


def _assess(rows: list[_Rows], albedo: np.ndarray, trust: Trust) -> tuple[float, np.ndarray]:
    """Robust cost a pixel in the pictures' own relative scale, and median relative residual of each photograph."""
    total, count, residuals = 0.0, 0, []
    for row in rows:
        radiance = _model(row, albedo)[0] + row.airlight
        if row.projected:
            row.inverse_gain = _projected_gain(row, radiance)
        h = row.inverse_gain.astype(np.float32)
        floor = 1e-3 * float(np.median(radiance)) + 1e-9
        relative = (h * row.picture - radiance) / (radiance + floor)
        promised = np.sqrt(trust.model**2 + (row.noise * h / (radiance + floor)) ** 2)
        keep = row.usable[:, 0]
        total += float(np.log1p((relative[keep] / (2.385 * promised[keep])) ** 2).sum())
        count += int(keep.sum()) * 3
        if len(row.sky_picture):
            apart = (h * row.sky_picture - row.sky_radiance) / (row.sky_radiance + floor)
            total += float(np.log1p((apart / (2.385 * trust.sky)) ** 2).sum())
            count += apart.size
        residuals.append(float(np.median(np.abs(relative[keep]))) if keep.any() else np.nan)
    return total / max(count, 1), np.array(residuals)


def fill_nearest(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Values ``(R, S, 3)`` with those of texels that were never seen taken from the nearest seen one."""
    from scipy.ndimage import distance_transform_edt

    if (seen > 0.0).all() or not (seen > 0.0).any():
        return values
    row, column = distance_transform_edt(seen <= 0.0, return_distances=False, return_indices=True)
    return values[row, column]


def pixel_weights(land: Land, shots: Sequence[Shot], fit: AlbedoFit, trust: Trust = LINEAR) -> list[np.ndarray]:
    """Weights ``(n, 3)`` [1 / (cd/m²)²] that a fit's last round gives the terrain pixels of each photograph."""
    size = land.shape[0] * land.shape[1]
    albedo = fit.albedo.reshape(size, 3)
    weights = []
    for shot, gain in zip(shots, fit.gains, strict=True):
        row = _rows(replace(shot, gain=np.asarray(gain, float)), trust, size)
        row.ambient = ambient_on_texels(land, shot.light, fit.albedo)
        _weigh([row], albedo, trust, robust=True)
        weights.append(row.weight)
    return weights


def thinned_shots(shots: Sequence[Shot], share: float, seed: int) -> list[Shot]:
    """The same photographs with a share of their terrain pixels."""
    if share >= 1.0:
        return list(shots)
    rng = np.random.default_rng(seed)
    made: dict[int, tuple[Footprints, object]] = {}
    result = []
    for shot in shots:
        if id(shot.footprints) not in made:
            part = thinned_footprints(shot.footprints, rng.random(len(shot.footprints.pixel)) < share)
            made[id(shot.footprints)] = part, replace(seen_by(part), sky=shot.seen.sky)
        footprints, seen = made[id(shot.footprints)]
        result.append(replace(shot, footprints=footprints, seen=seen))
    return result
