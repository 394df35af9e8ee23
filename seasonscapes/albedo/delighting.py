"""Albedo from one lit image of known hour: sun, sky and interreflection divided out texel by texel.

image = scale · (transmittance · albedo / π · (visibility · sun + sky factor · sky + bounce(albedo)) + airlight)

The image may lie a few texels off (`registration`), and its shadows are not quite where the heights put them
(`shadow_borders`). Interreflection depends on the albedo and is iterated. The sky's share of the light is the least
certain part of any sky model; it is corrected by what pairs of near texels under different light have in common.
Texels in shade are recovered from skylight, clipped ones are completed from their neighbours' colour; every texel
states its standard error and where it comes from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.ndimage import shift as spline_shift

from seasonscapes.albedo.adjacency import Surroundings, without_surroundings
from seasonscapes.albedo.closed_form import HIGHEST, LOWEST
from seasonscapes.albedo.ground_above import GroundAbove
from seasonscapes.albedo.land_response import class_illuminance, land_classes
from seasonscapes.albedo.registration import shifted_back, texture_shift
from seasonscapes.albedo.shadow_borders import BorderModel, refined_visibility
from seasonscapes.albedo.sky_factor import fitted_sky_factor
from seasonscapes.errors import NoUsablePixels

# Sources of a texel's albedo, in `DelitImage.source`.
NOTHING, SUNLIT, SHADED, COMPLETED = 0, 1, 2, 3
# Standard error of the cosine of incidence on ground that heights smooth and trees cover.
SLOPE_ERROR = 0.06
_GREY = 0.25


@dataclass(frozen=True)
class TexelIrradiance:
    """Light on the texels of a texture at one instant [lx]; textures of R rows and S columns.

    Parameters
    ----------
    sun
        ``(R, S, 3)`` illuminance of the inclined surface by the sun, as if nothing cast a shadow on it.
    visibility
        ``(R, S)`` predicted share of the sun's disc that is not hidden.
    sky
        ``(R, S, 3)`` illuminance by the visible sky.
    bounce
        Illuminance ``(R, S, 3)`` by light from other terrain, as a function of the albedo ``(R, S, 3)``.
    level_lx
        ``(3,)`` illuminance of level ground without surroundings; the reference of images of unknown exposure.
    chart
        ``(R, S)`` integers: neighbouring texels of equal number ≥ 0 adjoin on the surface; −1 off the surface.
    """

    sun: np.ndarray
    visibility: np.ndarray
    sky: np.ndarray
    bounce: Callable[[np.ndarray], np.ndarray]
    level_lx: np.ndarray
    chart: np.ndarray


@dataclass(frozen=True)
class Air:
    """Air between the surface and the sensor.

    Parameters
    ----------
    transmittance, airlight
        ``(3,)`` or ``(R, S, 3)`` share that passes, and radiance that is added [cd/m²].
    surroundings
        Light of the land around that it adds, in images from above; ``None`` to leave it out.
    """

    transmittance: np.ndarray
    airlight: np.ndarray
    surroundings: Surroundings | None = None


@dataclass(frozen=True)
class DelightOptions:
    """How to remove the light of an image.

    Parameters
    ----------
    radiance_per_unit
        Radiance of the image's value 1 [cd/m²], one number or one for each channel. ``None``: unknown; then an image
        value of 1 is what level ground of reflectance ``white_reflectance`` sends under the light of that hour.
    white_reflectance
        See ``radiance_per_unit``.
    air
        Air before the surface; ``None`` for none, as in images corrected for it.
    register
        Estimate and remove a shift of the image.
    borders
        Weights of the refinement of shadow borders; ``None`` keeps the predicted shadows.
    fit_sky
        Correct the sky's share of the light from the image.
    rounds
        Iterations of interreflection.
    land_class
        ``(R, S)`` integers, −1 for none: classes of land whose response to direct light is fitted one by one, so that
        their albedo no longer depends on it. Canopies are no Lambertian surfaces, and their sunlight and shade mix
        within a texel; see `albedo.land_response`. A number finds so many classes in the image by its colours;
        ``None`` treats all land as Lambertian.
    fit_where
        ``(R, S)`` bool: texels at which those responses are fitted; all if ``None``.
    ground
        Snow, forest and water as an image from straight above sees them; ``None`` treats them as Lambertian. The response
        of classes of land, where they are given, takes the place of that of snow and forest.
    light_error, slope_error
        Relative error of the modelled light, and standard error of the cosine of incidence, for σ.
    quantum
        Standard error of the image's values, for σ: by default that of 8 bits in sRGB.
    """

    radiance_per_unit: float | np.ndarray | None = None
    white_reflectance: float = 0.5
    air: Air | None = None
    register: bool = True
    borders: BorderModel | None = field(default_factory=BorderModel)
    fit_sky: bool = True
    rounds: int = 3
    land_class: np.ndarray | int | None = None
    fit_where: np.ndarray | None = None
    ground: GroundAbove | None = None
    light_error: float = 0.05
    slope_error: float = SLOPE_ERROR
    quantum: float | None = None


@dataclass(frozen=True)
class DelitImage:
    """An image without its light.

    Parameters
    ----------
    albedo
        ``(R, S, 3)`` float32; NaN where the image has no value.
    sigma
        ``(R, S)`` float32 standard error of the albedo; infinite where there is none.
    visibility
        ``(R, S)`` float32 share of the sun's disc that the image shows to be unhidden.
    source
        ``(R, S)`` uint8: 0 nothing, 1 sunlit, 2 in shade (from skylight), 3 completed (clipped in the image).
    shift_texels
        Rows and columns by which the image lay too far; ``None`` where it was not found or not asked for.
    sky_factor
        ``(3,)`` factor on the sky's illuminance that the image asks for.
    radiance_per_unit
        ``(3,)`` radiance of the image's value 1 that was used [cd/m²].
    exponents
        ``(K, 3)`` exponents of the cosine of incidence of K classes of land, 1 for a Lambertian one; ``None`` without
        classes.
    """

    albedo: np.ndarray
    sigma: np.ndarray
    visibility: np.ndarray
    source: np.ndarray
    shift_texels: tuple[float, float] | None
    sky_factor: np.ndarray
    radiance_per_unit: np.ndarray
    exponents: np.ndarray | None = None

    @property
    def facts(self) -> dict[str, Any]:
        """Plain values for files and reports."""
        surface = max(int((self.source > NOTHING).sum()), 1)
        responses = {} if self.exponents is None else {"class_exponents": np.round(self.exponents, 3).tolist()}
        return responses | {
            "shift_texels": None if self.shift_texels is None else [round(float(x), 2) for x in self.shift_texels],
            "sky_factor": [round(float(x), 3) for x in self.sky_factor],
            "radiance_per_unit_cd_m2": [round(float(x), 1) for x in self.radiance_per_unit],
            "sunlit_share": round(float((self.source == SUNLIT).sum() / surface), 4),
            "shaded_share": round(float((self.source == SHADED).sum() / surface), 4),
            "completed_share": round(float((self.source == COMPLETED).sum() / surface), 4),
            "median_sigma": round(float(np.median(self.sigma[self.source > NOTHING])), 4) if surface > 1 else None,
        }


def delight_image(
    image: np.ndarray,
    clipped: np.ndarray,
    light: TexelIrradiance,
    *,
    options: DelightOptions | None = None,
    progress: Callable[[float], None] | None = None,
) -> DelitImage:
    """Estimate the albedo of a lit image whose light is known.

    Parameters
    ----------
    image
        ``(R, S, 3)`` scene-linear values, proportional to radiance; NaN where there are none.
    clipped
        ``(R, S, 3)`` bool: values at the upper end of the sensor's or file's range.
    light
        Light of the image's hour on the texels.
    options
        Defaults if ``None``.
    progress
        Called with the finished fraction.

    Returns
    -------
    DelitImage
        Albedo, standard error, visibility of the sun, and what was fitted.

    Raises
    ------
    NoUsablePixels
        Where the image has no value on the surface.
    """
    options, report = options or DelightOptions(), progress or (lambda fraction: None)
    known = np.isfinite(image).all(axis=2) & (light.chart >= 0)
    if not known.any():
        raise NoUsablePixels("delight: the image has no value anywhere on the surface")
    shift = None
    if options.register:
        predicted = light.visibility[..., None] * light.sun + light.sky + light.bounce(_grey(light.sun.shape))
        shift = texture_shift(image.mean(axis=2), predicted.mean(axis=2), known)
    report(0.1)
    if shift is None:
        return _delit(image, clipped, light, options, report)
    # Splines through the sharp borders of shadows in the image would overshoot; the light is moved onto the image instead,
    # and the albedo, which has none, back onto the surface.
    result = _delit(image, clipped, _moved_light(light, shift), _moved_options(options, shift), report)
    return _placed_back(result, shift)


def _grey(shape: tuple[int, ...]) -> np.ndarray:
    return np.full(shape, _GREY, np.float32)


def _moved(values: np.ndarray, shift: tuple[float, float], *, order: int = 0) -> np.ndarray:
    """Values of texels ``(R, S)`` or ``(R, S, C)`` at the places where the image shows them; those of the rim beyond it."""
    offsets = (*shift, *(0.0 for _ in values.shape[2:]))
    return spline_shift(values.astype(np.float64), offsets, order=order, mode="nearest").astype(np.float32)


def _moved_options(options: DelightOptions, shift: tuple[float, float]) -> DelightOptions:
    kind, where = options.land_class, options.fit_where
    return replace(
        options,
        land_class=_moved(kind, shift).astype(int) if isinstance(kind, np.ndarray) else kind,
        fit_where=None if where is None else _moved(where, shift) > 0.5,
        ground=None if options.ground is None else _moved_ground(options.ground, shift),
    )


def _moved_ground(ground: GroundAbove, shift: tuple[float, float]) -> GroundAbove:
    water = None if ground.water is None else _moved(ground.water, shift, order=1)
    return replace(ground, normal=_moved(ground.normal, shift), water=water)


def _moved_light(light: TexelIrradiance, shift: tuple[float, float]) -> TexelIrradiance:
    back = (-shift[0], -shift[1])
    return replace(
        light,
        sun=_moved(light.sun, shift, order=1),
        visibility=_moved(light.visibility, shift, order=1),
        sky=_moved(light.sky, shift, order=1),
        bounce=lambda albedo: _moved(light.bounce(_moved(albedo, back)), shift, order=1),
        chart=_moved(light.chart, shift).astype(np.int32),
    )


def _placed_back(delit: DelitImage, shift: tuple[float, float]) -> DelitImage:
    """Results on the texels of the surface from those on the image's."""
    logarithm = shifted_back(np.log(np.maximum(delit.albedo, LOWEST)), shift)
    albedo = np.exp(logarithm)
    known = np.asarray(np.isfinite(albedo).all(axis=2))
    back = (-shift[0], -shift[1])
    source = _moved(delit.source, back).astype(np.uint8)
    # Beside an unknown texel no spline passes: the nearest value.
    nearest = _moved(np.nan_to_num(delit.albedo), back)
    albedo = np.where(known[..., None] | (source[..., None] == NOTHING), albedo, nearest)
    there = source != NOTHING
    sigma = np.where(there, _moved(np.where(np.isfinite(delit.sigma), delit.sigma, 1.0), back), np.inf)
    return replace(
        delit,
        albedo=np.where(there[..., None], albedo, np.float32(np.nan)).astype(np.float32),
        sigma=sigma.astype(np.float32),
        visibility=np.clip(_moved(delit.visibility, back, order=1), 0.0, 1.0),
        source=source,
        shift_texels=shift,
    )


