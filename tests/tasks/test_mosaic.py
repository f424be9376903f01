"""Images of a pattern on simulated ground, put back on the map."""

import numpy as np
import pytest
from seamosaic.tasks import grids, mosaic, nodes, painting, seams
from seamosaic.tasks.frames import LocalAffine, MapFrame
from seamosaic.tasks.grids import Grid
from seamosaic.tasks.terrain import Terrain

from tests.tasks import seabed
from tests.tasks.seabed import CAMERA, pattern, photograph, pose

SAME = LocalAffine(np.eye(3), np.zeros(3))
CELL = 0.006
TILE = Grid(CELL, -100, 90, 200, 180)


flat = -3.0


def rolling(x, y):
    return -3 + 0.25 * np.sin(2.5 * x + 0.5) * np.cos(2 * y)


def terrain_of(height, tile=TILE, halo_m=0.5, cell_m=0.02, local=SAME):
    west, south, east, north = tile.bounds
    grid = grids.grid_around((west - halo_m, south - halo_m, east + halo_m, north + halo_m), cell_m)
    return Terrain(height(*grids.cell_centres(grid)) if callable(height) else np.full(grid.shape, height), grid, local)


def plan_of(tile, terrain, views, feather_m=0.02, **options):
    shots = [(seabed.shot_of(view), nodes.lie(terrain.local, *view[3:5])) for view in views]
    return seams.plan(tile, nodes.ground(tile, terrain), shots, feather_m=feather_m, **options)


def compose(tile, terrain, views, feather_m=0.02):
    return seabed.compose([plan_of(tile, terrain, views, feather_m)], views)[0]


def truth(tile, origin=(0.0, 0.0)):
    x, y = grids.cell_centres(tile)
    return np.moveaxis(pattern(x - origin[0], y - origin[1]), 2, 0)


def shift_px(found, expected, mask):
    """Displacement (x, y) in cells between two pictures, by the gradient of the expected one."""
    gy, gx = np.gradient(expected.astype(float))
    A = np.column_stack([gx[mask], gy[mask]])
    return np.linalg.lstsq(A, (expected - found)[mask], rcond=None)[0]


@pytest.mark.parametrize(
    ("attitude", "mount", "height"),
    [
        ((0, 0, 0), (0, 0, 0), flat),
        ((35, 0, 0), (0, 0, 0), flat),
        ((-110, 3, -4), (0.4, -0.6, 0.5), rolling),
        ((200, -5, 2), (4, 3, 90), rolling),
    ],
)
def test_the_pattern_comes_back_in_its_place(attitude, mount, height):
    heading, roll, pitch = attitude
    view = photograph(*pose(0.1, -0.05, 0.0, heading, roll, pitch, mount), height, 7)
    result = compose(TILE, terrain_of(height), [view])
    error = np.abs(result.rgb - truth(TILE))[:, result.mask]
    assert result.mask.mean() > 0.9
    assert np.quantile(error, 0.99) < 4
    for band in range(3):
        shift = shift_px(result.rgb[band].astype(float), truth(TILE)[band], result.mask)
        assert np.abs(shift).max() < 0.1
    assert set(np.unique(result.source[result.mask])) == {7}
    assert (result.source[~result.mask] == -1).all()
    assert (result.rgb[:, ~result.mask] == 0).all()


def test_the_map_is_turned_by_its_meridian_convergence():
    frame = MapFrame("EPSG:32631", 43.04, 6.01)
    origin = frame.map_from_local(np.zeros((1, 3)))[0]
    tile = grids.grid_around((origin[0] - 0.5, origin[1] - 0.45, origin[0] + 0.5, origin[1] + 0.45), CELL)
    view = photograph(*pose(0.1, -0.05, 0.0, 35), flat, 0)
    result = compose(tile, terrain_of(flat, tile, local=frame.affine_at(origin)), [view])
    x, y = grids.cell_centres(tile)
    X = frame.local_from_map(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -3.0)]))
    expected = np.moveaxis(pattern(*X[:, :2].T).reshape(*tile.shape, 3), 2, 0)
    assert result.mask.all()
    assert np.quantile(np.abs(result.rgb - expected), 0.99) < 4
    # two degrees would have been seen
    assert np.quantile(np.abs(result.rgb - truth(tile, origin)), 0.9) > 4


