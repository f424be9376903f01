"""The conventional 2D mosaic under the planar-scene hypothesis, for comparison (paper I, IV and figure 7b).

An image is levelled by its attitude: a pixel becomes the slope (east, north) of its ray per metre down. On a flat
seabed a similarity then carries each levelled image into the map. All similarities are found at once from the
matches between images, held weakly to where the images are believed to be (Ferrer et al. 2007, the paper's [3]).
"""

from typing import Final, NamedTuple

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve

from .nodes import Lie

Array = NDArray[np.float64]
Indices = NDArray[np.integer]

_ROUNDS: Final = 6
_HUBER_SIGMAS: Final = 1.5
_MAD_TO_SIGMA: Final = 1.4826
_LEAST_DOWN: Final = 0.1  # of a ray of about unit length


class Matches(NamedTuple):
    """Points seen in two images.

    Attributes
    ----------
    image_i, image_j : (N,) numbers of the images.
    xy_i, xy_j : (N, 2) levelled slopes of the point in either, see `level_slopes`.
    """

    image_i: Indices
    image_j: Indices
    xy_i: Array
    xy_j: Array


def level_slopes(R_local_camera: Array, slopes: Array) -> Array:
    """Slopes (N, 2) east and north per metre down of slopes (N, 2) X/Z, Y/Z in the camera frame.

    NaN where a ray points hardly down or up: it meets the plane of the seabed far away or nowhere.
    """
    rays = np.column_stack([slopes, np.ones(len(slopes))]) @ R_local_camera.T
    down = np.where(rays[:, 2:] < -_LEAST_DOWN, -rays[:, 2:], np.nan)
    return rays[:, :2] / down


def prior(C_map: Array, altitude_m: Array, R_map_local: Array) -> Array:
    """Similarities (n, 2, 3) from levelled slopes to map x, y of cameras over a flat seabed.

    C_map (n, 2 or 3) centres; altitude_m (n,) above the seabed; R_map_local (3, 3) the meridian convergence.
    """
    linear = np.asarray(altitude_m, float)[:, None, None] * R_map_local[:2, :2]
    return np.concatenate([linear, np.asarray(C_map, float)[:, :2, None]], axis=2)


def align(
    believed: Array, matches: Matches, sigma_position_m: float, sigma_scale: float = 0.05, sigma_match_m: float = 0.01
) -> Array:
    """Similarities (n, 2, 3) from levelled slopes to the map that bring matches together.

    Least squares over all images, with Huber's weights on the matches.

    Parameters
    ----------
    believed : (n, 2, 3) similarities by `prior`.
    sigma_position_m : 1-sigma of their translation, m.
    sigma_scale : 1-sigma of their scale, as a share, and of their heading, radians.
    sigma_match_m : least 1-sigma of a match on the ground, m.
    """
    # unknowns of an image: a, b, x, y of [[a, -b], [b, a]] and (x, y), from the middle of the map
    origin = believed[:, :, 2].mean(0)
    start = np.column_stack([believed[:, 0, 0], believed[:, 1, 0], believed[:, :, 2] - origin])
    altitude = np.hypot(start[:, 0], start[:, 1])
    position = np.full(len(start), sigma_position_m)
    sigmas = np.column_stack([sigma_scale * altitude, sigma_scale * altitude, position, position])
    held = sparse.diags(sigmas.ravel() ** -2)
    design, unknown = _design(matches, len(start)), start.ravel()
    for _ in range(_ROUNDS if len(matches.image_i) else 0):
        off, J = _discrepancy(matches, design, unknown)
        size = np.hypot(*off.reshape(-1, 2).T)
        sigma = max(sigma_match_m / float(np.median(altitude)), _MAD_TO_SIGMA / 1.75 * float(np.median(size)))
        weight = np.minimum(1, _HUBER_SIGMAS * sigma / np.maximum(size, 1e-12)) / sigma**2
        weighted = J.T @ sparse.diags(np.repeat(weight, 2))
        downhill = weighted @ off + held @ (unknown - start.ravel())
        unknown = unknown - np.asarray(spsolve((weighted @ J + held).tocsc(), downhill))
    a, b, x, y = unknown.reshape(-1, 4).T
    return np.stack([np.column_stack([a, -b, x + origin[0]]), np.column_stack([b, a, y + origin[1]])], axis=1)


def _discrepancy(matches: Matches, design: sparse.csr_matrix, unknown: Array) -> tuple[Array, sparse.csr_matrix]:
    """Differences (2 N,) of the matches' places as a share of the altitude, and their derivatives (2 N, 4 n).

    In metres they would shrink with the map, and the best of all maps would be a point.
    """
    similarity = unknown.reshape(-1, 4)[:, :2]
    log_scale_by_ab = similarity / (similarity**2).sum(1, keepdims=True)
    scale = np.hypot(*similarity.T)
    share = np.repeat((scale[matches.image_i] * scale[matches.image_j]) ** -0.5, 2)
    off = share * (design @ unknown)
    row = np.arange(len(off))
    by_scale = sparse.csr_matrix(design.shape)
    for image in (matches.image_i, matches.image_j):
        column = np.repeat(4 * np.asarray(image), 2)
        for k in (0, 1):
            values = -0.5 * off * log_scale_by_ab[column // 4, k]
            by_scale += sparse.csr_matrix((values, (row, column + k)), shape=design.shape)
    return off, sparse.csr_matrix(design.multiply(share[:, None]) + by_scale)


def _design(matches: Matches, count: int) -> sparse.csr_matrix:
    """(2 N, 4 n): difference of a match's two places in the map."""
    size = len(matches.image_i)
    row, ones, zeros = np.arange(size), np.ones(size), np.zeros(size)
    entries = []
    for image, xy, sign in ((matches.image_i, matches.xy_i, 1.0), (matches.image_j, matches.xy_j, -1.0)):
        x, y = sign * xy.T
        for odd, values in ((0, (x, -y, sign * ones, zeros)), (1, (y, x, zeros, sign * ones))):
            entries += [(2 * row + odd, 4 * image + k, value) for k, value in enumerate(values)]
    rows, columns, values = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    return sparse.csr_matrix((values, (rows, columns)), shape=(2 * size, 4 * count))


def lie(R_local_camera: Array, map_from_slopes: Array) -> Lie:
    """How an image lies to the plane z = 0 by its similarity (2, 3) from levelled slopes to the map.

    The plane lies as far below the camera as the similarity's scale says; of the image's pose only the attitude is
    used.
    """
    linear = map_from_slopes[:, :2]
    altitude = float(np.sqrt(np.linalg.det(linear)))
    level = np.zeros((3, 3))
    level[:2, :2], level[2, 2] = altitude * np.linalg.inv(linear), 1.0
    A = R_local_camera.T @ level
    return Lie(A, -A @ np.array([*map_from_slopes[:, 2], altitude]))