def _delit(
    image: np.ndarray,
    clipped: np.ndarray,
    light: TexelIrradiance,
    options: DelightOptions,
    report: Callable[[float], None],
) -> DelitImage:
    """`delight_image` of an image that lies where the light does."""
    known = np.isfinite(image).all(axis=2) & (light.chart >= 0)
    chart = np.where(known, light.chart, -1)
    scale = _radiance_per_unit(options, light)
    radiance = _at_surface(np.nan_to_num(image) * scale, options.air, known)
    if options.ground is not None:
        radiance = options.ground.lambertian_radiance(radiance)
    visibility, deviation = light.visibility.astype(np.float32), np.zeros(chart.shape, np.float32)
    factor, bounce = np.ones(3), light.bounce(_grey(light.sun.shape))
    sunlight = illuminance = visibility[..., None] * light.sun
    albedo = _grey(light.sun.shape)
    for number in range(options.rounds):
        final = number == options.rounds - 1
        if options.borders is not None and (number == 0 or final):
            visibility, deviation = refined_visibility(
                np.log(np.pi * np.maximum(radiance, 1e-3)),
                light.sun,
                np.maximum(factor * light.sky + bounce, 1e-3).astype(np.float32),
                light.visibility,
                chart,
                # Borders are good enough for the sky factor after a rough first pass.
                model=options.borders if final else replace(options.borders, levels=3, iterations=8),
            )
        sunlight = visibility[..., None] * light.sun
        if options.fit_sky:
            usable = known & ~clipped.any(axis=2) & (deviation < 0.1)
            factor = fitted_sky_factor(radiance, light.sun, visibility, light.sky, bounce, np.where(usable, chart, -1))
        illuminance = np.maximum(sunlight + factor * light.sky + bounce, 1e-3)
        albedo = np.clip(np.pi * radiance / illuminance, LOWEST, HIGHEST).astype(np.float32)
        albedo[~known] = _GREY
        bounce = light.bounce(albedo)
        report(0.1 + 0.8 * (number + 1) / options.rounds)
    exponents = None
    if options.land_class is not None:
        whole = known & ~clipped.any(axis=2)
        given = options.land_class
        kind = land_classes(albedo, whole, given) if isinstance(given, int) else np.where(whole, given, -1)
        ambient = illuminance - sunlight
        illuminance, exponents = class_illuminance(radiance, light.sun, visibility, ambient, kind, options.fit_where)
        albedo = np.clip(np.pi * radiance / illuminance, LOWEST, HIGHEST).astype(np.float32)
    elif options.ground is not None:
        illuminance = options.ground.illuminance(radiance, sunlight, illuminance - sunlight)
        albedo = np.clip(np.pi * radiance / np.maximum(illuminance, 1e-3), LOWEST, HIGHEST).astype(np.float32)
        albedo[~known] = _GREY
    albedo = _completed(albedo, clipped & known[..., None], known)
    sigma = _standard_error(albedo, image, light, sunlight, illuminance, deviation, options)
    lost = clipped.any(axis=2) & known
    sigma = np.where(lost, np.maximum(sigma, 0.3 * albedo.mean(axis=2)), sigma)
    in_sun = sunlight.max(axis=2) > 0.25 * illuminance.max(axis=2)
    source = np.select([~known, lost, in_sun], [NOTHING, COMPLETED, SUNLIT], SHADED).astype(np.uint8)
    report(1.0)
    return DelitImage(
        np.where(known[..., None], albedo, np.float32(np.nan)),
        np.where(known, sigma, np.inf).astype(np.float32),
        visibility,
        source,
        None,
        factor,
        scale,
        exponents,
    )


