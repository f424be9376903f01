"""Boards that are not flat: one smooth surface z(x, y), the same in every photograph.

A plate that sags or was rolled bends in the same way in each picture, so its shape can be told from the pose, the lens
and the sheets of light, which all change from picture to picture or stay with the camera.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Bends and S-bends along both sides and across; no offset or tilt, since these belong to the pose.
_POWERS: Final = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
TERMS: Final = len(_POWERS)
_STEPS: Final = 6


class Shape(NamedTuple):
    """A surface in the board's frame.

    Attributes
    ----------
    centre : (2,) of x and y, metres. size_m : by which x and y are divided.
    terms : (7,) metres, of x2, xy, y2, x3, x2y, xy2, y3; empty for a flat board.
    """

    centre: Array
    size_m: float
    terms: Array


FLAT: Final = Shape(np.zeros(2), 1.0, np.zeros(0))


def around(xy: Array) -> Shape:
    """A flat shape that can bend, scaled to where things were seen on the board: xy (N, 2), metres."""
    low, high = np.percentile(xy, [1, 99], axis=0)
    return Shape(0.5 * (low + high), 0.5 * float((high - low).max()), np.zeros(TERMS))


def heights(shape: Shape, xy: Array) -> Array:
    """Height (N,) of the surface, metres, at xy (N, 2) of the board's frame."""
    if not len(shape.terms):
        return np.zeros(len(xy))
    x, y = (np.asarray(xy, float) - shape.centre).T / shape.size_m
    return np.stack([x**i * y**j for i, j in _POWERS], axis=1) @ shape.terms


def meet(shape: Shape, origin: Array, direction: Array) -> Array:
    """Points (N, 3) where rays, origins (N, 3) and directions (N, 3) in the board's frame, meet the surface."""
    along = direction / direction[:, 2:]
    X = origin - origin[:, 2:] * along
    for _ in range(_STEPS if len(shape.terms) else 0):
        # the surface is nearly level, so going on to its height where the ray is converges at once
        X = X + (heights(shape, X[:, :2]) - X[:, 2])[:, None] * along
    return X