def two_views(height=flat):
    left = photograph(*pose(-0.35, 0.0, 0.0, 20), height, 3)
    right = photograph(*pose(0.35, 0.0, 0.0, -15), height, 4)
    return left, right


def test_each_cell_is_of_the_closest_image_whatever_their_order():
    left, right = two_views()
    right = right._replace(image=np.full_like(right.image, 200))
    left = left._replace(image=np.full_like(left.image, 100))
    result = compose(TILE, terrain_of(flat), [left, right])
    x, _ = grids.cell_centres(TILE)
    assert (result.source[x < -0.01] == 3).all()
    assert (result.source[x > 0.01] == 4).all()
    assert (result.rgb[:, x < -0.1] == 100).all()
    assert (result.rgb[:, x > 0.1] == 200).all()
    # blended over a few centimetres
    assert 4 < ((result.rgb[0, 90] > 105) & (result.rgb[0, 90] < 195)).sum() < 25
    other = compose(TILE, terrain_of(flat), [right, left])
    np.testing.assert_array_equal(other.source, result.source)
    assert np.abs(other.rgb.astype(int) - result.rgb).max() <= 1


def test_the_erased_laser_is_taken_from_the_other_image():
    left, right = two_views()
    left.image[:, 160:176] = 0, 255, 0
    left.erase[:, 158:178] = True
    result = compose(TILE, terrain_of(flat), [left, right])
    assert np.quantile(np.abs(result.rgb - truth(TILE))[:, result.mask], 0.999) < 6
    x, _ = grids.cell_centres(TILE)
    assert ((result.source == 4) & (x < -0.1)).sum() > 500
    assert not result.painted.any()
    # alone, it is painted over: no green, and not far from what is there
    alone = compose(TILE, terrain_of(flat), [left])
    error = np.abs(alone.rgb - truth(TILE))[:, alone.mask]
    assert error.max() < 120
    assert np.quantile(error, 0.99) < 60
    red, green, blue = compose(TILE, terrain_of(flat), [left._replace(erase=np.zeros_like(left.erase))]).rgb.astype(int)
    assert alone.painted[green - np.maximum(red, blue) > 200].all()  # and said so
    assert 0.02 < alone.painted.mean() < 0.15
    assert (alone.mask == compose(TILE, terrain_of(flat), [left._replace(erase=np.zeros_like(left.erase))]).mask).all()


def wall(x, y):
    return -3 + 0.6 * ((np.abs(x - 0.1) < 0.15) & (np.abs(y) < 0.3))


def test_what_terrain_hides_is_taken_from_the_image_that_sees_it():
    near = photograph(*pose(-0.3, 0.0, 0.0), wall, 0)
    far = photograph(*pose(1.3, 0.0, 0.0, 180), wall, 1)
    result = compose(TILE, terrain_of(wall), [near, far])
    x, y = grids.cell_centres(TILE)
    shadow = (x > 0.29) & (x < 0.36) & (np.abs(y) < 0.25)
    assert (result.source[shadow] == 1).all()
    error = np.abs(result.rgb - truth(TILE)).max(0)
    assert np.quantile(error[shadow], 0.9) < 12
    # beyond the shadow the nearer image serves again, and where nothing else is to be had the hidden one does
    assert (result.source[(x > 0.42) & (x < 0.47) & (np.abs(y) < 0.2)] == 0).mean() > 0.9
    only = compose(TILE, terrain_of(wall), [near])
    assert only.mask[shadow].all()
    assert not only.painted.any()  # hidden is not lit
    assert np.median(np.abs(only.rgb - truth(TILE)).max(0)[shadow]) > 12


