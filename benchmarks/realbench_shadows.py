"""Sunlit and shaded ground of realbench: the sun's visibility over the heights against polygons drawn by hand."""

from __future__ import annotations

import numpy as np
from realbench_cameras import FixedCase, polygons_mask

from seasonscapes.albedo.picture_conditions import ViewLight
from seasonscapes.workflows.unseen_hours import FixedView

# Ground whose pixels see the sun by more than half is sunlit.
_SUNLIT = 0.5


def shadow_figures(case: FixedCase, view: FixedView, lights: list[ViewLight]) -> dict[str, float]:
    """Intersection over union of shaded ground and of sunlit ground, over the drawn pixels of all pictures together.

    ``shadow_iou`` is the smaller of both.
    """
    together = {"shade": np.zeros(2), "sun": np.zeros(2)}
    size, pictures = (case.camera.height_px, case.camera.width_px), 0
    scale = case.camera.width_px / case.full_width_px
    for picture, light in zip(case.pictures, lights, strict=True):
        drawn = case.shadows.get(picture.name)
        if drawn is None:
            continue
        pictures += 1
        shade, sun = (polygons_mask(drawn[name], size, scale).reshape(-1)[view.pixel] for name in ("shade", "sun"))
        # A pixel in both polygons lies at the border, where the hand is not sure.
        judged = (shade ^ sun) & picture.usable.reshape(-1)[view.pixel]
        lit = (light.sun_visible > _SUNLIT) & (view.normal @ light.sun_direction > 0.0)
        for name, truth, found in (("shade", shade, ~lit), ("sun", sun, lit)):
            both, either = (truth & found & judged).sum(), ((truth | found) & judged).sum()
            together[name] += both, either
    iou = {f"{name}_iou": float(both / max(either, 1.0)) for name, (both, either) in together.items()}
    return {"shadow_iou": min(iou.values()), **iou, "shadow_pictures": pictures}
