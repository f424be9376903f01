"""From poses to maps: which images and pairs touch which tile, and the graphs over the tiles."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from dask.delayed import Delayed, delayed

from ..tasks import camera as cameras
from ..tasks import grids, pairs
from ..tasks.grids import Grid
from . import dense, layers, maps, meshing, mosaics
from .job import Done
from .maps_inputs import Image, MapJob, Pair, Tile
from .plan import batches
from .results import Mapped, Posed, TerrainLayers, Tiles
from .session import Session, compute
from .solve import Solution

_LIGHTING_IMAGES = 200
_GROWTH_CELLS = 6 * 512 * 512
_RELIEF_SHARE = 0.3
_HIDING = 0.5  # of the range: terrain of two thirds of it hides what is so far behind it from an image's corner
_WORST_SIGMA = 1 / 75  # of the range: what interpolation knows less of it does not know
_LEAST_SEEN = 0.91  # of the ground that images see: where that is mapped, what is less certain stays empty
_TIES_A_BATCH, _PAIRS_A_BATCH = 64, 16
_AGREEMENT_PAIRS = 60
_HEIGHT_PAIRS = 200
_LEAST_TEXELS, _GROUND_CELLS = 256, 1024  # of a mosaic tile, and of the bathymetry below it


class NothingToMap(RuntimeError):
    """No image of the mission gave a sounding or a match."""


def map_tiles(state: Session, posed: Posed) -> Mapped:
    """Tiles: cells, surface, mosaics."""
    job, p = state.job, state.job.parameters
    ranges = heights(state, posed.extracted, posed.matched, posed.solution)
    images = _images(state, posed, ranges)
    if not images:
        raise NothingToMap(_no_images([done.info["status"] for done in posed.extracted.values()]))
    typical = float(np.median(ranges[[image.row for image in images]]))
    gsd = cameras.ground_sample_distance(job.calibration.camera, typical)
    cell = grids.bathymetry_cell_m(gsd) if p.grid.cell_m == "auto" else float(p.grid.cell_m)
    mosaic_cell = grids.mosaic_cell_m(gsd) if p.mosaic.cell_m == "auto" else float(p.mosaic.cell_m)
    across = p.grid.max_interpolation_m
    reach = grids.max_interpolation_m(typical) if across == "auto" else float(across)
    worst = typical * _WORST_SIGMA if p.grid.max_sigma_m == "auto" else float(p.grid.max_sigma_m)
    enough = _LEAST_SEEN if p.grid.max_sigma_m == "auto" else 1.0
    hiding = float(np.ceil(_HIDING * typical))  # whole metres: one more image does not change it
    m = MapJob(job, state.plan.frame, posed.adjusted.key, cell, reach, worst, hiding, enough)
    outlines = _outlines(state, posed.solution, ranges)
    # what is costly does not change with the bathymetry's cell: matching is kept as fine as either of the cells,
    # mosaics and mesh lie on a surface of the usual ones, and coarser ones are made of it
    usual = grids.bathymetry_cell_m(gsd)
    linked, agreed = _dense(state, m._replace(cell_m=min(cell, usual)), posed, images, outlines, ranges)
    below = m._replace(cell_m=usual)
    ground = surface_tiles = _surface(state, below, linked, agreed, images, outlines)
    if cell < usual:
        surface_tiles = _surface(state, m, linked, agreed, images, outlines)
    elif cell > usual:
        surface_tiles = _coarser(state, m, ground, _bounds(outlines, images))
    terrain = _layers(state, m, surface_tiles)
    textured = [image for image in images if image.texture]
    light = _lighting(state, below, textured)
    mosaic = _mosaics(state, below, textured or images, outlines, ground, mosaic_cell, light, posed)
    pyramid = _mesh(state, below, textured, outlines, ground, mosaic, light)
    return Mapped(m, cell, mosaic_cell, surface_tiles, terrain, ground, mosaic, pyramid, outlines)


def _images(state: Session, posed: Posed, ranges: np.ndarray) -> list[Image]:
    """Images with a pose whose extraction went well; ranges (n,) of all images."""
    known = posed.solution.poses.known
    return [
        Image(
            row=image.row,
            path=image.path,
            sha256=image.sha256,
            key=posed.extracted[image.row].key,
            texture=image.role != "laser",
            range_m=float(ranges[image.row]),
        )
        for image in state.plan.images
        if known[image.row] and not posed.extracted[image.row].info["status"]
    ]


def _no_images(status: Sequence[str]) -> str:
    rejected = Counter(one for one in status if one)
    if len(status) > rejected.total():
        return "no image has a pose: that takes navigation, or images that overlap and have a laser"
    reason, count = rejected.most_common(1)[0] if rejected else ("no image is left", 0)
    return f"no image of {len(status):,} can be used; {count:,} of them: {reason}"


def _outlines(state: Session, solution: Solution, ranges: np.ndarray) -> np.ndarray:
    """Footprints (n, M, 2) in map coordinates, NaN without pose."""
    poses = solution.poses
    local = pairs.footprints(state.job.calibration.camera, poses, ranges)
    shape = local.shape
    ground = np.repeat((poses.C_local[:, 2] - ranges)[:, None], shape[1], axis=1)
    points = np.dstack([local, ground]).reshape(-1, 3)
    known = np.isfinite(points).all(1)
    result = np.full((len(points), 2), np.nan)
    result[known] = state.plan.frame.map_from_local(points[known])[:, :2]
    return result.reshape(shape)


class _Footprints:
    """Images, found by where their footprints touch the map, grown by a margin for relief and each by moved_m (n,)."""

    def __init__(self, outlines: np.ndarray, images: Sequence[Image], moved_m: Sequence[float] = ()):
        corners, margin_m = outlines[[image.row for image in images]], _margins(outlines, images)[:, None]
        if len(moved_m):
            margin_m = margin_m + np.asarray(moved_m)[:, None]
        self._images, self._low, self._high = images, corners.min(1) - margin_m, corners.max(1) + margin_m

    def touching(self, grid: Grid) -> tuple[Image, ...]:
        west, south, east, north = grid.bounds
        near = (self._low <= (east, north)).all(1) & (self._high >= (west, south)).all(1)
        return tuple(self._images[k] for k in np.flatnonzero(near).tolist())


class _Placed:
    """Tiles with what is known of them, found by the part of the map that they share."""

    def __init__(self, tiles: Sequence[tuple[Grid, Done]]):
        self._tiles = tiles
        edges = [(tile.left, tile.left + tile.width, tile.top - tile.height, tile.top) for tile, _ in tiles]
        self._left, self._right, self._bottom, self._top = np.array(edges, int).reshape(-1, 4).T

    def overlapping(self, grid: Grid) -> list[tuple[Grid, Done]]:
        """Those that share cells with a grid of the same cells, in their order."""
        shared = (self._left < grid.left + grid.width) & (self._right > grid.left)
        shared &= (self._bottom < grid.top) & (self._top > grid.top - grid.height)
        return [self._tiles[k] for k in np.flatnonzero(shared).tolist()]


def _margins(outlines: np.ndarray, images: Sequence[Image]) -> np.ndarray:
    """What relief may add to the footprints (n,) on level ground: a share of their size, or the usual one, metres."""
    corners = outlines[[image.row for image in images]]
    size = (corners.max(1) - corners.min(1)).mean(1)
    return _RELIEF_SHARE * np.maximum(size, np.median(size) if len(size) else 0)


def _bounds(outlines: np.ndarray, images: Sequence[Image]) -> grids.Bounds:
    points = outlines[[image.row for image in images]].reshape(-1, 2)
    (west, south), (east, north) = points.min(0), points.max(0)
    return grids.Bounds(float(west), float(south), float(east), float(north))


def _linked(posed: Posed) -> list[Pair]:
    """The pairs that hold the adjustment."""
    keys = {(i, j): done.key for i, j, done in posed.matched}
    return [Pair(i, j, keys[i, j]) for i, j in posed.solution.pairs.tolist()]


class _Pairs:
    """Pairs, found by their images."""

    def __init__(self, linked: Sequence[Pair]):
        self._linked: Sequence[Pair] = linked
        self._of: dict[int, list[int]] = {}
        for k, pair in enumerate(linked):
            self._of.setdefault(pair.i, []).append(k)
            self._of.setdefault(pair.j, []).append(k)

    def images(self, images: Sequence[Image]) -> tuple[Pair, ...]:
        """Those of two of some images, in their order."""
        rows = {image.row for image in images}
        found = {k for row in rows for k in self._of.get(row, ())}
        return tuple(pair for pair in (self._linked[k] for k in sorted(found)) if {pair.i, pair.j} <= rows)


def _dense(
    state: Session, m: MapJob, posed: Posed, images: Sequence[Image], outlines: np.ndarray, ranges: np.ndarray
) -> tuple[list[Pair], Done]:
    """The linked pairs with their tie points, some with dense matching, and how well matching agrees with the laser."""
    for step in (dense.TIES, dense.STEP, dense.AGREEMENT):
        state.ledger.begin(step)
    linked, by_row = _linked(posed), {image.row: image for image in images}
    linked = [pair for pair in linked if pair.i in by_row and pair.j in by_row]
    tasks = [
        delayed(dense.ties_batch)(m, batch, dask_key_name=state.key("ties", k))
        for k, batch in enumerate(batches(linked, _TIES_A_BATCH))
    ]
    ties: list[Done] = [done for part in compute(state, dense.TIES, tasks) for done in part]
    state.ledger.end(dense.TIES, ties)
    linked = [pair._replace(ties=done.key) for pair, done in zip(linked, ties, strict=True)]
    wanted = _wanted(state, posed, linked, outlines, ranges)
    described = [dense.DensePair(by_row[pair.i], by_row[pair.j], pair.ties) for pair in wanted]
    tasks = [
        delayed(dense.dense_batch)(m, batch, dask_key_name=state.key("dense", k))
        for k, batch in enumerate(batches(described, _PAIRS_A_BATCH))
    ]
    made: list[Done] = [done for part in compute(state, dense.STEP, tasks) for done in part]
    keys = {(pair.i.row, pair.j.row): done.key for pair, done in zip(described, made, strict=True)}
    chosen = wanted or linked
    every = max(1, -(-len(chosen) // _AGREEMENT_PAIRS))
    sampled = [
        (
            dense.DensePair(by_row[pair.i], by_row[pair.j], pair.ties),
            keys.get((pair.i, pair.j), ""),
            _beside(posed, by_row, pair),
        )
        for pair in chosen[::every]
    ]
    (agreed,) = compute(
        state, dense.AGREEMENT, [delayed(dense.agreement)(m, sampled, dask_key_name=state.key("agreement"))]
    )
    state.ledger.end(dense.STEP, made)
    state.ledger.end(dense.AGREEMENT, [agreed])
    return [pair._replace(dense=keys.get((pair.i, pair.j), "")) for pair in linked], agreed


def _wanted(
    state: Session, posed: Posed, linked: Sequence[Pair], outlines: np.ndarray, ranges: np.ndarray
) -> list[Pair]:
    """The pairs to match densely."""
    p = state.job.parameters.bathymetry
    if not p.dense or not linked:
        return []
    images, C = np.array([[pair.i, pair.j] for pair in linked]), posed.solution.poses.C_local
    base = np.linalg.norm(C[images[:, 1]] - C[images[:, 0]], axis=1)
    best = pairs.for_depth(outlines, images, base / ranges[images].mean(1), p.pairs_per_image)
    chosen = set(map(tuple, best.images.tolist()))
    return [pair for pair in linked if (pair.i, pair.j) in chosen]


def _beside(posed: Posed, by_row: dict[int, Image], pair: Pair) -> tuple[Image, ...]:
    """The images that are linked to both of a pair, and the pair's own."""
    partners: dict[int, set[int]] = {pair.i: {pair.i, pair.j}, pair.j: {pair.i, pair.j}}
    for i, j in posed.solution.pairs.tolist():
        for one, other in ((i, j), (j, i)):
            if one in partners:
                partners[one].add(other)
    rows = partners[pair.i] & partners[pair.j]
    return tuple(by_row[row] for row in sorted(rows) if row in by_row)


