"""Least squares with shared parameters and a few parameters of each image, as every calibration here has them.

The unknowns are [shared | images x per image]. Every residual depends on the shared ones and on those of at most two
images; that is what makes the Jacobian cheap: images that no residual joins are stepped at the same time.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_STEP = 1e-3  # of each parameter's scale, for differences


class Layout(NamedTuple):
    """Which unknowns there are.

    Attributes
    ----------
    shared, images, per_image : how many.
    scale : (shared + images * per_image,) the size of a change that matters, in the parameter's own unit.
    """

    shared: int
    images: int
    per_image: int
    scale: Array

    def split(self, x: Array) -> tuple[Array, Array]:
        """Shared (shared,) and images' (images, per_image) unknowns."""
        return x[: self.shared], x[self.shared :].reshape(self.images, self.per_image)


class Solved(NamedTuple):
    """A solution.

    Attributes
    ----------
    x : unknowns. covariance : of all of them, for residuals of unit variance.
    residual : (M,) in sigmas. jacobian : (M, unknowns).
    """

    x: Array
    covariance: Array
    residual: Array
    jacobian: Array


def colours(count: int, rows: Indices) -> Indices:
    """A number (count,) for each image such that no two images of a row (M, 2) have the same; -1 is no image."""
    neighbours: list[set[int]] = [set() for _ in range(count)]
    pairs = np.unique(rows[(rows >= 0).all(1)], axis=0) if len(rows) else np.zeros((0, 2), int)
    for i, j in pairs.tolist():
        if i != j:
            neighbours[i].add(j)
            neighbours[j].add(i)
    colour = np.full(count, -1, np.intp)
    for i in range(count):
        taken = {int(colour[j]) for j in neighbours[i]}
        colour[i] = next(c for c in range(count + 1) if c not in taken)
    return colour


def jacobian(residuals: Callable[[Array], Array], x: Array, layout: Layout, rows: Indices) -> Array:
    """Central differences (M, unknowns) of residuals whose images are rows (M, 2), -1 for none."""
    J = np.zeros((len(rows), len(x)))

    def difference(chosen: Indices) -> Array:
        step = np.zeros(len(x))
        step[chosen] = _STEP * layout.scale[chosen]
        return 0.5 * (residuals(x + step) - residuals(x - step))

    for k in range(layout.shared):
        J[:, k] = difference(np.array([k])) / (_STEP * layout.scale[k])
    if not layout.images:
        return J
    colour = colours(layout.images, rows)
    of_row = np.where(rows >= 0, colour[rows], -1)
    number = np.arange(len(rows))
    for c in range(int(colour.max(initial=-1)) + 1):
        own = np.flatnonzero(colour == c)
        for k in range(layout.per_image):
            change = difference(layout.shared + own * layout.per_image + k)
            for side in (0, 1):
                affected = number[of_row[:, side] == c]
                column = layout.shared + rows[affected, side] * layout.per_image + k
                J[affected, column] = change[affected] / (_STEP * layout.scale[column])
    return J


def solve(residuals: Callable[[Array], Array], start: Array, layout: Layout, rows: Indices) -> Solved:
    """Minimise the sum of squared residuals (scipy, trust region).

    Parameters
    ----------
    residuals : of the unknowns, (M,) in sigmas, the priors among them.
    start, layout : unknowns to begin with and what they are.
    rows : (M, 2) images that each residual depends on, -1 for none.
    """
    found = least_squares(
        residuals,
        start,
        jac=lambda x: jacobian(residuals, x, layout, rows),  # pyright: ignore[reportArgumentType]
        x_scale=layout.scale,
        max_nfev=20,
        xtol=1e-8,
        ftol=1e-7,
        gtol=1e-12,
    )
    J = np.asarray(found.jac)
    scaled = J * layout.scale
    covariance = np.linalg.pinv(scaled.T @ scaled, hermitian=True) * np.outer(layout.scale, layout.scale)
    return Solved(found.x, covariance, np.asarray(found.fun), J)


def unit_sigma(solved: Solved, chosen: NDArray) -> float:
    """What the residuals of a group of measurements say of its sigma: 1 where it was stated rightly (Förstner).

    The squared residuals are divided by the group's share in the redundancy, so parameters that a group mostly
    determines itself do not flatter it.
    """
    if not np.any(chosen):
        return 1.0
    J, v = solved.jacobian[chosen], solved.residual[chosen]
    redundancy = len(v) - float(np.einsum("ij,jk,ik->", J, solved.covariance, J, optimize=True))
    return float(np.sqrt((v**2).sum() / max(redundancy, 0.05 * len(v), 1.0)))