def _radiance_per_unit(options: DelightOptions, light: TexelIrradiance) -> np.ndarray:
    if options.radiance_per_unit is not None:
        return np.broadcast_to(np.asarray(options.radiance_per_unit, float), (3,))
    white = options.white_reflectance * np.asarray(light.level_lx, float) / np.pi
    if options.air is None:
        return white
    passed, added = (
        np.asarray(values, float).reshape(-1, 3).mean(axis=0)
        for values in (options.air.transmittance, options.air.airlight)
    )
    return white * passed + added


def _at_surface(radiance: np.ndarray, air: Air | None, known: np.ndarray) -> np.ndarray:
    if air is None:
        return radiance.astype(np.float32)
    left = radiance - air.airlight
    if air.surroundings is None:
        surface = left / air.transmittance
    else:
        surface = without_surroundings(left, air.transmittance, air.surroundings, known)
    # What is left below the airlight is noise; a hundredth of the image stays.
    return np.maximum(surface, 0.01 * radiance).astype(np.float32)


def _completed(albedo: np.ndarray, clipped: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Albedo with its clipped channels completed: from the unclipped ones and the colour of unclipped neighbours."""
    lost = np.asarray(clipped.any(axis=2), bool)
    good = known & ~lost
    if not lost.any() or not good.any():
        return albedo
    # Neighbours' colour: a normalised blur near by, the nearest texel where that reaches nothing.
    share = gaussian_filter(good.astype(np.float32), 3.0)
    blurred = (
        np.stack([gaussian_filter(np.where(good, albedo[..., k], 0.0), 3.0) for k in range(3)], axis=2)
        / np.maximum(share, 1e-6)[..., None]
    )
    nearest = np.asarray(distance_transform_edt(~good, return_distances=False, return_indices=True))
    around = np.where((share > 1e-3)[..., None], blurred, albedo[nearest[0], nearest[1]])
    whole = np.equal(clipped, np.zeros_like(clipped))
    ratio = np.where(whole, albedo, 0.0).sum(axis=2) / np.maximum(np.where(whole, around, 0.0).sum(axis=2), 1e-6)
    # A clipped value is a lower bound.
    guess = np.where(np.asarray(whole.any(axis=2))[..., None], around * ratio[..., None], around)
    filled = np.where(clipped, np.maximum(albedo, guess), albedo)
    return np.clip(filled, LOWEST, HIGHEST).astype(np.float32)


def _standard_error(
    albedo: np.ndarray,
    image: np.ndarray,
    light: TexelIrradiance,
    sunlight: np.ndarray,
    illuminance: np.ndarray,
    deviation: np.ndarray,
    options: DelightOptions,
) -> np.ndarray:
    """Standard error ``(R, S)``: of the modelled light, the slope, the visibility and the image's levels."""
    total = illuminance.mean(axis=2)
    facing = np.asarray(light.level_lx, float).mean()
    unhidden = (sunlight.mean(axis=2) > 0.0).astype(float)
    value = np.maximum(np.nan_to_num(image).mean(axis=2), 1e-4)
    # One level of 8-bit sRGB in linear light, about its derivative 2.2 v^(1 - 1/2.2).
    quantum = 2.2 * value ** (1.0 - 1.0 / 2.2) / 255.0 / np.sqrt(12.0) if options.quantum is None else options.quantum
    relative = (
        options.light_error**2
        + (options.slope_error * facing * unhidden / total) ** 2
        + (deviation * light.sun.mean(axis=2) / total) ** 2
        + (quantum / value) ** 2
    )
    # Where hardly any light falls nothing is known; no albedo is more than 1 off.
    return np.minimum(albedo.mean(axis=2) * np.sqrt(relative), 1.0)
