import numpy as np
from seamosaic.tasks import grids, terrain
from seamosaic.tasks.frames import LocalAffine
from seamosaic.tasks.grids import Grid

SAME = LocalAffine(np.eye(3), np.zeros(3))


def hidden(ground, cells, camera):
    return terrain.hidden(ground, terrain.horizon(ground), cells, camera) > 0.5


def test_the_horizon_leaves_out_nothing_that_is_hidden():
    rng = np.random.default_rng(3)
    grid = Grid(0.02, 0, 0, 120, 90)
    ground = terrain.Terrain(-10 + np.kron(rng.uniform(0, 0.4, (9, 12)), np.ones((10, 10))), grid, SAME)
    ground.elevation[40:50, 20:40] = np.nan
    steepest = terrain.horizon(ground)
    for camera in ([0.3, -0.5, -8.5], [2.0, -1.5, -9.5], [1.2, -0.9, -6.0]):
        found = terrain.hidden(ground, steepest, grid, np.array(camera))
        all_rays = terrain.hidden(ground, np.full(grid.shape, np.inf), grid, np.array(camera))
        assert (found > 0.5).sum() > 20
        np.testing.assert_array_equal(found, all_rays)
    level = terrain.horizon(terrain.Terrain(np.full(grid.shape, -10.0), grid, SAME))
    assert (level < 0).all()


def test_slopes_are_those_of_a_plane():
    grid = Grid(0.1, 70_000_000, 480_000_000, 30, 20)
    x, y = grids.cell_centres(grid)
    z = 0.3 * (x - x[0, 0]) - 0.2 * (y - y[0, 0])
    z[4:9, 4:9] = np.nan
    east, north = terrain.slopes(terrain.Terrain(z, grid, SAME))
    assert (east[6, 6], north[6, 6]) == (0, 0)
    known = np.isfinite(z)
    np.testing.assert_allclose(east[known], 0.3, atol=1e-6)
    np.testing.assert_allclose(north[known], -0.2, atol=1e-6)


def test_resample_is_exact_on_a_plane_and_leaves_holes():
    coarse = Grid(0.1, 70_000_000, 480_000_000, 30, 20)
    x, y = grids.cell_centres(coarse)
    values = 3 * (x - x[0, 0]) - 2 * (y - y[0, 0])
    values[10:15, 10:15] = np.nan
    fine = Grid(0.01, coarse.left * 10 + 20, coarse.top * 10 - 20, 260, 160)
    fx, fy = grids.cell_centres(fine)
    found = terrain.resample(values, coarse, fine)
    hole = (np.abs(fx - x[12, 12]) < 0.195) & (np.abs(fy - y[12, 12]) < 0.195)
    assert np.isnan(found[hole]).all()
    far = (np.abs(fx - x[12, 12]) > 0.31) | (np.abs(fy - y[12, 12]) > 0.31)
    np.testing.assert_allclose(found[far], (3 * (fx - x[0, 0]) - 2 * (fy - y[0, 0]))[far], atol=1e-6)


def test_resample_has_no_values_outside():
    coarse = Grid(0.1, 0, 0, 4, 4)
    found = terrain.resample(np.ones((4, 4)), coarse, grids.pad(Grid(0.1, 0, 0, 4, 4), 3))
    assert np.isfinite(found).sum() == 16
    assert (found[3:7, 3:7] == 1).all()


def test_a_box_throws_its_shadow_away_from_the_camera():
    grid = Grid(0.02, 0, 0, 200, 100)
    x, y = grids.cell_centres(grid)
    box = (np.abs(x - 2.0) < 0.25) & (np.abs(y + 1.0) < 0.25)
    ground = terrain.Terrain(np.where(box, -9.5, -10.0), grid, SAME)
    camera = np.array([0.5, -1.0, -8.0])
    found = hidden(ground, grid, camera)
    row = found[50]
    # the ray over the far edge at (2.25, -9.5) from (0.5, -8) meets the ground 0.583 m behind it
    shadow = x[50][row]
    assert 2.22 < shadow.min() < 2.32
    assert abs(shadow.max() - (2.25 + 0.5 * 1.75 / 1.5)) < 0.07
    assert not found[:, x[0] < 1.7].any()
    assert not found[(np.abs(y + 1.0) > 0.6)].any()
    assert not hidden(ground, grid, np.array([2.0, -1.0, 50.0])).any()


def test_rough_ground_does_not_hide_itself_from_above():
    rng = np.random.default_rng(0)
    grid = Grid(0.02, 0, 0, 100, 100)
    x, _ = grids.cell_centres(grid)
    ground = terrain.Terrain(-10 + 0.6 * x + rng.normal(0, 0.005, grid.shape), grid, SAME)
    assert hidden(ground, grid, np.array([1.0, -1.0, -6.5])).mean() < 0.001


def test_hidden_cells_do_not_depend_on_the_window_asked_for():
    rng = np.random.default_rng(1)
    grid = Grid(0.02, 0, 0, 120, 120)
    blocks = np.kron(rng.uniform(0, 0.4, (12, 12)), np.ones((10, 10)))
    ground = terrain.Terrain(-10 + blocks, grid, SAME)
    camera = np.array([0.3, -0.5, -8.5])
    fine = Grid(0.005, 80, -80, 320, 320)
    whole = hidden(ground, fine, camera)
    assert 0.02 < whole.mean() < 0.5
    for tile in grids.tiles(fine, 100):
        np.testing.assert_array_equal(hidden(ground, tile, camera), whole[grids.window(fine, tile)])


def test_no_terrain_hides_nothing():
    grid = Grid(0.02, 0, 0, 10, 10)
    empty = terrain.Terrain(np.full(grid.shape, np.nan), grid, SAME)
    assert not hidden(empty, grid, np.array([0.0, 0.0, 5.0])).any()
    assert not hidden(empty, Grid(0.02, 500, 500, 10, 10), np.array([0.0, 0.0, 5.0])).any()
