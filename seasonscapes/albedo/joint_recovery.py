"""Albedo together with haze, exposure, response, clouds before the sun, and pose: one robust least-squares problem.

The closed form takes light, air, response and pose as given; where they are not, it puts their errors into the albedo.
Here they are unknowns with priors (`recovery_unknowns`), and the residuals of encoded pixel values decide. Pictures are
differentiated through the daylight coefficients of the land (`recovery_prediction`), exactly and without new rays. Each round

1. computes interreflection under the present albedo and light;
2. linearises all pictures, with Cauchy's weights on their residuals;
3. solves for log albedo and all other unknowns at once (`recovery_system`): Gauss-Newton, the albedo of a texel eliminated
   from the others' preconditioner.

Interreflection is held during a round: its derivative to the albedo is at most the product of albedo and of the share of
the hemisphere that other land fills, and the rounds contract by that factor. Photographs that are held out judge the result;
where their loss does not fall, the closed form is returned. At the end the pictures are corrected by what was found, and
the closed form solves for the albedo once more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.albedo.closed_form import HIGHEST, LOWEST, AlbedoFit, SolverOptions, solve_albedo
from seasonscapes.albedo.forward_model import TexelTransport
from seasonscapes.albedo.photographs import AlbedoPhotograph, prepare_photographs
from seasonscapes.albedo.recovery_pictures import HazeLights, turned_camera
from seasonscapes.albedo.recovery_rounds import (
    JointOptions,
    RecoveryProblem,
    RecoveryState,
    advance,
    held_out_loss,
    make_problem,
    sun_weights,
)
from seasonscapes.albedo.recovery_unknowns import CURVE, GAIN, HAZE, SKY, SUN, TURN, straightened
from seasonscapes.cameras.observation import Observation
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.errors import NotEnoughEvidence
from seasonscapes.images import linear_from_srgb, srgb_from_linear

Progress = Callable[[float], None]
_TRAINING = SolverOptions(rounds=3, iterations=6)
_LAST = SolverOptions(rounds=2, iterations=10)
# Rounds end when one lowers the cost by a smaller share.
_CONVERGED = 0.015
# Footprints of cameras that turned by less stay as they are.
_LEAST_TURN_PX = 0.1


@dataclass(frozen=True)
class FoundConditions:
    """What a recovery found besides the albedo.

    Parameters
    ----------
    visibility_km
        Of all photographs.
    curve_strength, curve_exponent
        ``(C,)`` response of each camera; see `recovery_unknowns.bent`.
    turn_deg
        ``(C, 3)`` rotation of each camera about its axes (right, down, forward).
    sun_share
        ``(K,)`` mean visible share of the sun over the land that each photograph shows.
    sky_scale
        ``(K, 3)`` scale of the skylight of each photograph.
    """

    visibility_km: float
    curve_strength: np.ndarray
    curve_exponent: np.ndarray
    turn_deg: np.ndarray
    sun_share: np.ndarray
    sky_scale: np.ndarray


@dataclass(frozen=True)
class JointRecovery:
    """Result of a joint recovery.

    Parameters
    ----------
    fit
        Albedo, gains and residuals; those of the closed form where ``accepted`` is False.
    photographs
        The photographs that the fit explains, in straight response, found light and corrected pose.
    conditions
        The other unknowns.
    accepted
        Whether the loss of the held-out photographs fell.
    held_out_start, held_out_end
        Robust loss per value of the held-out photographs under the closed form and under the recovery, neither of which
        saw them.
    history
        Robust cost per value at the beginning of each round.
    """

    fit: AlbedoFit
    photographs: list[AlbedoPhotograph]
    conditions: FoundConditions
    accepted: bool
    held_out_start: float
    held_out_end: float
    history: list[float]


def recover_jointly(
    transport: TexelTransport,
    photographs: Sequence[AlbedoPhotograph],
    start: AlbedoFit,
    *,
    haze: HazeLights | None = None,
    options: JointOptions | None = None,
    progress: Progress | None = None,
) -> JointRecovery:
    """Recover albedo, haze, exposures, responses, clouds before the sun and poses together.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    photographs
        K photographs, at least two; `painted_textures.painted_photograph` makes one of a painted texture. Poses turn
        within the ``pose_sigma`` of their observations.
    start
        Closed-form fit of these photographs; its noise model weights the residuals.
    haze
        Lights of the photographs at several visibilities; without, the haze stays as it is.
    options
        Rounds and priors.
    progress
        Called with the finished fraction.

    Returns
    -------
    JointRecovery
        Albedo and all other unknowns.

    Raises
    ------
    NotEnoughEvidence
        If there are fewer than two photographs.
    NoUsablePixels
        See `closed_form.solve_albedo`.
    """
    options, report = options or JointOptions(), progress or (lambda fraction: None)
    if len(photographs) < 2:
        raise NotEnoughEvidence("recover_jointly: at least two photographs are needed, one of them to judge")
    noise_model = start.noise_model
    if haze is None:
        haze = HazeLights((1.0,), [[photograph.light for photograph in photographs]], 1.0)
    problem = make_problem(transport, photographs, haze, noise_model, start.gains, options)
    training, held_out = _split(len(photographs), options)
    steps = options.rounds + options.last_rounds + 2
    naive = solve_albedo(transport, [photographs[k] for k in training], noise_model=noise_model, solver=_TRAINING)
    state = _started(problem, naive, training)
    before, _ = held_out_loss(problem, state, held_out)
    report(1 / steps)
    history: list[float] = []
    for number in range(options.rounds):
        state, cost = advance(problem, state, training)
        history.append(cost)
        report((number + 2) / steps)
        if number and cost > (1.0 - _CONVERGED) * history[-2]:
            break
    after, state = held_out_loss(problem, state, held_out)
    for number in range(options.last_rounds):
        state, cost = advance(problem, state, range(len(photographs)))
        history.append(cost)
        report((options.rounds + number + 2) / steps)
    conditions = _conditions(problem, state)
    if after >= before:
        report(1.0)
        return JointRecovery(start, list(photographs), conditions, False, before, after, history)
    corrected = corrected_photographs(problem, state)
    albedo = np.clip(state.albedo, LOWEST, HIGHEST).reshape(*transport.shape, 3)
    fit = solve_albedo(transport, corrected, noise_model=noise_model, solver=_LAST, start=albedo)
    report(1.0)
    return JointRecovery(fit, corrected, conditions, True, before, after, history)


def _split(count: int, options: JointOptions) -> tuple[list[int], list[int]]:
    order = np.random.default_rng(options.seed).permutation(count)
    held_out = int(np.clip(round(options.held_out * count), 1, count - 1))
    return sorted(map(int, order[held_out:])), sorted(map(int, order[:held_out]))


def _started(problem: RecoveryProblem, fit: AlbedoFit, training: Sequence[int]) -> RecoveryState:
    values = problem.start.copy()
    problem.layout.view(values, GAIN)[training] = np.log(fit.gains)
    return RecoveryState(np.log(fit.albedo.reshape(-1, 3)), values)


def _conditions(problem: RecoveryProblem, state: RecoveryState) -> FoundConditions:
    of = {name: problem.layout.view(state.values, name) for name in problem.layout.shapes}
    shares = [_sun_share(problem, state, k) for k in range(len(problem.pictures))]
    return FoundConditions(
        float(np.exp(of[HAZE][0])),
        of[CURVE][:, 0].copy(),
        np.exp(of[CURVE][:, 1]),
        np.degrees(of[TURN]),
        np.array([float(share.mean()) for share in shares]),
        np.exp(of[SKY])[[picture.instant for picture in problem.pictures]],
    )


def _sun_share(problem: RecoveryProblem, state: RecoveryState, number: int) -> np.ndarray:
    """Visible share of the sun ``(n,)`` in the pixels of a photograph; 1 without a sun."""
    picture = problem.pictures[number]
    if picture.sun_weights is None:
        return np.ones(len(picture.photograph.footprints.pixel), np.float32)
    nodes = problem.layout.view(state.values, SUN)[picture.instant]
    return (picture.sun_weights @ nodes).astype(np.float32)


def corrected_photographs(problem: RecoveryProblem, state: RecoveryState) -> list[AlbedoPhotograph]:
    """The photographs in straight response, known exposure, found light and corrected pose.

    Parameters
    ----------
    problem, state
        The recovery.
    """
    layout = problem.layout
    log_visibility = float(layout.view(state.values, HAZE)[0])
    result, on_land = [], {}
    for picture in problem.pictures:
        photograph, observation = picture.photograph, picture.photograph.observation
        light = problem.frame.haze.at(picture.number, log_visibility)
        # Photographs of one instant share sun and sky, so that the light on the land is computed once.
        if picture.instant not in on_land:
            scale = np.exp(layout.view(state.values, SKY)[picture.instant]).astype(np.float32)
            on_land[picture.instant] = ((light.sky_radiance * scale).astype(np.float32), light.sun, light.moon)
        sky, sun, moon = on_land[picture.instant]
        light = replace(light, sky_radiance=sky, sun=sun, moon=moon)
        image = observation.image
        if picture.levels:
            curve = layout.view(state.values, CURVE)[picture.camera]
            image = linear_from_srgb(straightened(srgb_from_linear(image), curve))
        gain = np.exp(layout.view(state.values, GAIN)[picture.number])
        observation = replace(observation, image=image, camera=_camera(problem, state, picture.number))
        result.append(replace(photograph, observation=observation, light=light, gain=gain))
    return _retraced(problem, state, result)


def _camera(problem: RecoveryProblem, state: RecoveryState, number: int):
    picture = problem.pictures[number]
    camera = picture.photograph.observation.camera
    turn = problem.layout.view(state.values, TURN)[picture.camera]
    if not isinstance(camera, Camera) or np.abs(turn).max() * camera.fx < _LEAST_TURN_PX:
        return camera
    return turned_camera(camera, turn)


def _retraced(
    problem: RecoveryProblem, state: RecoveryState, photographs: list[AlbedoPhotograph]
) -> list[AlbedoPhotograph]:
    """Footprints of turned cameras traced anew, and sunlight dimmed where clouds stood before the sun."""
    result, transport = list(photographs), problem.transport
    for camera in range(problem.layout.cameras):
        members = [picture.number for picture in problem.pictures if picture.camera == camera]
        new, old = (
            photographs[members[0]].observation.camera,
            problem.pictures[members[0]].photograph.observation.camera,
        )
        if new is not old:
            seen = [photographs[k].observation for k in members]
            traced = prepare_photographs(
                transport,
                [each for each in seen if isinstance(each, Observation)],
                [photographs[k].light for k in members],
                gains=[photographs[k].gain for k in members],
            )
            for k, photograph in zip(members, traced, strict=True):
                result[k] = photograph
    weights = sun_weights(transport, result, problem.pixel_count, problem.layout.grid)
    for camera in range(problem.layout.cameras):
        members = [picture.number for picture in problem.pictures if picture.camera == camera]
        footprints = result[members[0]].footprints
        entries, sunlit = np.diff(footprints.start), list(footprints.sunlit)
        for k in members:
            if problem.pictures[k].sun_weights is not None:
                nodes = problem.layout.view(state.values, SUN)[problem.pictures[k].instant]
                share = np.repeat((weights[id(footprints)] @ nodes).astype(np.float32), entries)
                sunlit[result[k].number] = [values * share for values in sunlit[result[k].number]]
        dimmed = replace(footprints, sunlit=sunlit)
        for k in members:
            result[k] = replace(result[k], footprints=dimmed)
    return result
