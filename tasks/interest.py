"""Interest points of an image: extrema of differences of Gaussians over place and scale (Lowe 2004).

OpenCV's SIFT doubles an image before it looks for them, which costs three quarters of its time. Here the finest scale
is that of the image itself, blurred a little; what a doubled image would show beyond it, seabeds hardly have.
"""

import itertools
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

FIRST_SIGMA_PX = 1.0  # of the blur of the first layer of each octave
LAYERS = 2  # an octave
_OCTAVES = 4
_CAMERA_SIGMA_PX = 0.5  # blur that images have as they are taken
_SMALLEST_SIDE = 32
_EDGE_RATIO = 10.0  # of the principal curvatures: on a straight edge a point may lie anywhere
_FARTHEST = 0.75  # steps from the extremum on the grid to that of the parabola
_CELLS_PER_SIDE = 8
_SPARE = 1.5  # of points to refine over those to keep
_WIDE = 2.5  # the blur whose gradient gives a point its direction, over the blur at which it was found
_SQUARE = np.ones((3, 3), np.uint8)


class Points(NamedTuple):
    """Interest points, strongest first.

    Attributes
    ----------
    uv : (N, 2) pixels. sigma_px : (N,) scale. response : (N,) grey levels.
    octave, layer : (N,) where in the pyramid they were found.
    gradient_rad : (N,) direction of the gradient around, from u towards v, which turns with the image.
    """

    uv: Array
    sigma_px: Array
    response: Array
    octave: NDArray[np.intp]
    layer: NDArray[np.intp]
    gradient_rad: Array


