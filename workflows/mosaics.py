"""Orthomosaic and planar mosaic, per map tile: both from images that are read once, and the light of the mission."""

import sys
from collections.abc import Collection, Sequence
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from ..catalog.store import Store
from ..schemas.calibration import Camera
from ..tasks import camera, colour, frames, laser, mosaic, nodes, planar, seams, terrain, water
from ..tasks.frames import MapFrame
from ..tasks.grids import Grid
from ..tasks.navigation import Poses
from ..tasks.nodes import Lie, Shot
from . import extract, match, solve
from .job import Done, Job, Made, code_version, load, once, read, stage
from .maps import SURFACE, ground_around, paste
from .maps_inputs import Image, MapJob, Pair, Tile, context, pose_digest, rows_of
from .solve import Solution

# Of a pair, at most: a similarity needs two, and all pairs of a mission are held in memory at once
_ALIGNED_MATCHES = 50
LIGHTING, ALIGN, MOSAIC = "lighting", "planar-align", "mosaic"
_VERSION = code_version(sys.modules[__name__])
_MASKS = "mask", "painted", "planar_mask"  # stored as bits, of rows
_REMEMBERED = 64  # images, of which 0.2 MB each


def lighting(m: MapJob, images: Sequence[Image]) -> Done:
    """What lamps and water do to the mission's colours, from the thumbnails of some of its images."""
    poses = solve.solution(m.job, m.adjusted).poses
    gamma = m.job.parameters.mosaic.gamma

    def make() -> Made:
        light, away, exact = zip(*(_small(m.job, image, poses) for image in images), strict=True)
        return Made(water.fit(np.stack(light), np.stack(away), np.stack(exact))._asdict(), {"images": len(images)})

    heights = [(image.range_m, *np.round(poses.R_local_camera[image.row, 2], 6)) for image in images]
    parameters = [gamma, *stage(m.job.calibration.camera), heights]
    return once(m.job, LIGHTING, _VERSION, [image.key for image in images], parameters, make)


def _small(job: Job, image: Image, poses: Poses) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An image's thumbnail as light, red green blue, how far away its cells are, and where this is known well."""
    arrays = load(job, extract.STEP, image.key, ("thumbnail", "laser_uv", "laser_X")).arrays
    uv, X = arrays.get("laser_uv", np.zeros((0, 2))), arrays.get("laser_X", np.zeros((0, 3)))
    down = -poses.R_local_camera[image.row, 2]
    away, exact = colour.ranges(job.calibration.camera, down, image.range_m, uv.astype(float), X.astype(float))
    return colour.as_light(arrays["thumbnail"][..., ::-1], job.parameters.mosaic.gamma), away, exact


def _inputs(tile: Tile, solution: Solution) -> list[str]:
    return [*(f"{image.row}:{image.key}" for image in tile.images), pose_digest(solution, rows_of(tile))]


def _context(m: MapJob, tile: Tile) -> list[Any]:
    return [*context(m, tile), m.hiding_m, *stage(m.job.parameters.mosaic)]


def align_planar(m: MapJob, images: Sequence[Image], linked: Sequence[Pair]) -> Done:
    """Similarities of all images on the plane of the planar-scene hypothesis; the info has how far each was moved."""
    solution = solve.solution(m.job, m.adjusted)
    whole = Tile(Grid(1.0, 0, 0, 1, 1), tuple(images), tuple(linked))
    inputs = [*_inputs(whole, solution), *(f"{pair.i}-{pair.j}:{pair.key}" for pair in linked)]

    def make() -> Made:
        rows = np.array([image.row for image in images], int)
        if not len(rows):
            return Made({"rows": rows, "similarity": np.zeros((0, 2, 3))}, {"moved_m": []})
        C_map = m.frame.map_from_local(solution.poses.C_local[rows])
        above = np.array([image.range_m for image in images])
        height = float(np.median(above))
        believed = planar.prior(C_map, np.maximum(above, 0.1), m.frame.R_map_local(C_map.mean(0)))
        matches = _levelled(m, linked, solution.poses, {int(row): k for k, row in enumerate(rows)}, height)
        similarity = planar.align(believed, matches, 0.1 * height)
        moved_m = np.hypot(*(similarity[:, :, 2] - C_map[:, :2]).T)
        return Made({"rows": rows, "similarity": similarity}, {"moved_m": np.round(moved_m, 3).tolist()})

    context = [*_context(m, whole), [image.range_m for image in images]]
    return once(m.job, ALIGN, _VERSION, inputs, context, make)


