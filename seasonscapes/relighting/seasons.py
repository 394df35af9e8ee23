"""Which of several dated albedos clothe a day: the nearest one, or a blend of the two around it."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date

SEASONS = ("blended", "nearest")
# A tropical year [days]; dates are compared by their place within it, whatever the year of the photograph.
_YEAR = 365.2422


def _turn(day: date) -> float:
    """Days since the first of January."""
    return float(day.timetuple().tm_yday - 1)


def season_weights(dates: Sequence[date], day: date, *, season: str = "blended") -> list[tuple[int, float]]:
    """Which dated albedos to use on a day, and how much of each.

    Parameters
    ----------
    dates
        Of the albedos, in any order and of any years: the year is a circle.
    day
        The date to clothe.
    season
        ``nearest``, or ``blended``: in proportion to how near the neighbours before and after are.

    Returns
    -------
    list of (index, weight)
        One or two of them; weights have sum 1.

    Raises
    ------
    ValueError
        Without any date, or for an unknown season.
    """
    if not dates:
        raise ValueError("season_weights: no dated albedo")
    if season not in SEASONS:
        raise ValueError(f"season: got {season!r}, expected one of {', '.join(SEASONS)}")
    after = [(_turn(each) - _turn(day)) % _YEAR for each in dates]
    following = min(range(len(dates)), key=lambda i: after[i])
    before = [(_turn(day) - _turn(each)) % _YEAR for each in dates]
    preceding = min(range(len(dates)), key=lambda i: before[i])
    if season == "nearest":
        return [(following if after[following] <= before[preceding] else preceding, 1.0)]
    span = after[following] + before[preceding]
    if following == preceding or span == 0.0:
        return [(following, 1.0)]
    share = before[preceding] / span
    pairs = [(preceding, 1.0 - share), (following, share)]
    return [(index, weight) for index, weight in pairs if weight > 0.0]
