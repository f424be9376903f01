"""What the calibration's covariance means for soundings: an error that all soundings of a mission have in common.

It does not average down, neither in a cell nor over frames, so it is kept apart from the noise of detection and added
to it at the very end.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import DISTORTION, Camera, CovarianceBlock, Laser, LaserPlane
from .camera import rays

Array = NDArray[np.float64]

_NODES: Final = (25, 33)  # rows and columns over the image
_STEP: Final = {"fx": 0.1, "fy": 0.1, "cx": 0.1, "cy": 0.1}
_SMALL: Final = 1e-6


class CommonError(NamedTuple):
    """1-sigma (2, rows, columns) of the inverse distance along a ray, 1/m, by sheet, on nodes over the image.

    The inverse is smooth over the whole image, also where ray and sheet are nearly parallel. `spacing` (2,) is the
    distance of the nodes along u and v, pixels.
    """

    sigma: Array
    spacing: Array


def common_error(camera: Camera, light: Laser, blocks: Sequence[CovarianceBlock]) -> CommonError | None:
    """First-order propagation of the covariance of camera and sheets; None where nothing is said of them.

    Parameters of the mount are passed over: they turn the map, and do not change a range.

    Parameters
    ----------
    blocks : of calibration.yaml; parameters of different blocks are taken as independent.
    """
    rows, columns = _NODES
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows))
    uv = np.column_stack([u.ravel(), v.ravel()])
    variance, known = np.zeros((2, len(uv))), False
    for block in blocks:
        chosen = [k for k, name in enumerate(block.parameters) if name.startswith(("camera.", "laser.planes."))]
        if not chosen:
            continue
        covariance = np.array(block.matrix)[np.ix_(chosen, chosen)]
        J = np.stack([_change(camera, light, block.parameters[k], uv) for k in chosen], axis=2)
        known |= bool(J.any())
        variance += np.einsum("sni,ij,snj->sn", J, covariance, J)
    if not known:
        return None
    spacing = np.array([u[0, 1] - u[0, 0], v[1, 0] - v[0, 0]])
    return CommonError(np.sqrt(np.maximum(variance, 0)).reshape(2, rows, columns), spacing)


def common_sigma(error: CommonError, uv: Array, arm: NDArray, distance_m: Array) -> Array:
    """1-sigma (N,) along the ray, metres, of soundings at pixels uv (N, 2), `distance_m` (N,) from the camera."""
    rows, columns = error.sigma.shape[1:]
    x, y = np.clip(np.asarray(uv, float) / error.spacing, 0, [columns - 1.001, rows - 1.001]).T
    i, j = y.astype(int), x.astype(int)
    f, g, s = y - i, x - j, np.asarray(arm).astype(int)
    top = (1 - g) * error.sigma[s, i, j] + g * error.sigma[s, i, j + 1]
    bottom = (1 - g) * error.sigma[s, i + 1, j] + g * error.sigma[s, i + 1, j + 1]
    return ((1 - f) * top + f * bottom) * np.asarray(distance_m) ** 2


def _change(camera: Camera, light: Laser, name: str, uv: Array) -> Array:
    """Change (2, N) of the inverse distances by one unit of a parameter."""
    step = _STEP.get(name.rpartition(".")[2], _SMALL) if name.startswith("camera.") else _SMALL
    up, down = (_inverse_distances(*_stepped(camera, light, name, sign * step), uv) for sign in (1, -1))
    return (up - down) / (2 * step)


def _inverse_distances(camera: Camera, sheets: Sequence[LaserPlane], uv: Array) -> Array:
    """1/m, (2, N), along the rays of pixels to both sheets; not above zero behind the camera."""
    origin, direction = rays(camera, uv)
    planes = [(np.array(sheet.normal), sheet.offset) for sheet in sheets]
    return np.stack([(direction @ normal) / (offset - origin @ normal) for normal, offset in planes])


def _stepped(camera: Camera, light: Laser, name: str, step: float) -> tuple[Camera, tuple[LaserPlane, ...]]:
    """Camera and sheets with one parameter changed; one that does not exist changes nothing."""
    part = name.rpartition(".")[2]
    if not name.startswith("camera."):
        return camera, tuple(_moved_sheet(sheet, name, part, step) for sheet in light.sheets)
    if name.startswith("camera.distortion."):
        names = DISTORTION[camera.model]
        values = dict(zip(names, (*camera.distortion, *[0.0] * len(names)), strict=False))
        values = {key: value + step * (key == part) for key, value in values.items()}
        return camera.model_copy(update={"distortion": tuple(values.values())}), light.sheets
    if part in _STEP:
        return camera.model_copy(update={part: getattr(camera, part) + step}), light.sheets
    return camera, light.sheets


def _moved_sheet(sheet: LaserPlane, name: str, part: str, step: float) -> LaserPlane:
    if not name.startswith(f"laser.planes.{sheet.name}."):
        return sheet
    if part == "offset":
        return sheet.model_copy(update={"offset": sheet.offset + step})
    normal = [value + step * (axis == part) for axis, value in zip("xyz", sheet.normal, strict=True)]
    return sheet.model_copy(update={"normal": tuple(normal)})