def test_mosaics_of_tiles_are_the_mosaic():
    views = [*two_views(rolling), photograph(*pose(0.0, 0.3, 0.1, 100, 4, 3), rolling, 9)]
    views[0].erase[100:120] = True
    terrain = terrain_of(rolling)
    whole = compose(TILE, terrain, views)
    for tile in grids.tiles(TILE, 64):
        at = grids.window(TILE, tile)
        west, south, east, north = tile.bounds
        around = grids.grid_around((west - 0.3, south - 0.3, east + 0.3, north + 0.3), terrain.grid.cell_m)
        part = grids.intersection(terrain.grid, around)
        assert part is not None
        window = grids.window(terrain.grid, part)
        result = compose(tile, Terrain(terrain.elevation[window], part, SAME), views)
        np.testing.assert_array_equal(result.rgb, whole.rgb[:, at[0], at[1]])
        np.testing.assert_array_equal(result.source, whole.source[at])
        np.testing.assert_array_equal(result.mask, whole.mask[at])
        np.testing.assert_array_equal(result.painted, whole.painted[at])


def test_coarse_cells_average_pixels():
    def stripes(x, y):
        bright = 127 + 127 * np.sin(2 * np.pi * x / 0.02)
        return np.stack([bright] * 3, -1) + 0 * y[..., None]

    coarse = Grid(0.05, -10, 9, 20, 18)
    view = photograph(*pose(0.0, 0.0, 0.0), flat, 0, paint=stripes)
    result = compose(coarse, terrain_of(flat, coarse), [view])
    assert view.image.std() > 40
    assert result.rgb.std() < 15
    assert abs(result.rgb.mean() - 127) < 3


def test_no_laser_is_mixed_into_coarse_cells():
    coarse, (left, _) = Grid(0.05, -10, 9, 20, 18), two_views()
    assert mosaic.reduction(CAMERA, 3.0, 0.05) > nodes.quality_scale(CAMERA)
    clean = compose(coarse, terrain_of(flat, coarse), [left])
    left.image[:, 162:174] = 0, 255, 0
    left.erase[:, 161:175] = True
    found = compose(coarse, terrain_of(flat, coarse), [left])
    off = np.abs(found.rgb.astype(int) - clean.rgb)[:, found.mask]
    assert 0 < off.max() < 60


def test_holes_in_the_surface_and_images_elsewhere_leave_nothing():
    view = photograph(*pose(0.0, 0.0, 0.0), flat, 0)
    terrain = terrain_of(flat)
    terrain.elevation[20:40, 30:60] = np.nan
    result = compose(TILE, terrain, [view, view._replace(C_local=view.C_local + np.array([50.0, 0, 0]))])
    x, y = grids.cell_centres(terrain.grid)
    west, east, south, north = x[0, 30], x[0, 59], y[39, 0], y[20, 0]
    x, y = grids.cell_centres(TILE)
    hole = (x > west) & (x < east) & (y > south) & (y < north)
    assert not result.mask[hole].any()
    assert result.mask[(x < west - 0.03)].mean() > 0.95
    x, _ = grids.cell_centres(terrain.grid)
    half = Terrain(np.where(x < -0.3, terrain.elevation, np.nan), terrain.grid, SAME)
    wide = Grid(CELL, -100, 90, 600, 180)
    over_nothing = view._replace(C_local=view.C_local + np.array([2.6, 0, 0]), number=1)
    assert {laid.shot.number for laid in plan_of(wide, half, [view, over_nothing]).laid} == {0}
    nothing = compose(TILE, Terrain(np.full_like(terrain.elevation, np.nan), terrain.grid, SAME), [view])
    assert not nothing.mask.any()


def test_a_tile_that_is_mostly_above_the_camera():
    """Beside a cliff: what the image sees decides, not the ground behind and above it."""

    def cliff(x, y):
        return np.where(x < -0.35, -3.0, 5.0) + 0 * y

    view = photograph(*pose(-0.6, 0.0, 0.0), flat, 0)
    result = compose(TILE, terrain_of(cliff), [view])
    x, _ = grids.cell_centres(TILE)
    assert 0.1 < result.mask.mean() < 0.4
    assert not result.mask[x > -0.3].any()
    above = terrain_of(lambda x, y: 5.0 + 0 * x)
    assert not compose(TILE, above, [view]).mask.any()