def _surface(
    state: Session, m: MapJob, linked: Sequence[Pair], agreed: Done, images: Sequence[Image], outlines: np.ndarray
) -> Tiles:
    """Bathymetry: cells of each tile, the law of interpolation, then the surface of each tile."""
    size = state.job.parameters.grid.tile_cells
    grid = _map_grid(_bounds(outlines, images), m.cell_m)
    if m.least_seen < 1:  # the limit is ours: what a bend of the whole does to guesses it does to all cells
        m = m._replace(max_sigma_m=round(float(np.hypot(m.max_sigma_m, maps.bend_m(m, agreed))), 6))
    steps = (maps.CELLS, maps.GROWTH, maps.SURFACE)
    for step in steps:
        state.ledger.begin(step)
    footprints, pairs_of = _Footprints(outlines, images), _Pairs(linked)
    tiles = list(grids.tiles(grid, size))
    seen = [(tile, touching) for tile in tiles if (touching := footprints.touching(tile))]
    cell_tasks = []
    for k, (tile, touching) in enumerate(seen):
        described = Tile(tile, touching, pairs_of.images(touching))
        name = state.key(f"cells-{m.cell_m:g}", k)
        cell_tasks.append(delayed(maps.cells_tile)(m, described, agreed, dask_key_name=name))
    cells: list[Done] = compute(state, maps.CELLS, cell_tasks)
    if not any(done.info["sounded"] for done in cells):
        raise NothingToMap(
            "no image gave a laser sounding, and no two images could be linked (without navigation only the laser "
            "gives links their scale): there is nothing to map. Look whether images overlap, and at the laser in "
            "calibration.yaml and in the parameters"
        )
    sounded = [(*one, done) for one, done in zip(seen, cells, strict=True) if done.info["sounded"]]
    placed = _Placed([(tile, done) for tile, _, done in sounded])
    every = -(-len(sounded) // max(1, _GROWTH_CELLS // (size * size)))
    samples = [
        maps.Sample(tile, placed.overlapping(maps.with_halo(m, tile)), outlines[[image.row for image in touching]])
        for tile, touching, _ in sounded[::every]
    ]
    task = delayed(maps.fit_growth)(m, samples, dask_key_name=state.key(f"growth-{m.cell_m:g}"))
    (growth,) = compute(state, maps.GROWTH, [task])
    around = [(tile, placed.overlapping(maps.with_halo(m, tile))) for tile in tiles]
    around = [(tile, near) for tile, near in around if near]  # no others get a value
    surface_tasks = [
        delayed(maps.surface_tile)(m, tile, near, growth, dask_key_name=state.key(f"surface-{m.cell_m:g}", k))
        for k, (tile, near) in enumerate(around)
    ]
    surfaces: list[Done] = compute(state, maps.SURFACE, surface_tasks)
    for step, done in zip(steps, (cells, [growth], surfaces), strict=True):
        state.ledger.end(step, done)
    return Tiles(grid, tuple((tile, done) for (tile, _), done in zip(around, surfaces, strict=True)))


def _map_grid(bounds: grids.Bounds, cell_m: float) -> Grid:
    return grids.pad(grids.grid_around(bounds, cell_m), 2)


def _coarser(state: Session, m: MapJob, ground: Tiles, bounds: grids.Bounds) -> Tiles:
    """Bathymetry on cells coarser than those of the ground."""
    grid, placed = _map_grid(bounds, m.cell_m), _Placed(ground.tiles)
    tiles = [
        (tile, near)
        for tile in grids.tiles(grid, state.job.parameters.grid.tile_cells)
        if (near := placed.overlapping(grids.pad(grids.grid_around(tile.bounds, ground.grid.cell_m), 1)))
    ]
    tasks = [
        delayed(maps.coarse_tile)(m, tile, near, dask_key_name=state.key(f"surface-{m.cell_m:g}", k))
        for k, (tile, near) in enumerate(tiles)
    ]
    done: list[Done] = compute(state, maps.SURFACE, tasks)
    state.ledger.end(maps.SURFACE, done)
    return Tiles(grid, tuple((tile, one) for (tile, _), one in zip(tiles, done, strict=True)))


def _layers(state: Session, m: MapJob, surface: Tiles) -> TerrainLayers:
    """Habitat layers of each tile, then its contours, whose interval is one for the whole map."""
    halo = layers.reach(state.job.parameters.terrain, m.cell_m)
    for step in (layers.TERRAIN, layers.CONTOURS):
        state.ledger.begin(step)

    near = _Placed(surface.tiles).overlapping

    tasks = [
        delayed(layers.terrain_tile)(m, tile, near(grids.pad(tile, halo)), dask_key_name=state.key("terrain", k))
        for k, (tile, _) in enumerate(surface.tiles)
    ]
    made: list[Done] = compute(state, layers.TERRAIN, tasks)
    interval = layers.contour_interval_m(made)
    tasks = [
        delayed(layers.contour_tile)(
            m, tile, near(layers.contour_grid(tile)), interval, dask_key_name=state.key("contours", k)
        )
        for k, (tile, _) in enumerate(surface.tiles)
    ]
    lines: list[Done] = compute(state, layers.CONTOURS, tasks)
    for step, done in ((layers.TERRAIN, made), (layers.CONTOURS, lines)):
        state.ledger.end(step, done)
    tiles = tuple((tile, done) for (tile, _), done in zip(surface.tiles, made, strict=True))
    return TerrainLayers(Tiles(surface.grid, tiles), tuple(lines), interval)


def _lighting(state: Session, m: MapJob, images: Sequence[Image]) -> Done | None:
    if state.job.parameters.mosaic.colour == "none" or not images:
        return None
    state.ledger.begin(mosaics.LIGHTING)
    every = max(1, len(images) // _LIGHTING_IMAGES)
    task = delayed(mosaics.lighting)(m, list(images[::every]), dask_key_name=state.key("lighting"))
    (light,) = compute(state, mosaics.LIGHTING, [task])
    state.ledger.end(mosaics.LIGHTING, [light])
    return light


def _mosaics(
    state: Session,
    m: MapJob,
    images: Sequence[Image],
    outlines: np.ndarray,
    ground: Tiles,
    cell: float,
    light: Done | None,
    posed: Posed,
) -> Tiles:
    """Orthomosaic and planar mosaic on one grid; of images without texture only the grid."""
    grid = grids.grid_around(_bounds(outlines, images), cell)
    shown = [image for image in images if image.texture]
    for step in (mosaics.ALIGN, mosaics.MOSAIC):
        state.ledger.begin(step)
    linked = _Pairs(_linked(posed)).images(shown)
    (aligned,) = compute(
        state, mosaics.ALIGN, [delayed(mosaics.align_planar)(m, shown, linked, dask_key_name=state.key("align"))]
    )
    footprints, placed = _Footprints(outlines, shown, aligned.info["moved_m"]), _Placed(ground.tiles)
    # no more ground below a tile than usual, however coarse the mosaic
    size = min(state.job.parameters.mosaic.tile_cells, max(_LEAST_TEXELS, int(_GROUND_CELLS * m.cell_m / cell)))
    tiles = grids.tiles(grid, size)
    seen = [Tile(tile, touching) for tile in tiles if (touching := footprints.touching(tile))]
    key_alone, tasks = aligned._replace(info={}), []  # its info is of all images
    for k, tile in enumerate(seen):
        near = placed.overlapping(maps.ground_around(tile.grid, m.cell_m, m.hiding_m))
        given = (m, tile, near, key_alone, light)
        tasks.append(delayed(mosaics.mosaic_tile)(*given, dask_key_name=state.key("mosaic", k)))
    done: list[Done] = compute(state, mosaics.MOSAIC, tasks)
    for step, results in ((mosaics.ALIGN, [aligned]), (mosaics.MOSAIC, done)):
        state.ledger.end(step, results)
    return Tiles(grid, tuple((tile.grid, one) for tile, one in zip(seen, done, strict=True)))


def _mesh(
    state: Session,
    m: MapJob,
    images: Sequence[Image],
    outlines: np.ndarray,
    ground: Tiles,
    mosaic: Tiles,
    light: Done | None,
) -> dict[meshing.Place, Done]:
    """The pyramid of mesh tiles, each level from the one below."""
    state.ledger.begin(meshing.MESH)
    footprints, cell = _Footprints(outlines, images), mosaic.grid.cell_m
    grounds, pictured = _Placed(ground.tiles), _Placed(mosaic.tiles)
    found = {place: meshing.leaf_inputs(m, place, cell) for place in meshing.leaves(ground.grid)}
    near = {place: grounds.overlapping(around) for place, (_, around, _) in found.items()}
    finest, *coarser = meshing.levels([place for place in found if near[place]])
    tasks: dict[meshing.Place, Delayed] = {}
    for place in finest:
        own, _, texture = found[place]
        shown, pictures = footprints.touching(own), pictured.overlapping(texture)
        given = (m, place, shown, near[place], pictures, light, cell)
        tasks[place] = delayed(meshing.leaf)(*given, dask_key_name=state.key(f"mesh-{'-'.join(map(str, place))}"))
    below = finest
    for level in coarser:
        children_of: dict[meshing.Place, list[tuple[meshing.Place, Delayed]]] = {}
        for child in below:
            children_of.setdefault(child.parent, []).append((child, tasks[child]))
        for place in level:
            children = children_of[place]
            name = state.key(f"mesh-{'-'.join(map(str, place))}")
            tasks[place] = delayed(meshing.parent)(m, place, children, dask_key_name=name)
        below = level
    made: list[Done] = compute(state, meshing.MESH, list(tasks.values()))
    state.ledger.end(meshing.MESH, made)
    return dict(zip(tasks, made, strict=True))


def heights(
    state: Session, extracted: Mapping[int, Done], matched: Sequence[tuple[int, int, Done]], solution: Solution
) -> np.ndarray:
    """Heights (n,) of all cameras above the seabed by their lasers, metres, or by the altimeter; where there is no
    altimeter, by the lasers of the images before and after, and where there is no laser either, by the matches."""
    count, altitude = len(state.plan.range_m), state.opened.frames["altitude"].values
    told = np.full(count, np.nan)
    for row, done in extracted.items():
        told[row] = done.info.get("range_m") or np.nan
    otherwise = state.plan.range_m
    if not np.isfinite(altitude).any():
        if not np.isfinite(told).any():
            told = _heights_by_matches(state, matched, solution)
        lit = np.flatnonzero(np.isfinite(told))
        otherwise = np.interp(np.arange(count), lit, told[lit]) if len(lit) else otherwise
    return np.where(np.isfinite(told), told, otherwise)


def _heights_by_matches(state: Session, matched: Sequence[tuple[int, int, Done]], solution: Solution) -> np.ndarray:
    """Heights (n,) of cameras over the triangulated matches of some of them; NaN for the others."""
    poses, found = solution.poses, np.full(len(solution.poses.known), np.nan)
    linked = [(i, j, done) for i, j, done in matched if done.info["model"] and poses.known[[i, j]].all()]
    for i, j, done in linked[:: -(-len(linked) // _HEIGHT_PAIRS) or 1]:
        X = dense.triangulated(state.job, poses, i, j, done.key).X_local
        for row in (i, j) if len(X) else ():
            found[row] = np.median((X - poses.C_local[row]) @ poses.R_local_camera[row, :, 2])
    return found