def find(grey: NDArray[np.uint8], ignore: NDArray[np.bool_], threshold: float, count: int, directed: bool) -> Points:
    """At most `count` points, evenly over a grey image (H, W), whose response exceeds a threshold, grey levels.

    ignore : (H, W) pixels on which there is none. directed : whether to measure directions; else they are 0.
    """
    image, blur, seen, parts = grey.astype(np.float32), _CAMERA_SIGMA_PX, ~ignore, []
    for octave in range(_OCTAVES):
        if min(image.shape) < _SMALLEST_SIDE:
            break
        layers = _layers(image, blur)
        found = _of_octave(layers, seen, threshold, count, directed)
        step = 2**octave
        parts.append(found._replace(uv=found.uv * step, sigma_px=found.sigma_px * step, octave=found.octave + octave))
        image, blur, seen = layers[LAYERS][::2, ::2].copy(), FIRST_SIGMA_PX, seen[::2, ::2]
    every = Points(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    keep = _strongest_everywhere(every.uv, every.response, grey.shape, count)
    return Points(*(values[keep] for values in every))


def _sigma(layer: Array | int) -> Any:
    return FIRST_SIGMA_PX * 2.0 ** (np.asarray(layer) / LAYERS)


def _layers(image: NDArray[np.float32], blur: float) -> list[NDArray[np.float32]]:
    """The image, blurred by `blur` pixels so far, at all scales of an octave."""
    found = []
    for layer in range(LAYERS + 3):
        more = float(np.sqrt(max(_sigma(layer) ** 2 - blur**2, 0.0)))
        image = _blurred(image, more) if more > 0 else image
        blur = float(_sigma(layer))
        found.append(image)
    return found


def _blurred(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    return cv2.GaussianBlur(image, (0, 0), sigma)  # type: ignore[return-value]


def _of_octave(
    layers: list[NDArray[np.float32]], seen: NDArray[np.bool_], threshold: float, count: int, directed: bool
) -> Points:
    difference = np.stack([b - a for a, b in itertools.pairwise(layers)])
    k, v, u = _extrema(difference, seen, 0.8 * threshold)
    rough = np.abs(difference[k, v, u])
    keep = _strongest_everywhere(np.column_stack([u, v]), rough, seen.shape, int(_SPARE * count))
    k, v, u = k[keep], v[keep], u[keep]
    off, response, good = _parabola(difference, k, v, u)
    good &= response > threshold
    k, v, u, off, response = k[good], v[good], u[good], off[good], response[good]
    return Points(
        uv=np.column_stack([u, v]) + off[:, :2],
        sigma_px=_sigma(k + off[:, 2]),
        response=response,
        octave=np.zeros(len(k), np.intp),
        layer=k,
        gradient_rad=_gradient(layers, k, v, u) if directed else np.zeros(len(k)),
    )


def _extrema(difference: Array, seen: NDArray[np.bool_], threshold: float) -> tuple[NDArray[np.intp], ...]:
    """Layer, row and column of the samples that are extreme among their 26 neighbours."""
    highest, lowest = ([f(d, _SQUARE) for d in difference] for f in (cv2.dilate, cv2.erode))
    inside = np.zeros(seen.shape, bool)
    inside[1:-1, 1:-1] = seen[1:-1, 1:-1]
    found = []
    for k in range(1, len(difference) - 1):
        d = difference[k]
        top = cv2.max(cv2.max(highest[k - 1], highest[k]), highest[k + 1])
        bottom = cv2.min(cv2.min(lowest[k - 1], lowest[k]), lowest[k + 1])
        extreme = ((d == top) & (d > threshold)) | ((d == bottom) & (d < -threshold))
        v, u = np.nonzero(extreme & inside)
        found.append((np.full(len(v), k), v, u))
    return tuple(np.concatenate(column) for column in zip(*found, strict=True))


def _parabola(difference: Array, k: Array, v: Array, u: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Offsets (N, 3) in u, v and layer to the extremum of the parabola through the neighbours, the response there,
    and which of them are such extrema and do not lie on an edge."""
    _, height, width = difference.shape
    flat, base = difference.ravel(), (k * height + v) * width + u
    along = (1, width, height * width)
    centre = flat[base].astype(float)
    ahead, behind = (np.stack([flat[base + sign * step] for step in along], 1).astype(float) for sign in (1, -1))
    gradient = (ahead - behind) / 2
    hessian = np.empty((len(base), 3, 3))
    for a in range(3):
        hessian[:, a, a] = ahead[:, a] + behind[:, a] - 2 * centre
        for b in range(a):
            p, q = along[a] + along[b], along[a] - along[b]
            mixed = (flat[base + p] + flat[base - p] - flat[base + q] - flat[base - q]) / 4
            hessian[:, a, b] = hessian[:, b, a] = mixed
    trace = hessian[:, 0, 0] + hessian[:, 1, 1]
    minor = hessian[:, 0, 0] * hessian[:, 1, 1] - hessian[:, 0, 1] ** 2
    good = (minor > 0) & (trace**2 * _EDGE_RATIO < (_EDGE_RATIO + 1) ** 2 * minor)
    good &= np.abs(np.linalg.det(hessian)) > 1e-12
    hessian[~good] = np.eye(3)
    off = -np.linalg.solve(hessian, gradient[..., None])[..., 0]
    response = np.abs(centre + (gradient * off).sum(1) / 2)
    return off, response, good & (np.abs(off) < _FARTHEST).all(1)


def _gradient(layers: list[NDArray[np.float32]], k: Array, v: Array, u: Array) -> Array:
    """Direction (N,) of the gradient of a wider blur, radians: what is finer differs from image to image."""
    found = np.zeros(len(k))
    for layer in np.unique(k).tolist():
        at = k == layer
        wide = _blurred(layers[layer], float(np.sqrt(_WIDE**2 - 1) * _sigma(layer)))
        rows, columns = v[at], u[at]
        across = wide[rows, columns + 1] - wide[rows, columns - 1]
        found[at] = np.arctan2(wide[rows + 1, columns] - wide[rows - 1, columns], across)
    return found


def _strongest_everywhere(uv: Array, response: Array, shape: tuple[int, ...], count: int) -> NDArray[np.intp]:
    """Indices of at most `count` points: by rank of their response within their cell of the image."""
    column = np.minimum(uv[:, 0] * _CELLS_PER_SIDE / shape[1], _CELLS_PER_SIDE - 1).astype(int)
    row = np.minimum(uv[:, 1] * _CELLS_PER_SIDE / shape[0], _CELLS_PER_SIDE - 1).astype(int)
    cell = row * _CELLS_PER_SIDE + column
    order = np.lexsort((-response, cell))
    starts = np.concatenate([[0], np.flatnonzero(np.diff(cell[order])) + 1])
    rank = np.arange(len(uv)) - np.repeat(starts, np.diff([*starts, len(uv)]))
    return order[np.argsort(rank, kind="stable")[:count]]