def test_an_image_with_the_horizon_serves_below_it():
    R, C = pose(0.0, -1.5, -1.0, 0, 0, 45)
    view = photograph(R, C, -2.0, 0)
    result = compose(TILE, terrain_of(-2.0), [view])
    assert result.mask.mean() > 0.5
    assert np.quantile(np.abs(result.rgb - truth(TILE))[:, result.mask], 0.95) < 12


def test_paint_over_fills_from_around():
    ramp = np.repeat(np.linspace(20, 220, CAMERA.width)[None, :, None], CAMERA.height, 0).repeat(3, 2).astype(np.uint8)
    erase = np.zeros(ramp.shape[:2], bool)
    erase[:, 180:200] = True
    erase[140:160] = True
    spoilt = np.where(erase[..., None], np.uint8(255), ramp)
    painted = painting.paint_over(spoilt, erase)
    error = np.abs(painted.astype(int) - ramp)
    assert (error[~erase] == 0).all()
    assert 0 < error.max() < 20
    assert painting.paint_over(spoilt, np.zeros_like(erase)) is spoilt


def test_images_that_count_nowhere_are_not_read():
    left, right = two_views()
    behind = photograph(
        *pose(-0.33, 0.0, 0.9, 20), flat, 8
    )  # as near as left, but outside of its image there is nothing
    away = left._replace(C_local=left.C_local + np.array([50.0, 0, 0]), number=9)
    made = plan_of(TILE, terrain_of(flat), [left, right, behind, away])
    assert [laid.shot.number for laid in made.laid] == [3, 4, 8]
    west = Grid(CELL, -200, 30, 60, 60)
    made = plan_of(west, terrain_of(flat, west), [left, right])
    assert [laid.shot.number for laid in made.laid] == [3]


def test_mosaics_share_what_is_read():
    views = list(two_views())
    plans = [plan_of(TILE, terrain_of(flat), views), plan_of(TILE, terrain_of(flat), views[:1])]
    both = seabed.compose(plans, views)  # asserts that no image is asked for twice
    for made, alone in zip(both, (views, views[:1]), strict=True):
        np.testing.assert_array_equal(made.rgb, compose(TILE, terrain_of(flat), alone).rgb)


def plain_tone(u, v, range_m):
    return np.ones((*u.shape, 3), np.float32), np.zeros((*u.shape, 3), np.float32)


def seam_step(rgb):
    """How much brighter it is just right of the seam at x = 0 than just left of it, as a share."""
    x, _ = grids.cell_centres(TILE)
    left, right = (rgb[:, (x > low) & (x < low + 0.03)].mean() for low in (-0.06, 0.03))
    return right / left - 1


@pytest.mark.parametrize("count", [1, 2, 7, 300])
def test_shares_of_all_images_add_up(count):
    rng = np.random.default_rng(count)
    costs = rng.uniform(0, 0.1, (count, 128, 128)).astype(np.float32)
    costs[rng.random(costs.shape) < 0.4] = np.inf
    costs[:, :20, :30] = np.inf
    lowest, first = seams._lowest(list(costs))
    seen = np.isfinite(lowest)
    shares = list(seams._shares(list(costs), np.where(seen, lowest, np.float32(0)), first, seen, 0.02))
    assert {share.dtype for share in shares} == {np.dtype(np.uint8)}
    assert (np.sum(shares, axis=0, dtype=int) == np.where(seen, 255, 0)).all()
    assert all((share[np.isinf(cost)] == 0).all() for share, cost in zip(shares, costs, strict=True))


