import numpy as np
import pytest
from seamosaic.tasks import gridding, grids, surface
from seamosaic.tasks.grids import Grid
from seamosaic.tasks.surface import Growth

GRID = Grid(0.05, 9_999_960, 93_999_950, 120, 100)
WEST, SOUTH = GRID.bounds.west, GRID.bounds.south
GROWTH = Growth(0.05, 0.7, 0.4)


def lines(rng, z, grid=GRID, spacing=0.5, noise=0.0, tilt=0.35):
    """Soundings along slanting lines, as the arms of crosses leave them."""
    b = grid.bounds
    along = np.arange(b.west - 1, b.east + 1, 0.004)
    starts = [(sign, y) for sign in (-1, 1) for y in np.arange(b.south - 3, b.north + 3, spacing)]
    across = [y + sign * tilt * (along - b.west) + rng.normal(0, 0.005, len(along)) for sign, y in starts]
    parts = [np.column_stack([along, y]) for y in across]
    xy = np.concatenate(parts)
    return np.column_stack([xy, z(*xy.T) + rng.normal(0, noise, len(xy))])


def gridded(X, grid=GRID, sigma=0.002, source=1):
    n = len(X)
    frame, pose, doubtful = np.zeros(n, int), np.full(n, 0.001), np.zeros(n, bool)
    soundings = gridding.Soundings(X, np.full(n, sigma), np.full(n, source, np.uint8), frame, pose, doubtful)
    return gridding.grid_soundings(grid, soundings)


def test_a_slope_is_recovered_exactly_between_and_on_the_soundings():
    plane = lambda x, y: -10 + 0.8 * (x - WEST) - 0.5 * (y - SOUTH)  # noqa: E731
    cells = gridded(lines(np.random.default_rng(0), plane))
    result = surface.delaunay_surface(GRID, cells, 0.5, GROWTH)
    error = result.elevation - plane(*grids.cell_centres(GRID))
    inner = (slice(5, -5), slice(5, -5))
    assert np.isfinite(result.elevation[inner]).all()
    assert np.nanmax(np.abs(error[inner])) < 2e-5
    assert set(np.unique(result.source[inner])) == {1, 3}
    assert ((result.source == 1) == (cells.density > 0)).all()


@pytest.mark.parametrize("spacing", [0.5, 0.03])
def test_a_bump_is_recovered_better_from_more_lines(spacing):
    bump = lambda x, y: -10 + 0.3 * np.exp(-((x - WEST - 3) ** 2 + (y - SOUTH - 2.5) ** 2) / 0.5)  # noqa: E731
    result = surface.delaunay_surface(
        GRID, gridded(lines(np.random.default_rng(0), bump, spacing=spacing)), 0.5, GROWTH
    )
    error = (result.elevation - bump(*grids.cell_centres(GRID)))[5:-5, 5:-5]
    rms = np.sqrt(np.mean(error**2))
    assert (0.001 < rms < 0.008) if spacing == 0.5 else (1e-5 < rms < 0.0012)


def test_densely_sounded_cells_are_carried_to_their_centres():
    plane = lambda x, y: -10 + 1.0 * (x - WEST)  # noqa: E731
    rng = np.random.default_rng(1)
    X, Y = grids.cell_centres(GRID)
    xy = np.column_stack([X.ravel(), Y.ravel()]) + rng.uniform(-0.024, 0.024, (X.size, 2))
    cells = gridded(np.column_stack([xy, plane(*xy.T)]))
    assert np.nanstd(cells.elevation - plane(X, Y)) > 0.01
    result = surface.delaunay_surface(GRID, cells, 0.5, GROWTH)
    assert np.nanmax(np.abs(result.elevation - plane(X, Y))[3:-3, 3:-3]) < 2e-5


def test_the_faces_of_a_box_stay_steep():
    box = lambda x, y: -10 + 0.225 * ((np.abs(x - WEST - 3) < 1) & (np.abs(y - SOUTH - 2.5) < 1))  # noqa: E731
    result = surface.delaunay_surface(GRID, gridded(lines(np.random.default_rng(2), box, spacing=0.03)), 0.5, GROWTH)
    profile = result.elevation[50, 20:100]
    between = (profile > -9.99) & (profile < -10 + 0.215)
    assert between.sum() <= 4
    assert profile.min() > -10.001
    assert profile.max() < -10 + 0.226
    assert np.isclose(profile, -10 + 0.225, atol=1e-3).sum() == pytest.approx(40, abs=3)


