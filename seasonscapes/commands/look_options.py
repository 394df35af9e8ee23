"""Flags that say how radiance becomes a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_choice

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class LookOptions:
    """How radiance becomes a picture; an .exr stays as it is."""

    exposure: str = "auto"
    """auto (a camera), eye (an adapted observer), or an exposure value EV100 (15 is a sunny day)."""
    look: str = "photo"
    """photo (contrast and white balance of a camera) or neutral (linear up to a shoulder)."""
    white_balance: str = "sun"
    """Of --look photo: sun (its colour at that hour), daylight (5500 K) or none."""

    def metering(self) -> str | float:
        """The exposure; `InputError` for flags that are not valid."""
        from seasonscapes.exposure import LOOKS, parse_exposure
        from seasonscapes.workflows.pictures import balance_rgb

        check_choice("--look", self.look, LOOKS)
        balance_rgb(self.white_balance)
        return parse_exposure(self.exposure)

    def ev100(self, radiance: np.ndarray) -> float:
        """The exposure value of an image [EV100]."""
        from seasonscapes.exposure import exposure_ev100

        return exposure_ev100(radiance, self.metering(), look=self.look)

    def develop(self, radiance: np.ndarray, ev100: float, white_rgb: Sequence[float] | None) -> np.ndarray:
        """The display-linear picture ``(H, W, 3)`` of an image ``(H, W, 3)`` [cd/m²] at the exposure of `ev100`."""
        from seasonscapes.exposure import develop
        from seasonscapes.workflows.pictures import balance_rgb

        white, eye = balance_rgb(self.white_balance, white_rgb), self.metering() == "eye"
        return develop(radiance, ev100, eye=eye, look=self.look, white=white)
