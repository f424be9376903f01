"""Inverse depth on both sheets of light at any pixel, interpolated between the nodes of a grid."""

from collections.abc import Hashable
from functools import lru_cache
from typing import Final, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera, Laser
from .camera import rays

Array = NDArray[np.float64]

# Cells along an image's width: interpolated depths are those of pixels a hundredth of a reduced image's pixel away.
_CELLS: Final = 40
# How many points cv2.remap takes at once.
_MOST: Final = 30_000


class OnSheets(NamedTuple):
    """What pixels see if they see a sheet, one array (N,) for each sheet.

    Attributes
    ----------
    inverse_depth : 1/Z, 1/m; not positive where ray and sheet do not meet before the camera.
    per_px : change, from one column to the next, of the logarithm of the distance along the ray.
    """

    inverse_depth: tuple[Array, Array]
    per_px: tuple[Array, Array]


@lru_cache(maxsize=4)
def _nodes(camera: Camera, light: Laser) -> tuple[float, NDArray[np.float32]]:
    """Side of a cell in pixels, and inverse depths and changes (rows, columns, 4) at the grid's nodes."""
    cell = max(camera.width / _CELLS, 8.0)
    columns, rows = (int(np.ceil(side / cell)) + 1 for side in (camera.width, camera.height))
    pixels = np.mgrid[:rows, :columns].reshape(2, -1)[::-1].T * cell
    (origin, direction), (_, beside) = rays(camera, pixels), rays(camera, pixels + np.array([0.1, 0.0]))
    values = []
    for sheet in light.sheets:
        normal = np.array(sheet.normal)
        toward, gap = direction @ normal, sheet.offset - origin @ normal
        inverse_depth = toward / (origin[:, 2] * toward + gap * direction[:, 2])
        values += [np.clip(inverse_depth, -100, 100), (toward / (beside @ normal) - 1) / 0.1]
    order = np.array(values)[[0, 2, 1, 3]].T.reshape(rows, columns, 4)
    return cell, np.ascontiguousarray(order, np.float32)


def on_sheets(camera: Camera, light: Laser, u: Array, v: Array) -> OnSheets:
    """What pixels (N,), (N,) see on either sheet."""
    cell, nodes = _nodes(cast(Hashable, camera), cast(Hashable, light))
    at = (np.stack([u, v]) / cell).astype(np.float32)[..., None]
    found = np.empty((len(u), 4), np.float32)
    for k in range(0, len(u), _MOST):
        part = slice(k, k + _MOST)
        found[part] = cv2.remap(
            nodes, at[0, part], at[1, part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ).reshape(-1, 4)
    first, second, of_first, of_second = found.T.astype(np.float64)
    return OnSheets((first, second), (of_first, of_second))
