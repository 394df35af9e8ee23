"""Where positions of the local frame lie in a map-projected grid, on the Dr.Jit device."""

from __future__ import annotations

from typing import Any

import numpy as np

from seasonscapes.frames import MEAN_RADIUS_M
from seasonscapes.terrain.surface import polynomial_degree


class GridPlacement:
    """The polynomials of `terrain.surface.monomials` from positions to texture coordinates of a grid.

    Parameters
    ----------
    to_node
        ``(2, T)`` polynomials for column and row; integers at the nodes.
    domain
        East and north of their centre, and their radius [m].
    shape
        Rows and columns of the grid.
    rim_nodes
        Width of the rim along which the grid fades out, in nodes.
    """

    def __init__(
        self, to_node: np.ndarray, domain: tuple[float, float, float], shape: tuple[int, int], rim_nodes: float
    ) -> None:
        import drjit as dr
        import mitsuba as mi

        rows, columns = shape
        scaled = (to_node + np.eye(1, to_node.shape[1]) * 0.5) / np.array([[columns], [rows]])
        self._degree = polynomial_degree(to_node)
        self._mi_terms = [[dr.opaque(mi.Float, float(value)) for value in terms] for terms in scaled]
        self._mi_domain = [dr.opaque(mi.Float, value) for value in (*domain[:2], 1.0 / domain[2])]
        # Distances from the rim in texture coordinates, scaled to 1 where the grid counts fully.
        self._mi_rim = [
            dr.opaque(mi.Float, float(value)) for value in (columns / rim_nodes, rows / rim_nodes, 0.5 / rim_nodes)
        ]

    def uv(self, mi_position: Any) -> Any:
        """Texture coordinates ``mi.Point2f`` of positions, row 0 at 0."""
        import mitsuba as mi

        shrink = MEAN_RADIUS_M / (MEAN_RADIUS_M + mi_position.z)
        east = (mi_position.x * shrink - self._mi_domain[0]) * self._mi_domain[2]
        north = (mi_position.y * shrink - self._mi_domain[1]) * self._mi_domain[2]
        return mi.Point2f(*(self._polynomial(terms, east, north) for terms in self._mi_terms))

    def share(self, uv: Any) -> Any:
        """``mi.Float``: 1 within the grid, 0 at its rim and outside; see `SurfaceGrid.share_at`."""
        import drjit as dr

        across, down, half = self._mi_rim
        inside = dr.minimum(dr.minimum(uv.x, 1.0 - uv.x) * across - half, dr.minimum(uv.y, 1.0 - uv.y) * down - half)
        return dr.clip(inside, 0.0, 1.0)

    def _polynomial(self, terms: list[Any], east: Any, north: Any) -> Any:
        """Horner's scheme in north within one in east; terms in the order of `terrain.surface.exponents`."""
        import drjit as dr

        rest, total = list(terms), 0.0
        for count in range(1, self._degree + 2):
            inner = 0.0
            for term in reversed(rest[-count:]):
                inner = dr.fma(inner, north, term)
            del rest[-count:]
            total = dr.fma(total, east, inner)
        return total
