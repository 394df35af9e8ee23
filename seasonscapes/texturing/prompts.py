"""Text prompts for an image model: season, light and cloudiness of a mountain landscape in words."""

from __future__ import annotations

from datetime import datetime

NEGATIVE = (
    "lowres, worst quality, low quality, blurry, cropped, frame, text, watermark, people, oversaturated, painting"
)
# Appearance of the northern Alps by month, from January.
_SEASONS = (
    "deep winter, snow down to the valleys",
    "late winter, snow down to the valleys",
    "early spring, snow on the slopes, brown meadows in the valley",
    "spring, green valleys, snow on high slopes",
    "late spring, fresh green meadows, snow on the summits",
    "early summer, green meadows, snow fields on the summits",
    "high summer, green alpine meadows, grey rock, glaciers",
    "late summer, green alpine meadows, grey rock, glaciers",
    "early autumn, yellowing meadows, grey rock",
    "autumn, golden larches, brown meadows, fresh snow on the summits",
    "late autumn, brown meadows, snow on the slopes",
    "early winter, snow on the slopes",
)
# Light by the least solar elevation [deg], increasing.
_LIGHTS = (
    (-90.0, "at night under the stars"),
    (-12.0, "in deep twilight"),
    (-6.0, "at dusk"),
    (-0.8, "at sunrise, long shadows"),
    (6.0, "in low warm sunlight, long shadows"),
    (20.0, "in bright daylight"),
)


def prompt_for(time: datetime, latitude_deg: float, sun_elevation_deg: float, *, cloudiness: float = 0.0) -> str:
    """Return a prompt for a landscape at one instant.

    Parameters
    ----------
    time
        Its month selects the season.
    latitude_deg
        Latitude [deg]; south of the equator the seasons are shifted by half a year.
    sun_elevation_deg
        Solar elevation [deg]; selects the light.
    cloudiness
        In [0, 1].

    Returns
    -------
    str
        One English sentence.
    """
    month = time.month if latitude_deg >= 0.0 else (time.month + 5) % 12 + 1
    light = next(words for low, words in reversed(_LIGHTS) if sun_elevation_deg >= low)
    sky = "on a clear day" if cloudiness < 0.2 else "with some clouds" if cloudiness < 0.7 else "under an overcast sky"
    return (
        f"photograph of a landscape of high mountains in {_SEASONS[month - 1]}, {light}, {sky}, "
        "natural colours, fine detail"
    )
