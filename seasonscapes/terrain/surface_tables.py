"""Tables of a scene file about ground that is not Lambertian."""

from __future__ import annotations

from pydantic import Field

from seasonscapes.declaration import Declaration


class WaterTable(Declaration):
    """Open water, which mirrors sky and mountains. Without this table, water is matt as all other ground.

    Parameters
    ----------
    file
        Where it lies: polygons in GeoJSON (WGS 84), or a raster whose values above 0.5 are water. Left out: the lake of a
        synthetic terrain; else flat, level ground that is dark and not green in the scene's first image.
    wind_m_s
        Wind over it [m/s], which makes its waves; 0 is a mirror.
    least_area_m2
        Smallest lake that is looked for [m²].
    """

    file: str | None = None
    wind_m_s: float = Field(default=1.0, ge=0.0, le=20.0)
    least_area_m2: float = Field(default=20_000.0, gt=0.0, le=1e12)

    @property
    def paths(self) -> tuple[str, ...]:
        """Its file, if it has one."""
        return () if self.file is None else (self.file,)
