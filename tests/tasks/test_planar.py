import numpy as np
import pytest
from seamosaic.tasks import grids, nodes, planar, seams
from seamosaic.tasks.grids import Grid

from tests.tasks import seabed
from tests.tasks.seabed import pattern, photograph, pose

TILE = Grid(0.006, -100, 90, 200, 180)


def similarity(heading_deg, scale, x, y):
    c, s = scale * np.cos(np.radians(heading_deg)), scale * np.sin(np.radians(heading_deg))
    return np.array([[c, -s, x], [s, c, y]])


def matches_of(truth, rng, noise=0.0, per_pair=30):
    """Matches of neighbours in a row, on flat ground."""
    parts = []
    for i in range(len(truth) - 1):
        middle = truth[i : i + 2, :, 2].mean(0)
        ground = middle + rng.uniform(-0.4, 0.4, (per_pair, 2))
        slopes = [np.linalg.solve(M[:, :2], (ground - M[:, 2]).T).T for M in truth[i : i + 2]]
        slopes = [xy + rng.normal(0, noise, xy.shape) for xy in slopes]
        parts.append((np.full(per_pair, i), np.full(per_pair, i + 1), *slopes))
    return planar.Matches(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def a_line(rng, count=12):
    return np.stack(
        [similarity(rng.normal(0, 2), rng.normal(3, 0.05), 500000 + 0.7 * k, 4.7e6 + 0.1 * k) for k in range(count)]
    )


def test_level_slopes_point_east_and_north():
    R, _ = pose(0, 0, 0, 90, 4, -7, (2, 1, 5))
    ground = np.array([[0.4, -0.2, -3.0], [-0.1, 0.9, -3.0]])
    X = ground @ R
    np.testing.assert_allclose(planar.level_slopes(R, X[:, :2] / X[:, 2:]), ground[:, :2] / 3, atol=1e-12)
    up_and_down = planar.level_slopes(pose(0, 0, 0, 0, 0, 80)[0], np.array([[0.0, -2.0], [0.0, 2.0]]))
    assert np.isfinite(up_and_down).all(1).tolist() == [False, True]


def test_alignment_recovers_the_similarities():
    rng = np.random.default_rng(0)
    truth = a_line(rng)
    believed = truth + 0
    believed[:, :, 2] += rng.normal(0, 0.3, (len(truth), 2))
    believed[:, :, :2] *= rng.normal(1, 0.03, (len(truth), 1, 1))
    found = planar.align(believed, matches_of(truth, rng, 0.001), 0.3)
    step_found, step_truth = np.diff(found[:, :, 2], axis=0), np.diff(truth[:, :, 2], axis=0)
    assert 1e-5 < np.abs(step_found - step_truth).max() < 0.05
    assert np.abs(np.diff(believed[:, :, 2], axis=0) - step_truth).max() > 0.2
    # navigation's errors are averaged over the line
    assert np.abs((found - truth)[:, :, 2].mean(0)).max() < 3 * 0.3 / np.sqrt(len(truth))


def test_relief_and_wrong_matches_do_not_shrink_the_map():
    rng = np.random.default_rng(1)
    truth = a_line(rng)
    matches = matches_of(truth, rng, 0.02)
    wrong = rng.random(len(matches.image_i)) < 0.15
    matches.xy_i[wrong] += rng.uniform(-0.3, 0.3, (wrong.sum(), 2))
    found = planar.align(truth, matches, 0.3)
    scale = np.sqrt(np.linalg.det(found[:, :, :2]) / np.linalg.det(truth[:, :, :2]))
    assert scale.mean() == pytest.approx(1, abs=0.02)
    assert np.abs(scale - 1).max() > 1e-5
    length = np.linalg.norm(found[-1, :, 2] - found[0, :, 2]) / np.linalg.norm(truth[-1, :, 2] - truth[0, :, 2])
    assert length == pytest.approx(1, abs=0.03)


def test_without_matches_images_stay_where_they_are_believed():
    truth = a_line(np.random.default_rng(2))
    none = planar.Matches(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 2)))
    np.testing.assert_allclose(planar.align(truth, none, 0.3), truth, atol=1e-6)


def mosaic_of(views, similarities):
    shots = [
        (seabed.shot_of(view), planar.lie(view.R_local_camera, M)) for view, M in zip(views, similarities, strict=True)
    ]
    return seabed.compose([seams.plan(TILE, nodes.flat_ground(TILE), shots)], views)[0]


def test_flat_ground_comes_back_in_its_place():
    poses = [pose(-0.3, 0.05, 0.0, 20, 3, -4), pose(0.3, 0.0, 0.2, 200, -2, 3)]
    views = [photograph(R, C, -3.0, k) for k, (R, C) in enumerate(poses)]
    C = np.stack([C for _, C in poses])
    result = mosaic_of(views, planar.prior(C, C[:, 2] + 3.0, np.eye(3)))
    expected = np.moveaxis(pattern(*grids.cell_centres(TILE)), 2, 0)
    assert result.mask.mean() > 0.95
    assert np.quantile(np.abs(result.rgb - expected)[:, result.mask], 0.99) < 5
    assert set(np.unique(result.source[result.mask])) == {0, 1}


def test_a_step_breaks_the_planar_mosaic_but_not_its_maker():
    step = lambda x, y: -3.0 + 0.5 * (x > 0)  # noqa: E731
    poses = [pose(-0.3, 0.0, 0.0), pose(0.3, 0.0, 0.0)]
    views = [photograph(R, C, step, k) for k, (R, C) in enumerate(poses)]
    result = mosaic_of(views, planar.prior(np.array([C for _, C in poses]), np.array([3.0, 3.0]), np.eye(3)))
    x, y = grids.cell_centres(TILE)
    error = np.abs(result.rgb - np.moveaxis(pattern(x, y), 2, 0)).max(0)
    assert np.median(error[result.mask & (x < -0.1)]) < 4
    assert np.median(error[result.mask & (x > 0.1)]) > 10


def test_convergence_turns_the_prior():
    R = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    M = planar.prior(np.array([[10.0, 20.0, -5.0]]), np.array([2.0]), R)[0]
    np.testing.assert_allclose(M @ [0.1, 0.0, 1.0], [10.0, 20.2])