def _levelled(m: MapJob, linked: Sequence[Pair], poses: Poses, number: dict[int, int], range_m: float):
    """Matches of the linked pairs, some of each, as levelled slopes."""
    sides: tuple[list, list] = ([], [])
    images: tuple[list, list] = ([], [])
    for pair in linked:
        arrays = load(m.job, match.STEP, pair.key, ("uv_i", "uv_j")).arrays
        every = -(-len(arrays["uv_i"]) // _ALIGNED_MATCHES)
        levelled = []
        for row, uv in ((pair.i, arrays["uv_i"][::every]), (pair.j, arrays["uv_j"][::every])):
            slopes = camera.normalised(m.job.calibration.camera, uv.astype(float), range_m)
            levelled.append(planar.level_slopes(poses.R_local_camera[row], slopes))
        known = np.isfinite(np.hstack(levelled)).all(1)
        for side, (row, xy) in enumerate(zip((pair.i, pair.j), levelled, strict=True)):
            sides[side].append(xy[known])
            images[side].append(np.full(known.sum(), number[row]))
    none = [np.zeros((0, 2))], [np.zeros(0, int)]
    xy_i, xy_j = (np.concatenate(side + none[0]) for side in sides)
    image_i, image_j = (np.concatenate(side + none[1]) for side in images)
    return planar.Matches(image_i.astype(int), image_j.astype(int), xy_i, xy_j)


def mosaic_tile(m: MapJob, tile: Tile, ground: Sequence[tuple[Grid, Done]], aligned: Done, light: Done | None) -> Done:
    """One tile of the orthomosaic over the surface tiles `ground`, and of the planar mosaic."""
    solution = solve.solution(m.job, m.adjusted)
    cell = tile.grid.cell_m
    times = {image.row: mosaic.reduction(m.job.calibration.camera, image.range_m, cell) for image in tile.images}
    inputs = [*_inputs(tile, solution), *(done.key for _, done in ground), aligned.key, light.key if light else ""]

    def make() -> Made:
        model = light_model(m.job, light)
        small = [model and _thumbnail(m.job, image, solution.poses, model) for image in tile.images]
        shots = [shot(m.job, image, thumbnail) for image, thumbnail in zip(tile.images, small, strict=True)]
        toned = tone(m.job.calibration.camera, model) if model else None
        both = _on_surface(m, tile, ground, solution.poses), _on_plane(m, tile, aligned, solution.poses)
        plans = [
            seams.plan(tile.grid, place, [(one, lies[one.number]) for one in shots], toned) for place, lies in both
        ]
        images = {image.row: image for image in tile.images}

        def pixels(row: int, reduce: int) -> np.ndarray:
            return read_image(m.job, images[row], reduce)

        cv2.setNumThreads(1)
        ortho, flat = mosaic.compose(plans, pixels, times, m.job.parameters.mosaic.gamma if light else 1.0)
        arrays = {**ortho._asdict(), "planar_rgb": flat.rgb, "planar_mask": flat.mask}
        arrays |= {name: np.packbits(arrays[name], axis=1) for name in _MASKS}
        return Made(arrays, {"pixels": int(ortho.mask.sum()), "painted": int(ortho.painted.sum())})

    parameters = [*_context(m, tile), sorted(times.items())]
    return once(m.job, MOSAIC, _VERSION, inputs, parameters, make, ("source", *_MASKS))


def layers(job: Job, tile: Grid, done: Done, names: Collection[str]) -> dict[str, np.ndarray]:
    """Some of the arrays of a tile: rgb, planar_rgb (3, height, width) and mask, planar_mask, painted, source."""
    arrays = load(job, MOSAIC, done.key, names).arrays
    return {
        name: np.unpackbits(values, axis=1, count=tile.width).view(bool) if name in _MASKS else values
        for name, values in arrays.items()
    }


def _on_surface(
    m: MapJob, tile: Tile, ground: Sequence[tuple[Grid, Done]], poses: Poses
) -> tuple[nodes.Ground, dict[int, Lie]]:
    """The tile's nodes on the surface, and how its images lie to them."""
    around = ground_around(tile.grid, m.cell_m, m.hiding_m)
    elevation = np.full(around.shape, np.nan)
    for grid, done in ground:
        paste(around, elevation, grid, load(m.job, SURFACE, done.key, ("ground",)).arrays["ground"])
    local = local_affine(m.frame, tile.grid, elevation)
    lies = {
        image.row: nodes.lie(local, poses.R_local_camera[image.row], poses.C_local[image.row]) for image in tile.images
    }
    return nodes.ground(tile.grid, terrain.Terrain(elevation, around, local)), lies


def _on_plane(m: MapJob, tile: Tile, aligned: Done, poses: Poses) -> tuple[nodes.Ground, dict[int, Lie]]:
    """The tile's nodes on the plane of the planar-scene hypothesis, and how its images lie to them."""
    entry = load(m.job, ALIGN, aligned.key)
    similarity = dict(zip(entry.arrays["rows"].tolist(), entry.arrays["similarity"], strict=True))
    lies = {image.row: planar.lie(poses.R_local_camera[image.row], similarity[image.row]) for image in tile.images}
    return nodes.flat_ground(tile.grid), lies


def local_affine(frame: MapFrame, tile: Grid, elevation: np.ndarray) -> frames.LocalAffine:
    """The map around a tile's middle."""
    z = float(np.nanmean(elevation)) if np.isfinite(elevation).any() else 0.0
    west, south, east, north = tile.bounds
    return frame.affine_at(np.array([(west + east) / 2, (south + north) / 2, z]))


def shot(job: Job, image: Image, thumbnail: np.ndarray | None) -> Shot:
    """An image without its pixels: which of them the laser lights, and its colours in small."""
    lens = job.calibration.camera
    return Shot(image.row, lens, _qualities(job.store, image.key, lens.model_dump_json()), thumbnail)


@lru_cache(maxsize=_REMEMBERED)
def _qualities(store: Store, key: str, lens_json: str) -> np.ndarray:
    """Which pixels of an image are how good, by the key of its extraction: tiles one after the other ask for it."""
    entry, lens = read(store, extract.STEP, key, ("line_uv",)), Camera.model_validate_json(lens_json)
    scale = nodes.quality_scale(lens)
    shape = -(-lens.height // scale), -(-lens.width // scale)
    erase = np.zeros(shape, bool)
    if "line_uv" in entry.arrays:
        u, v = np.floor((entry.arrays["line_uv"] + 0.5) / scale).astype(int).T
        erase[np.clip(v, 0, shape[0] - 1), np.clip(u, 0, shape[1] - 1)] = True
        line = np.argwhere(erase)[:, ::-1].astype(float)  # each pixel once
        erase = laser.mask(shape, line, entry.info["halfwidth_px"] / scale + 0.5)
    return nodes.qualities(erase, scale)


def light_model(job: Job, light: Done | None) -> water.Water | None:
    """What lamps and water do, as `lighting` found it; None for pixels as they were taken."""
    if light is None:
        return None
    a = load(job, LIGHTING, light.key).arrays
    scalars = {name: a[name].item() for name in ("spreading", "range_m")}
    # in single precision, as the pixels are
    attenuation, veil, balance = (a[name].astype(np.float32) for name in ("attenuation", "veil", "balance"))
    return water.Water(light=a["light"], attenuation=attenuation, veil=veil, balance=balance, **scalars)


def _thumbnail(job: Job, image: Image, poses: Poses, model: water.Water) -> np.ndarray:
    """An image's thumbnail without what lamps and water do."""
    small, away, _ = _small(job, image, poses)
    gain, veil = water.tone(model, model.light, away)
    return water.without_holes(small * gain - veil)


def read_image(job: Job, image: Image, times: int) -> np.ndarray:
    """An image, red green blue, so many times smaller."""
    bgr = extract.read_verified(job, image.path, image.sha256, times)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))


def tone(lens: Camera, model: water.Water) -> seams.Tone:
    """What an image's light is multiplied with, less what, by pixel and distance."""

    def at(u: np.ndarray, v: np.ndarray, range_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return water.tone(model, nodes.small_at(model.light, lens, u, v), range_m)

    return at


VERSIONS = dict.fromkeys((LIGHTING, ALIGN, MOSAIC), _VERSION)