def test_nothing_is_filled_far_from_soundings_or_across_empty_areas():
    rng = np.random.default_rng(3)
    X = lines(rng, lambda x, y: 0 * x - 10, spacing=0.3)
    hole = np.hypot(X[:, 0] - WEST - 3, X[:, 1] - SOUTH - 2.5) < 1.5
    cells = gridded(X[~hole])
    result = surface.delaunay_surface(GRID, cells, 0.5, GROWTH)
    x, y = grids.cell_centres(GRID)
    r = np.hypot(x - WEST - 3, y - SOUTH - 2.5)
    assert np.isnan(result.elevation[r < 0.9]).all()
    assert np.isfinite(result.elevation[(r > 1.7) & (r < 2.2)]).all()
    assert (result.source[np.isnan(result.elevation)] == 0).all()
    assert (np.isnan(result.sigma) == np.isnan(result.elevation)).all()
    # the same hole is bridged when it may be
    assert np.isfinite(surface.delaunay_surface(GRID, cells, 1.7, GROWTH).elevation[r < 1.4]).all()


def rough(seed, grid, amplitude=0.05):
    """A rough seabed: sum of waves, as a function of the place."""
    rng = np.random.default_rng(seed)
    wave = 2 * np.pi / np.exp(rng.uniform(np.log(0.1), np.log(4), 60))
    heading, phase = rng.uniform(0, 2 * np.pi, (2, 60))
    size = amplitude * (wave / wave.min()) ** -1.3
    b = grid.bounds

    def z(x, y):
        x, y = np.asarray(x) - b.west, np.asarray(y) - b.south
        waves = (
            s * np.sin(k * (x * np.cos(h) + y * np.sin(h)) + p)
            for s, k, h, p in zip(size, wave, heading, phase, strict=True)
        )
        return -10 + sum(waves)

    return z


def test_sigma_says_how_far_off_interpolation_is():
    z = rough(4, GRID)
    cells = gridded(lines(np.random.default_rng(4), z, spacing=1.0, noise=0.002))
    growth = surface.fit_growth(surface.hold_out(GRID, cells, 1.0))
    result = surface.delaunay_surface(GRID, cells, 1.0, growth)
    error = np.abs(result.elevation - z(*grids.cell_centres(GRID)))
    filled = result.source == gridding.INTERPOLATED
    assert filled.sum() > 4000
    assert 0.55 < np.mean(error[filled] < result.sigma[filled]) < 0.85
    # and which of the cells are worse
    low, high = np.quantile(result.sigma[filled], [0.25, 0.75])
    assert np.mean(error[filled & (result.sigma > high)]) > 2 * np.mean(error[filled & (result.sigma < low)])


def test_guesses_are_what_the_sigma_of_the_surface_comes_from():
    z = rough(4, GRID)
    cells = gridded(lines(np.random.default_rng(4), z, spacing=1.0, noise=0.002))
    growth = Growth(0.08, 0.7, 0.3)
    result = surface.delaunay_surface(GRID, cells, 0.4, growth)
    own, distance, spread = surface.guesses(GRID, cells, 0.4)
    sigma = np.hypot(own, surface.growth_sigma(growth, distance, spread))
    empty = cells.density == 0
    assert 0.1 < np.isnan(sigma[empty]).mean() < 0.9
    np.testing.assert_array_equal(sigma[empty], result.sigma[empty])
    np.testing.assert_array_equal(sigma[~empty], cells.sigma[~empty])


def test_growth_is_found_again():
    rng = np.random.default_rng(5)
    truth = Growth(0.08, 0.7, 0.3)
    distance, spread = rng.uniform(0.01, 1, 8000), rng.exponential(0.05, 8000)
    error = np.abs(rng.normal(0, surface.growth_sigma(truth, distance, spread)))
    found = surface.fit_growth(surface.Holdout(error, distance, spread))
    assert found.scale_m == pytest.approx(0.08, rel=0.1)
    assert found.exponent == pytest.approx(0.7, abs=0.1)
    assert found.relief == pytest.approx(0.3, rel=0.3)
    assert surface.fit_growth(surface.Holdout(error[:5], distance[:5], spread[:5])) == Growth()


def test_the_surface_does_not_depend_on_tiling():
    z = rough(6, GRID)
    X = lines(np.random.default_rng(6), z, spacing=0.4, noise=0.003)
    # part of the ground is sounded densely, on a perfect raster, where a triangulation is a toss-up
    x, y = grids.cell_centres(Grid(0.025, *(2 * v for v in GRID[1:])))
    dense = (np.abs(x - WEST - 4) < 1) & (np.abs(y - SOUTH - 2) < 1)
    X = np.concatenate([X, np.column_stack([x[dense], y[dense], z(x[dense], y[dense])])])
    whole_grid = grids.pad(GRID, surface.halo_cells(0.3, GRID.cell_m))
    whole = surface.delaunay_surface(whole_grid, gridded(X, whole_grid), 0.3, GROWTH)
    for tile in grids.tiles(GRID, 40):
        with_halo = grids.pad(tile, surface.halo_cells(0.3, GRID.cell_m))
        part = surface.delaunay_surface(with_halo, gridded(X, with_halo), 0.3, GROWTH)
        for a, b in zip(part, whole, strict=True):
            np.testing.assert_array_equal(a[grids.window(with_halo, tile)], b[grids.window(whole_grid, tile)])
    assert np.isnan(whole.elevation).sum() < 0.6 * whole.elevation.size


