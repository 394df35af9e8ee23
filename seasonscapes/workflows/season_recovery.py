"""Albedos of several seasons from the photographs of many days: days are grouped by what they show, each group gives one."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from seasonscapes.cameras.pinhole import view_in_frame
from seasonscapes.errors import NotEnoughEvidence, NoUsablePixels
from seasonscapes.progress import Progress, each_reported
from seasonscapes.sky.models import SkyModel
from seasonscapes.workflows.albedo_recovery import (
    RecoveredAlbedo,
    RecoveryOptions,
    photographs_of_ground,
    recovered_over,
    texel_transport,
)
from seasonscapes.workflows.illumination import sky_model
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.recovery_methods import PaintedTexture, closed_fit

if TYPE_CHECKING:
    from seasonscapes.albedo.forward_model import TexelTransport
    from seasonscapes.albedo.standard_error import AlbedoEstimate
    from seasonscapes.cameras.observation import Observation

log = logging.getLogger(__name__)

# Within the year; snow and leaves change little in between.
_NEAR_DAYS = 21.0


@dataclass(frozen=True)
class SeasonAlbedo:
    """The albedo of one season.

    Parameters
    ----------
    recovered
        The albedo, dated by the first of its days.
    days
        UTC dates whose photographs it comes from.
    """

    recovered: RecoveredAlbedo
    days: tuple[date, ...]

    @property
    def record(self) -> dict[str, Any]:
        """Plain values: its date, its days, and the instants of its photographs."""
        times = sorted({each.observation.time for each in self.recovered.photographs})
        return {
            "day": self.recovered.day.isoformat(),
            "days": [day.isoformat() for day in self.days],
            "times_utc": [time.isoformat() for time in times],
        }


def recover_seasons(
    place: Place,
    photographs: Sequence[Observation],
    *,
    sky: str | Path | SkyModel = "clear",
    options: RecoveryOptions | None = None,
    painted: Sequence[PaintedTexture] = (),
    groups: Sequence[Sequence[date]] | None = None,
    progress: Progress | None = None,
) -> list[SeasonAlbedo]:
    """Recover one albedo for each season that photographs of many days show.

    Parameters
    ----------
    place
        The place.
    photographs
        Of any days; see `recover_albedo`.
    sky
        The sky model of all photographs; clouds are added where a photograph's own sky shows them.
    options
        The method, and what to fit besides the albedo, of each group.
    painted
        Painted textures of some of the hours, as further observations of their days.
    groups
        UTC dates of each season, where they are known; by default days are grouped by the snow and colours that they show.
    progress
        Called with a task and its finished share.

    Returns
    -------
    list of SeasonAlbedo
        In the order of their dates.

    Raises
    ------
    NoTerrainInView
        Where no photograph shows any of the terrain.
    NotEnoughEvidence
        Where the photographs of a season determine no texel.

    Notes
    -----
    Each day's photographs alone give an albedo (a day for which they do not joins one within three weeks, or is left out);
    days that are neighbours in the year and agree in it are one season
    (`albedo.season_grouping.group_dates`), whose photographs together give the final one.
    """
    options, model = options or RecoveryOptions(), sky_model(sky)
    in_frame = [replace(each, camera=view_in_frame(each.camera, place.frame)) for each in photographs]
    transport = texel_transport(place, progress)
    if groups is None:
        groups = _grouped_days(place, transport, in_frame, model, progress)
    found = []
    for days in groups:
        chosen = [each for each in in_frame if each.time.date() in days]
        own = [each for each in painted if each.time.date() in days]
        recovered = recovered_over(place, transport, chosen, model, options, own, progress)
        found.append(SeasonAlbedo(recovered, tuple(sorted(days))))
    return sorted(found, key=lambda each: each.recovered.day)


def _grouped_days(
    place: Place, transport: TexelTransport, photographs: list[Observation], model: SkyModel, progress: Progress | None
) -> list[list[date]]:
    """UTC dates of the photographs by season; days that lie within one season by the albedo that each gives alone."""
    from seasonscapes.albedo.natural_colours import with_assumed_colours
    from seasonscapes.albedo.season_grouping import group_dates
    from seasonscapes.albedo.seasons import days_apart
    from seasonscapes.albedo.standard_error import albedo_estimate

    days = sorted({each.time.date() for each in photographs})
    if len(days) < 2:
        return [days]
    # Prepared together, since photographs of one camera share their footprints.
    prepared = photographs_of_ground(place, transport, photographs, model, progress)[0]
    known: list[date] = []
    estimates: list[AlbedoEstimate] = []
    scale_sigma: list[float] = []
    doubts: dict[date, str] = {}
    for day in each_reported(days, len(days), progress, "albedo of each day"):
        # Alone a day without sky has nothing but its cameras' own exposure, whatever the others show.
        own = with_assumed_colours(transport, [each for each in prepared if each.observation.time.date() == day])
        if not own:
            doubts[day] = "it shows no ground"
            continue
        try:
            estimates.append(albedo_estimate(transport, own, closed_fit(transport, own)))
        except (NotEnoughEvidence, NoUsablePixels) as error:
            doubts[day] = str(error)
        else:
            known.append(day)
            scale_sigma.append(max(each.gain_sigma for each in own))
    # Where no day stands alone, all may stand together.
    groups = [[known[index] for index in group] for group in group_dates(known, estimates, scale_sigma)] or [days]
    for day in doubts if known else ():
        nearest = min(known, key=lambda each: days_apart(day, each))
        if days_apart(day, nearest) <= _NEAR_DAYS:
            next(group for group in groups if nearest in group).append(day)
            log.warning("%s alone gives no albedo (%s): it joins the season of %s", day, doubts[day], nearest)
        else:
            log.warning("%s is left out of the albedo: alone it gives none (%s), and no day is near", day, doubts[day])
    log.info("seasons: %s", "; ".join(", ".join(map(str, sorted(group))) for group in groups))
    return groups


def group_of(seasons: Sequence[dict[str, Any]], time: datetime) -> int:
    """Which of the recorded seasons an instant belongs to: the one that has a photograph nearest to it in time."""

    def apart(season: dict[str, Any]) -> float:
        return min(abs((datetime.fromisoformat(each) - time).total_seconds()) for each in season["times_utc"])

    return min(range(len(seasons)), key=lambda number: apart(seasons[number]))
