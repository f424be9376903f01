"""The six unknowns of a motion between two images, estimated from residuals of which some are wrong.

Levenberg & Marquardt on squares that Huber's weights make robust. Residuals after several steps are had at one go, so
that derivatives cost little: for so few unknowns this takes a third of the time of scipy's `least_squares`.
"""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

HUBER: Final = 2.0  # sigmas from which on a residual counts less
_UNKNOWNS = 6
_SMALL_STEP = 1e-7  # of rotation and translation, for derivatives
_ENOUGH = 1e-4  # relative decrease of the squares that ends the search: a small part of a sigma
_FIRST_DAMPING, _MOST_STEPS = 1e-4, 25


class Minimum(NamedTuple):
    """Where a robust sum of squares is least: a step (6,), residuals (rows,) there, their derivatives (rows, 6)."""

    step: Array
    residual: Array
    jacobian: Array


def minimise(at: Callable[[Array], Array]) -> Minimum:
    """Where Huber's sum over the residuals is least, near no step at all.

    at(steps) gives residuals (K, rows) in sigmas after each of K steps (K, 6).
    """
    probes = np.concatenate([np.zeros((1, _UNKNOWNS)), _SMALL_STEP * np.eye(_UNKNOWNS)])

    def there(step: Array) -> Minimum:
        found = at(step + probes)
        return Minimum(step, found[0], (found[1:] - found[0]).T / _SMALL_STEP)

    best, damping = there(np.zeros(_UNKNOWNS)), _FIRST_DAMPING
    error = _sum(best.residual)
    for _ in range(_MOST_STEPS):
        weighted = best.jacobian * _weight(best.residual)[:, None]
        normal = weighted.T @ best.jacobian
        normal += damping * np.diag(np.diag(normal)) + 1e-12 * np.eye(_UNKNOWNS)
        trial = there(best.step - np.linalg.solve(normal, weighted.T @ best.residual))
        now = _sum(trial.residual)
        if not now < error:
            damping *= 10
            continue
        best, error, gain, damping = trial, now, error - now, damping / 10
        if gain < _ENOUGH * error:
            break
    return best


def _weight(residual: Array) -> Array:
    return 1 / np.maximum(np.abs(residual) / HUBER, 1)


def _sum(residual: Array) -> float:
    size = np.abs(residual)
    return float(np.where(size < HUBER, size**2, 2 * HUBER * size - HUBER**2).sum())