@pytest.mark.parametrize("count", [0, 1, 3, 40])
def test_too_few_soundings_or_all_in_a_line_make_no_surface(count):
    x = WEST + np.linspace(0.01, 4, count)
    cells = gridded(np.column_stack([x, np.full(count, SOUTH + 1.01), np.full(count, -3.0)]))
    result = surface.delaunay_surface(GRID, cells, 1.0, GROWTH)
    assert (np.isfinite(result.elevation) == (cells.density > 0)).all()
    assert not len(surface.hold_out(GRID, cells, 1.0).error_m)


def test_what_is_no_more_than_a_guess_stays_empty():
    cells = gridded(lines(np.random.default_rng(0), lambda x, y: -10 + 0 * x))
    result = surface.delaunay_surface(GRID, cells, 0.5, GROWTH)
    limit = float(np.nanmedian(result.sigma[result.source == 3]))
    kept = surface.without_guesses(result, limit)
    gone = np.isfinite(result.elevation) & np.isnan(kept.elevation)
    assert 0.4 < gone.sum() / (result.source == 3).sum() < 0.6
    assert (result.source[gone] == 3).all()
    assert (kept.source[gone] == 0).all()
    assert np.isnan(kept.sigma[gone]).all()
    assert np.nanmax(kept.sigma[kept.source == 3]) <= limit
    assert np.array_equal(kept.elevation[~gone], result.elevation[~gone], equal_nan=True)


def test_no_more_guesses_are_shown_than_it_takes():
    sigma = np.concatenate([np.zeros(500), np.linspace(0.001, 0.04, 450), np.full(50, np.nan)])
    worst = surface.worst_shown(sigma, 0.8, 0.05)
    assert np.mean(sigma <= worst) == pytest.approx(0.8, abs=0.002)
    assert surface.worst_shown(sigma, 0.8, 0.01) == 0.01
    # where nothing reaches enough ground, all is shown that is certain enough
    assert surface.worst_shown(sigma, 0.99, 0.05) == 0.05
    assert surface.worst_shown(np.zeros(0), 0.9, 0.05) == 0.05
    # nor less than is as certain as what was sounded: a pinhole is no guess
    sounded = np.concatenate([np.linspace(0.001, 0.003, 970), [0.002] * 30])
    assert 0.0027 < surface.worst_shown(sounded, 0.91, 0.05) < 0.0029
    # what the user allows is shown
    assert surface.worst_shown(sounded, 1.0, 0.05) == 0.05


def test_ground_is_seen_where_an_outline_has_it():
    b = GRID.bounds
    square = np.array([[1, 1], [3, 1], [3, 2], [1, 2]], float) + (b.west, b.south)
    x, y = grids.cell_centres(GRID)
    within = (x - b.west > 1) & (x - b.west < 3) & (y - b.south > 1) & (y - b.south < 2)
    found = surface.seen(GRID, square[None])
    assert (found & within).sum() > 0.99 * within.sum()
    assert found.sum() < 1.12 * within.sum()
    assert not surface.seen(GRID, square[None] + 100).any()


def test_a_long_tail_widens_the_growth_halfway():
    rng = np.random.default_rng(7)
    distance, spread = rng.uniform(0.01, 1, 20_000), np.zeros(20_000)
    scale = 0.05 * distance**0.6
    normal, heavy = rng.normal(0, 1, 20_000), rng.standard_t(2, 20_000)
    heavy /= np.quantile(np.abs(heavy), 0.6827)
    one, other = (
        surface.fit_growth(surface.Holdout(np.abs(scale * error), distance, spread)) for error in (normal, heavy)
    )
    assert one.scale_m == pytest.approx(0.05, rel=0.06)
    assert 1.1 < other.scale_m / one.scale_m < 1.6
    within = np.mean(np.abs(scale * heavy) < 2 * surface.growth_sigma(other, distance, spread))
    assert 0.92 < within < 0.98


def test_what_is_not_counted_is_left_out_of_the_work_only():
    rng = np.random.default_rng(2)
    relief = lambda x, y: -10 + 0.2 * np.sin(3 * x) * np.cos(2 * y)  # noqa: E731
    X, Y = grids.cell_centres(GRID)
    dense = rng.permutation(X.size)[: X.size // 2]
    xy = np.column_stack([X.ravel(), Y.ravel()])[dense]
    cells = gridded(np.concatenate([lines(rng, relief), np.column_stack([xy, relief(*xy.T)])]))
    part = Grid(GRID.cell_m, GRID.left + 31, GRID.top - 20, 50, 44)
    whole, some = (surface.delaunay_surface(GRID, cells, 0.5, GROWTH, counted) for counted in (None, part))
    inner = grids.window(GRID, part)
    for a, b in zip(whole, some, strict=True):
        np.testing.assert_array_equal(a[inner], b[inner])
    assert np.isfinite(whole.elevation).sum() > np.isfinite(some.elevation).sum()
