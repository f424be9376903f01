"""Simulated seabed: a grid of heights, and where rays meet it.

Positions are in the local frame (x east, y north, z up). Heights are kept above a level datum at
z = -depth_m; row 0 of the grid is its southern edge, column 0 its western, nodes lie at multiples of cell_m,
and the seabed between nodes is bilinear. All of it is defined once, here, for the images and for the truth.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.scene import TerrainScene

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

# A ray within this distance has met the seabed; how often it may step towards it, safely and then by secants.
_HIT_M = 1e-5
_MAX_STEPS = 1000
_SECANT_STEPS = 3
# Neighbouring rays whose distances differ by less than this many cells see an even seabed.
_EVEN_CELLS = 1.5


class Terrain(NamedTuple):
    """A seabed of heights.

    Attributes
    ----------
    h : (n, n) float32, metres above the datum, row 0 south, column 0 west.
    half_m : the grid reaches from -half_m to +half_m east and north.
    cell_m : distance of neighbouring nodes.
    depth_m : the datum lies at z = -depth_m.
    cone : (n, n) float32, no node lies above a cone with this slope that stands on the node (see `cones`).
    """

    h: Array32
    half_m: float
    cell_m: float
    depth_m: float
    cone: Array32


def make_terrain(scene: TerrainScene, half_m: float, rng: np.random.Generator, period_m: float = 0.0) -> Terrain:
    """The seabed of a scene, at least half_m to each side of the origin.

    Parameters
    ----------
    scene : kind and measures of the seabed; the kinds plane, box and pool (a slope that goes down to a flat
        floor) are those of the paper (III.D, IV).
    half_m : metres from the origin to the edges; made a whole number of cells.
    rng : draws the relief of a rough seabed; unused by the other kinds.
    period_m : a rough seabed repeats itself after this, a whole number of cells, north and east. 0: never.
    """
    cells = int(np.ceil(half_m / scene.cell_m))
    half_m = cells * scene.cell_m
    if period_m:
        h = _repeated(scene, cells, round(period_m / scene.cell_m), rng).astype(np.float32)
    else:
        axis = np.linspace(-half_m, half_m, 2 * cells + 1)
        x, y = np.meshgrid(axis, axis)
        shapes = {"plane": _plane, "box": _box, "pool": _pool, "rough": _rough}
        h = shapes[scene.kind](scene, x, y, rng).astype(np.float32)
    return Terrain(h, half_m, scene.cell_m, scene.depth_m, cones(h, scene.cell_m))


def _repeated(scene: TerrainScene, cells: int, period: int, rng: np.random.Generator) -> Array:
    """A rough seabed of 2 cells + 1 nodes a side that repeats itself after `period` nodes."""
    half_m = period * scene.cell_m / 2
    relief = scene.relief_m * fractal_noise(period, scene.cell_m, 4.0, 2.0, rng)  # of one period already
    boulders = np.zeros((3 * period, 3 * period))  # a stone over the edge stands on the other side, too
    middle = slice(period, 2 * period)
    for _ in range(rng.poisson(scene.boulders_per_m2 * (2 * half_m) ** 2)):
        stones = np.zeros_like(boulders)
        _add_boulder(stones, scene, 3 * half_m, rng, within_m=half_m)
        folded = stones.reshape(3, period, 3, period).max(axis=(0, 2))
        np.maximum(boulders[middle, middle], folded, out=boulders[middle, middle])
    h = relief + boulders[middle, middle]
    index = np.arange(-cells, cells + 1) % period
    return h[np.ix_(index, index)]


def _plane(scene: TerrainScene, x: Array, y: Array, rng: np.random.Generator) -> Array:
    return np.zeros_like(x)


def _box(scene: TerrainScene, x: Array, y: Array, rng: np.random.Generator) -> Array:
    # walls one cell thick, so that a turned box has straight edges
    inside = [
        np.clip((size / 2 - abs(v)) / scene.cell_m + 0.5, 0, 1)
        for v, size in zip((x, y), scene.box_size_m, strict=True)
    ]
    return scene.box_height_m * np.minimum(*inside)


def _pool(scene: TerrainScene, x: Array, y: Array, rng: np.random.Generator) -> Array:
    start = -scene.slope_drop_m / np.tan(np.radians(scene.slope_deg)) / 2
    return -np.clip((y - start) * np.tan(np.radians(scene.slope_deg)), 0, scene.slope_drop_m)


def _rough(scene: TerrainScene, x: Array, y: Array, rng: np.random.Generator) -> Array:
    h = scene.relief_m * fractal_noise(x.shape[0], scene.cell_m, 4.0, 2.0, rng)
    if scene.ripple_height_m:
        wander = 0.15 * fractal_noise(x.shape[0], scene.cell_m, 4.0, 2.0, rng)
        phase = 2 * np.pi * ((0.8 * x + 0.6 * y) / scene.ripple_length_m + wander)
        h += scene.ripple_height_m / 2 * np.sin(phase)
    half_m, boulders = float(x[0, -1]), np.zeros_like(h)
    for _ in range(rng.poisson(scene.boulders_per_m2 * (2 * half_m) ** 2)):
        _add_boulder(boulders, scene, half_m, rng)
    return h + boulders


def _add_boulder(
    h: Array, scene: TerrainScene, half_m: float, rng: np.random.Generator, within_m: float | None = None
) -> None:
    """Raises h, in place, to the top of one lumpy stone: an ellipsoid, flattened on top, with a steep foot.

    within_m : how far from the origin its middle may be, east and north; half_m by default.
    """
    height = scene.boulder_height_m * rng.uniform(0.2, 1.0)
    radius = height * rng.uniform(0.8, 1.8)
    reach = half_m if within_m is None else within_m
    x0, y0 = rng.uniform(-reach, reach, 2)
    turn, stretch = rng.uniform(0, np.pi), rng.uniform(0.7, 1.4)
    centre = np.array([y0, x0]) + half_m
    low, high = (((centre + side * 1.7 * radius) / scene.cell_m).astype(int) for side in (-1, 1))
    rows, columns = (slice(max(a, 0), max(b, 0)) for a, b in zip(low, high, strict=True))
    part = h[rows, columns]
    if not part.size:
        return
    y = (np.arange(part.shape[0]) + rows.start)[:, None] * scene.cell_m - half_m - y0
    x = (np.arange(part.shape[1]) + columns.start) * scene.cell_m - half_m - x0
    a, b = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
    lumps = 1 + 0.1 * np.sin(3 * np.arctan2(b, a) + rng.uniform(0, 7)) + 0.06 * np.sin(5 * np.arctan2(b, a))
    distance = np.hypot(a / stretch, b * stretch) / (radius * lumps)
    np.maximum(part, height * np.clip(1 - distance**3, 0, None) ** 0.75, out=part)


def fractal_noise(size: int, cell_m: float, longest_m: float, slope: float, rng: np.random.Generator) -> Array:
    """Noise (size, size) of zero mean and unit standard deviation whose amplitude falls as frequency ** -slope,
    flat above the wavelength longest_m."""
    frequency = np.hypot(np.fft.fftfreq(size, cell_m)[:, None], np.fft.rfftfreq(size, cell_m))
    spectrum = np.fft.rfft2(rng.standard_normal((size, size)))
    spectrum *= np.maximum(frequency, 1 / longest_m) ** -slope
    spectrum[0, 0] = 0
    noise = np.fft.irfft2(spectrum, s=(size, size))
    return noise / noise.std()


def cones(h: Array32, cell_m: float) -> Array32:
    """For each node the slope of an upward cone that no other node rises above (cone stepping, Dummer 2006).

    A ray at some height above the node can safely advance until it meets that cone. Bounded from above by
    rings of doubling radius: the highest node of the square with twice the ring's radius, seen from as near
    as the ring's inner radius.
    """
    steepest = np.zeros_like(h)
    radius = 1
    while radius < max(h.shape):
        highest = cv2.dilate(h, np.ones((4 * radius + 1, 1), np.uint8))
        highest = cv2.dilate(highest, np.ones((1, 4 * radius + 1), np.uint8))
        steepest = np.maximum(steepest, (highest - h) / np.float32(radius * cell_m))
        radius *= 2
    # a ray between nodes looks at the nearest node only
    return np.asarray(cv2.dilate(steepest, np.ones((3, 3), np.uint8)), np.float32)


def _remap(grid: Array32, column: NDArray, row: NDArray, method: int) -> Array32:
    column, row = np.asarray(column, np.float32), np.asarray(row, np.float32)
    return np.asarray(cv2.remap(grid, column, row, method, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _sample(terrain: Terrain, grid: Array32, x: NDArray, y: NDArray, method: int) -> Array32:
    """Values of a grid at local positions (N,) or (H, W)."""
    column, row = ((v + np.float32(terrain.half_m)) / np.float32(terrain.cell_m) for v in (x, y))
    if column.ndim == 2:
        return _remap(grid, column, row, method)
    # cv2.remap takes images, of less than 32768 pixels a side
    width = 16_384
    folded = [np.pad(v, (0, -v.size % width)).reshape(-1, width) for v in (column, row)]
    blocks = [
        _remap(grid, folded[0][k : k + width], folded[1][k : k + width], method)
        for k in range(0, len(folded[0]), width)
    ]
    return np.concatenate([block.ravel() for block in blocks] or [np.zeros(0, np.float32)])[: column.size]


def height(terrain: Terrain, x: NDArray, y: NDArray) -> Array32:
    """Elevation z (same shape as x, y) of the seabed, metres, local frame; the edges go on for ever."""
    return _sample(terrain, terrain.h, x, y, cv2.INTER_LINEAR) - np.float32(terrain.depth_m)


def normals(terrain: Terrain) -> Array32:
    """Upward unit normals (n, n, 3) at the nodes, local frame."""
    dy, dx = np.gradient(terrain.h, terrain.cell_m)
    n = np.dstack([-dx, -dy, np.ones_like(dx)]).astype(np.float32)
    return n / np.linalg.norm(n, axis=2, keepdims=True)


def sample_normals(terrain: Terrain, normals: Array32, x: NDArray, y: NDArray) -> Array32:
    """Unit normals (H, W, 3) at local positions (H, W), smooth across cells."""
    n = _sample(terrain, normals, x, y, cv2.INTER_LINEAR)
    return n / np.sqrt(np.einsum("ijk,ijk->ij", n, n))[..., None]


def cast(terrain: Terrain, origin: NDArray, direction: NDArray) -> Array:
    """Distance (N,) along downward rays to the seabed, metres; inf for a ray that never meets it.

    Steps along cones, which never passes over a ridge however thin, until the seabed is less than a third of a
    cell away, then by secants on what is one bilinear patch or two.

    Parameters
    ----------
    origin, direction : (N, 3), local frame; directions are unit vectors, z negative for rays that can hit.
    """
    o, d = _transposed(origin, direction)
    return _cast(terrain, o, d, np.zeros(d.shape[1], np.float32)).astype(np.float64)


def cast_image(terrain: Terrain, origin: NDArray, direction: NDArray) -> Array32:
    """`cast` for all pixels of an image, (H, W) float32.

    Every fourth ray each way is cast with care. Between those that met an even seabed the others start from the
    interpolated distance; the rest, near steps and outlines, are cast with care too.

    Parameters
    ----------
    origin : (3,) or (H, W, 3); direction : (H, W, 3), unit vectors, local frame.
    """
    height_px, width_px = direction.shape[:2]
    origin = np.broadcast_to(origin, direction.shape)
    nodes = [np.minimum(np.arange(0, n + 3, 4), n - 1) for n in (height_px, width_px)]
    picked = np.ix_(*nodes)
    coarse = cast(terrain, origin[picked].reshape(-1, 3), direction[picked].reshape(-1, 3))
    coarse = coarse.reshape(len(nodes[0]), len(nodes[1])).astype(np.float32)
    nearest, farthest = (f(coarse, np.ones((3, 3), np.uint8)) for f in (cv2.erode, cv2.dilate))
    v, u = np.mgrid[:height_px, :width_px].astype(np.float32) / 4
    s = _remap(coarse, u, v, cv2.INTER_LINEAR).ravel()
    spread, free = (
        np.repeat(np.repeat(w, 4, 0), 4, 1)[:height_px, :width_px].ravel() for w in (farthest - nearest, nearest)
    )
    o, d = _transposed(origin.reshape(-1, 3), direction.reshape(-1, 3))
    even = np.flatnonzero(spread < _EVEN_CELLS * terrain.cell_m)
    careful = np.ones(s.shape, bool)
    s[even], careful[even] = _secants(terrain, o[:, even], d[:, even], s[even])
    rest = np.flatnonzero(careful)
    s[rest] = _cast(terrain, o[:, rest], d[:, rest], free[rest] - terrain.cell_m)
    return s.reshape(height_px, width_px)


def _transposed(origin: NDArray, direction: NDArray) -> tuple[Array32, Array32]:
    """(3, N) arrays, contiguous for each axis."""
    origin = np.broadcast_to(origin, direction.shape)
    return np.ascontiguousarray(origin.T, np.float32), np.ascontiguousarray(direction.T, np.float32)


def _cast(terrain: Terrain, o: Array32, d: Array32, free_m: Array32) -> Array32:
    """Distances (N,) of rays (3, N) that are known to be free as far as free_m (N,)."""
    top = np.float32(float(terrain.h.max()) - terrain.depth_m + 1e-3)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(d[2] < 0, np.maximum((top - o[2]) / d[2], free_m), np.inf).astype(np.float32)
    hits = np.flatnonzero(np.isfinite(s))
    o, d = o[:, hits], d[:, hits]
    near = _cone_steps(terrain, o, d, s[hits], terrain.cell_m / 3)
    found, missed = _secants(terrain, o, d, near)
    # on steep faces secants may fail: those few rays go back a cell and on by steps
    lost = np.flatnonzero(missed)
    found[lost] = _cone_steps(terrain, o[:, lost], d[:, lost], near[lost] - terrain.cell_m, _HIT_M)
    s[hits] = found
    return s


def _gap(terrain: Terrain, o: Array32, d: Array32, s: Array32) -> tuple[Array32, Array32, Array32]:
    """Heights (N,) above the seabed of points on rays, and their x, y."""
    x, y = o[0] + s * d[0], o[1] + s * d[1]
    return o[2] + s * d[2] - height(terrain, x, y), x, y


def _cone_steps(terrain: Terrain, o: Array32, d: Array32, s: Array32, until_m: float) -> Array32:
    """Distances after steps along the nodes' cones; beside steep faces, steps of a twentieth of a cell."""
    shortest = np.float32(terrain.cell_m / 20)
    done, active = s.copy(), np.arange(len(s))
    for _ in range(_MAX_STEPS):
        gap, x, y = _gap(terrain, o, d, s)
        cone = _sample(terrain, terrain.cone, x, y, cv2.INTER_NEAREST)
        far = gap > until_m
        s = s + np.where(far, np.maximum(gap / (cone * np.hypot(d[0], d[1]) - d[2]), shortest), gap)
        done[active] = s
        if not far.any():
            break
        active, o, d, s = active[far], o[:, far], d[:, far], s[far]
    return done


