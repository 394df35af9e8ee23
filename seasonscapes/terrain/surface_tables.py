"""Tables of a scene file about ground that is not Lambertian."""

from __future__ import annotations

from pydantic import Field, model_validator

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


class SnowTable(Declaration):
    """Snow, which lies where the albedo is bright and nearly white. Without this table it is matt as all other ground.

    Parameters
    ----------
    scattering
        Whether it scatters light as grains of ice do: forwards, and brighter under a low sun.
    grain_mm
        Optical diameter of the grains [mm], of clean snow whose albedo then takes the place of the texture's: 0.1 when it
        falls, 1 and more when it melts. Left out, the texture's albedo says how much it absorbs.
    """

    scattering: bool = True
    grain_mm: float | None = Field(default=None, ge=0.02, le=10.0)

    @model_validator(mode="after")
    def _scatters(self) -> SnowTable:
        if self.grain_mm is not None and not self.scattering:
            raise ValueError("'grain_mm' is of snow that scatters: drop it, or scattering = false")
        return self


class ForestTable(Declaration):
    """Forest, which lies where the albedo is dark and green. Without this table it is matt as all other ground.

    Parameters
    ----------
    hot_spot
        Whether it is brighter with the sun behind the viewer, where no shadow of a crown is seen, than towards the sun.
    """

    hot_spot: bool = True
