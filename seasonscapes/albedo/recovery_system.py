"""Linear least squares over texels and unknowns of light and camera together: conjugate gradients, preconditioned.

The preconditioner eliminates the albedo from the unknowns of light and camera (variable projection, Golub & Pereyra 1973,
doi:10.1137/0710036), with the albedo's normal matrix replaced by the diagonal of its row sums. All its entries are
positive, so that this diagonal exceeds it (the difference is diagonally dominant): the Schur complement stays positive,
and it is exact for changes of albedo that are smooth, which are the ones that exposure, haze and response imitate.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from seasonscapes.albedo.closed_form import grid_laplacian


@dataclass
class RecoveryBlock:
    """Weighted linear equations of one photograph with n pixels, one set for each channel.

    Parameters
    ----------
    albedo
        For each channel the sparse ``(n, R·S)`` derivative of pixel values to log albedo, not negative.
    columns
        ``(3, L)`` numbers of the dense unknowns of each channel.
    dense
        ``(3, n, L)`` derivatives to these.
    sun_weights
        Sparse ``(n, G²)`` weights of the nodes of the sun's grid in each pixel; ``None`` without sun.
    sun_slope
        ``(3, n)`` derivative to the sun's visible share.
    sun_columns
        First number of the instant's grid.
    residual
        ``(3, n)``.
    evidence
        Further equations of the dense unknowns alone, one for each channel: derivatives ``(3, L)`` and residuals ``(3,)``.
    """

    albedo: list[Any]
    columns: np.ndarray
    dense: np.ndarray
    sun_weights: Any
    sun_slope: np.ndarray
    sun_columns: int
    residual: np.ndarray
    evidence: tuple[np.ndarray, np.ndarray] | None = None


@dataclass
class RecoverySystem:
    """Equations of all photographs, and the priors.

    Parameters
    ----------
    blocks
        Of each photograph.
    shape
        Rows and columns R, S of the texture.
    dense_size, sun_size
        Numbers of dense unknowns, and of nodes of one instant's grid.
    precision, pull
        ``(P,)`` inverse variance of each unknown, and its product with the distance of the prior's mean.
    sun_coupling
        For each instant the ``(G², G²)`` precision of steps between neighbouring nodes.
    smoothness
        Weight of the Laplacian of log albedo, relative to the median of the normal matrix's diagonal.
    log_albedo
        ``(R·S, 3)``, whose Laplacian is small.
    """

    blocks: list[RecoveryBlock]
    shape: tuple[int, int]
    dense_size: int
    sun_size: int
    precision: np.ndarray
    pull: np.ndarray
    sun_coupling: list[np.ndarray]
    smoothness: float
    log_albedo: np.ndarray
    _lumped: np.ndarray = field(init=False)
    _smooth: np.ndarray = field(init=False)

    def __post_init__(self):
        size = self.shape[0] * self.shape[1]
        lumped = np.zeros((size, 3), np.float32)
        ones = np.ones(size, np.float32)
        for block in self.blocks:
            for c, matrix in enumerate(block.albedo):
                lumped[:, c] += matrix.T @ (matrix @ ones)
        typical = np.array([np.median(d[d > 0.0]) if (d > 0.0).any() else 1.0 for d in lumped.T], np.float32)
        self._smooth = self.smoothness * typical
        self._shown = np.flatnonzero(lumped.any(axis=1))
        self._lumped = lumped + 4.0 * self._smooth + 1e-6 * typical
        self._tiny = 1e-6 * typical

    def solve(self, iterations: int) -> tuple[np.ndarray, np.ndarray]:
        """Changes of log albedo ``(R·S, 3)`` and of the other unknowns ``(P,)`` that minimise the weighted squares."""
        target = self._adjoint([block.residual for block in self.blocks])
        target[0][:] -= self._smooth * grid_laplacian(self.log_albedo, self.shape)
        target[1][:] += self.pull
        self._evidence = np.zeros((self.dense_size, self.dense_size))
        for block in self.blocks:
            if block.evidence is not None:
                for columns, slope, value in zip(block.columns, *block.evidence, strict=True):
                    self._evidence[np.ix_(columns, columns)] += np.outer(slope, slope)
                    target[1][columns] += slope * value
        precondition = self._preconditioner()
        x = (np.zeros_like(target[0]), np.zeros_like(target[1]))
        residual = target
        z = precondition(residual)
        direction = z
        rho = first = _dot(residual, z)
        for _ in range(iterations):
            if rho <= 1e-6 * first:
                break
            curved = self._normal(direction)
            step = rho / max(_dot(direction, curved), 1e-30)
            x = _sum(x, step, direction)
            residual = _sum(residual, -step, curved)
            z = precondition(residual)
            rho, last = _dot(residual, z), rho
            direction = _sum(z, rho / last, direction)
        return x

    def _normal(self, x: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        albedo, other = x
        total = self._adjoint([self._forward(block, albedo, other) for block in self.blocks])
        total[0][:] += self._smooth * grid_laplacian(albedo, self.shape) + self._tiny * albedo
        total[1][:] += self.precision * other
        total[1][: self.dense_size] += self._evidence @ other[: self.dense_size]
        for instant, coupling in enumerate(self.sun_coupling):
            nodes = self._nodes(instant)
            total[1][nodes] += coupling @ other[nodes]
        return total

    def _nodes(self, instant: int) -> slice:
        first = self.dense_size + instant * self.sun_size
        return slice(first, first + self.sun_size)

    def _forward(self, block: RecoveryBlock, albedo: np.ndarray, other: np.ndarray) -> np.ndarray:
        result = np.stack([matrix @ albedo[:, c] for c, matrix in enumerate(block.albedo)])
        result += np.einsum("cnl,cl->cn", block.dense, other[block.columns].astype(np.float32))
        if block.sun_weights is not None:
            nodes = other[block.sun_columns : block.sun_columns + self.sun_size].astype(np.float32)
            result += block.sun_slope * (block.sun_weights @ nodes)
        return result

    def _adjoint(self, values: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        albedo = np.zeros((self.shape[0] * self.shape[1], 3), np.float32)
        other = np.zeros(len(self.precision))
        for block, value in zip(self.blocks, values, strict=True):
            for c, matrix in enumerate(block.albedo):
                albedo[:, c] += matrix.T @ value[c]
                np.add.at(other, block.columns[c], block.dense[c].T @ value[c])
            if block.sun_weights is not None:
                nodes = slice(block.sun_columns, block.sun_columns + self.sun_size)
                other[nodes] += block.sun_weights.T @ (block.sun_slope * value).sum(axis=0)
        return albedo, other

    def _preconditioner(self):
        count = self.dense_size
        # Texels that no pixel shows do not mix with anything.
        shown = self._shown
        lumped = self._lumped[shown]
        mixed = np.zeros((3, len(shown), count), np.float32)
        schur = np.diag(self.precision[:count]) + self._evidence
        sun = [coupling + np.diag(self.precision[self._nodes(t)]) for t, coupling in enumerate(self.sun_coupling)]
        for block in self.blocks:
            for c, matrix in enumerate(block.albedo):
                columns = block.columns[c]
                mixed[c][:, columns] += (matrix.T @ block.dense[c])[shown]
                schur[np.ix_(columns, columns)] += block.dense[c].T.astype(float) @ block.dense[c]
            if block.sun_weights is not None:
                instant = (block.sun_columns - count) // self.sun_size
                scaled = block.sun_weights.multiply((block.sun_slope**2).sum(axis=0)[:, None])
                sun[instant] += (block.sun_weights.T @ scaled).toarray()
        direct = schur.copy()
        for c in range(3):
            schur -= mixed[c].T @ (mixed[c] / lumped[:, c, None])
        # Rounding of sums over thousands of texels must not make it indefinite.
        schur_factor = cho_factor(schur + 1e-5 * np.diag(np.diag(direct)))
        sun_factors = [cho_factor(matrix) for matrix in sun]

        def apply(r: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
            scaled = r[0] / self._lumped
            reduced = r[1][:count] - sum(mixed[c].T @ scaled[shown, c] for c in range(3))
            other = np.empty_like(r[1])
            other[:count] = cho_solve(schur_factor, reduced)
            back = np.stack([mixed[c] @ other[:count].astype(np.float32) for c in range(3)], axis=1)
            scaled[shown] -= back / lumped
            for instant, factor in enumerate(sun_factors):
                nodes = self._nodes(instant)
                other[nodes] = cho_solve(factor, r[1][nodes])
            return scaled, other

        return apply


def scaled_rows(pattern: csr_array, values: np.ndarray, row_scale: np.ndarray) -> csr_array:
    """A sparse matrix of a pattern with entries ``values``, each row multiplied by ``row_scale``."""
    entries = values * np.repeat(row_scale, np.diff(pattern.indptr))
    return csr_array((entries.astype(np.float32), pattern.indices, pattern.indptr), shape=pattern.shape, copy=False)


def _dot(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> float:
    first = np.einsum("nc,nc->", a[0], b[0], dtype=np.float64)
    return float(first + a[1] @ b[1])


def _sum(
    a: tuple[np.ndarray, np.ndarray], scale: float, b: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    return a[0] + np.float32(scale) * b[0], a[1] + scale * b[1]