def _secants(terrain: Terrain, o: Array32, d: Array32, s: Array32) -> tuple[Array32, NDArray[np.bool_]]:
    """Distances, and which of them did not arrive at the seabed."""
    here, rate = _gap(terrain, o, d, s)[0], -d[2]
    for _ in range(_SECANT_STEPS):
        step = np.asarray(np.clip(here / rate, -terrain.cell_m, terrain.cell_m), np.float32)
        there = _gap(terrain, o, d, s + step)[0]
        moved = abs(step) > _HIT_M
        # a gap that closes slower than at a tenth of the ray's fall would throw the secant off
        slope = np.maximum((here - there) / np.where(moved, step, np.float32(1)), np.float32(-0.1) * d[2])
        rate = np.where(moved, slope, rate)
        s, here = s + step, there
    return s, abs(here) > 2 * _HIT_M


def occluded(terrain: Terrain, X: NDArray, emitter: NDArray) -> NDArray[np.bool_]:
    """Whether the seabed hides points (N, 3) on it from a light at emitter (3,), local frame.

    Walks from each point towards the light in steps of one cell, until above the cone that nothing rises from or
    above all of the seabed. A point within a millimetre of a shadow's edge may fall on either side.
    """
    X = np.asarray(X, np.float64)
    to_light = np.asarray(emitter) - X
    level = np.hypot(to_light[:, 0], to_light[:, 1])
    # per metre of level distance; straight below the light nothing is in the way
    way = (to_light / np.maximum(level, 1e-6)[:, None]).T
    top = float(terrain.h.max()) - terrain.depth_m
    hidden, active, start, done = np.zeros(len(X), bool), np.arange(len(X)), X.T, 0.0
    while len(active):
        done += terrain.cell_m
        x, y, z = start + done * way
        above = z - height(terrain, x, y)
        hidden[active] = above < -1e-3
        free = (above > 0) & (way[2] > _sample(terrain, terrain.cone, x, y, cv2.INTER_NEAREST))
        on = ~hidden[active] & ~free & (z < top) & (done < level[active])
        active, start, way = active[on], start[:, on], way[:, on]
    return hidden