@pytest.mark.parametrize("ground_cell_m", [0.02, 0.024, 0.05, 0.006])  # nodes 2, 4, 8 and 1 cells apart
def test_images_are_looked_at_only_where_they_count(ground_cell_m):
    views = two_views(rolling)
    made = plan_of(TILE, terrain_of(rolling, cell_m=ground_cell_m), views)
    whole = (slice(0, nodes.BLOCK), slice(0, nodes.BLOCK))

    def unfolded(patch):
        weight = np.zeros((nodes.BLOCK, nodes.BLOCK), np.uint8)
        weight[patch.part] = 255 if patch.weight is None else patch.weight
        return patch._replace(part=whole, weight=weight)

    laid = [one._replace(patches=[unfolded(patch) for patch in one.patches]) for one in made.laid]
    assert any(patch.part != whole for one in made.laid for patch in one.patches)
    parts, wholes = seabed.compose([made, made._replace(laid=tuple(laid))], views)
    np.testing.assert_array_equal(parts.rgb, wholes.rgb)


def test_what_is_left_of_the_lighting_makes_no_seam():
    left, right = two_views()
    left, right = (view._replace(image=np.full_like(view.image, level)) for view, level in ((left, 100), (right, 120)))
    results = []
    for evened in (False, True):
        thumbnails = [np.full((24, 32, 3), level / 255, np.float32) if evened else None for level in (100, 120)]
        terrain = terrain_of(flat)
        shots = [
            (seabed.shot_of(view, small), nodes.lie(terrain.local, *view[3:5]))
            for view, small in zip((left, right), thumbnails, strict=True)
        ]
        made = seams.plan(TILE, nodes.ground(TILE, terrain), shots, plain_tone)
        results.append(seabed.compose([made], [left, right])[0].rgb)
    assert seam_step(results[0]) > 0.15
    assert 0.01 < seam_step(results[1]) < 0.08  # spread over decimetres
    for rgb in results:  # far from it, the images are as they were
        assert (rgb[:, 90, 5] == 100).all()
        assert np.abs(rgb[:, 90, -5].astype(int) - 120).max() <= 1


def test_light_is_what_is_mixed():
    """Half of each of two greys is the grey of their mean light, not of their mean level."""
    left, right = (
        view._replace(image=np.full_like(view.image, k)) for view, k in zip(two_views(), (40, 200), strict=True)
    )
    terrain = terrain_of(flat)
    made = plan_of(TILE, terrain, [left, right], feather_m=0.3)
    mixed = seabed.compose([made], [left, right], gamma=2.2)[0].rgb[0, 90]
    levels = seabed.compose([made], [left, right])[0].rgb[0, 90]
    half = np.abs(levels.astype(int) - 120) <= 8
    assert half.sum() > 3
    assert np.abs(mixed[half] - 255 * (((40 / 255) ** 2.2 + (200 / 255) ** 2.2) / 2) ** (1 / 2.2)).max() < 12
    assert (mixed[half] > levels[half] + 20).all()


def test_a_steep_side_is_shown_by_the_image_that_faces_it():
    def ramp(x, y):
        return -3 + np.clip(1.2 * (x - 0.0), 0, 0.25)

    def sources(height):
        facing, above = photograph(*pose(-0.32, 0.0, 0.0), height, 0), photograph(*pose(0.48, 0.0, 0.0), height, 1)
        return compose(TILE, terrain_of(height), [facing, above]).source

    x, y = grids.cell_centres(TILE)
    side = (x > 0.09) & (x < 0.13) & (np.abs(y) < 0.3)
    assert (sources(ramp)[side] == 0).mean() > 0.9
    assert (sources(flat)[side] == 0).mean() < 0.3


def test_many_images_of_one_place_are_no_brighter_than_one():
    """A vehicle at rest: shares of 255 must not add up to more."""
    first = photograph(*pose(0.0, 0.0, 0.0, 20), flat, 0)
    views = [first._replace(number=k, image=np.full_like(first.image, 100)) for k in range(95)]
    result = compose(TILE, terrain_of(flat), views)
    assert result.mask.mean() > 0.5
    assert np.abs(result.rgb[:, result.mask].astype(int) - 100).max() <= 1
