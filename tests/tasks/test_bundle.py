"""Bundle adjustment of a made survey: better than what it starts from, honest about itself, hard to mislead."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from seamosaic.schemas.calibration import Camera, Port
from seamosaic.schemas.parameters import AdjustParameters
from seamosaic.tasks import bundle, crossovers, laser_ranges, tracks
from seamosaic.tasks.adjust import Adjusted
from seamosaic.tasks.camera import project
from seamosaic.tasks.navigation import NavigationPrior, Poses
from seamosaic.tasks.rotations import R_vehicle_camera, nearest_rotation
from seamosaic.tasks.tracks import PairMatches

from tests.tasks import scenes

LENS = Camera(model="brown", width=1216, height=912, fx=1500, fy=1500, cx=607.5, cy=455.5)
WINDOW = LENS.model_copy(
    update={"model": "flat-port", "fx": 1120.0, "fy": 1120.0, "port": Port(distance=0.04, thickness=0.01)}
)
P = AdjustParameters()
NO_LINES = crossovers.lines({})


def _survey():
    x, y = np.meshgrid(np.arange(3) * 1.2, np.arange(6) * 0.8)
    y[:, 1] = y[::-1, 1]
    return scenes.cameras(np.column_stack([x.T.ravel(), y.T.ravel(), np.zeros(18)]) - [1.2, 2, 0], tilt_deg=1.5)


def _matches(lens, points, poses, rng, wrong=0.0, noise_px=0.3):
    """Pairs of matches between neighbouring images; every point is one feature."""
    seen = []
    for R, C in zip(*poses, strict=True):
        uv = project(lens, (points - C) @ R)
        inside = ((uv > 0) & (uv < [lens.width - 1, lens.height - 1])).all(1)
        seen.append((uv + rng.normal(0, noise_px, uv.shape), inside))
    pairs = []
    for i in range(len(seen)):
        for j in range(i + 1, len(seen)):
            both = np.flatnonzero(seen[i][1] & seen[j][1])
            if len(both) > 20:
                uv_j = seen[j][0][both].copy()
                bad = rng.random(len(both)) < wrong
                uv_j[bad] += rng.normal(0, 20, (bad.sum(), 2))
                number_j = np.where(bad, both + 10_000 * (1 + i), both)
                pairs.append(PairMatches(i, j, np.column_stack([both, number_j]), seen[i][0][both], uv_j))
    return pairs


def _navigation(poses, rng):
    count = len(poses.C_local)
    noise = np.column_stack([np.cumsum(rng.normal(0, 0.03, (count, 2)), 0), rng.normal(0, 0.03, count)])
    turned = Rotation.from_rotvec(np.radians(rng.normal(0, 0.2, (count, 3)))).as_matrix()
    return NavigationPrior(
        Poses(poses.R_local_camera @ turned, poses.C_local + noise + [0.3, -0.2, 0.02]),
        4.0 * np.arange(count),
        np.full(count, 0.4),
        np.full(count, 0.03),
        np.radians(np.tile([0.3, 0.3, 0.8], (count, 1))),
        0.02,
        R_vehicle_camera(0, 0, 0).T,
    )


def _chained(start):
    count = len(start.C_local)
    sigma = np.full((count, 3), 1.0)
    ok, used, turned = ["adjusted"] * count, np.ones(0, bool), np.zeros(count, bool)
    return Adjusted(start, sigma, np.zeros(count), sigma[:, 0], ok, used, turned)


def _rms(found, true):
    a, b = found - found.mean(0), true - true.mean(0)
    return float(np.sqrt(((a @ nearest_rotation(b.T @ a).T - b) ** 2).sum(1).mean()))


def _run(lens=LENS, wrong=0.0, laser=True, seed=0):
    rng, poses, points = np.random.default_rng(seed), _survey(), scenes.seabed(0.15, count=20_000)
    navigation = _navigation(poses, rng)
    sights = tracks.thin(tracks.join(_matches(lens, points, poses, rng, wrong)), (912, 1216), P.tie_cells, 2)
    soundings = {k: scenes.cross(0.15, poses, k, rng) for k in range(18)} if laser else {}
    found = bundle.adjust(lens, _chained(navigation.poses), sights, soundings, NO_LINES, navigation, P)
    return poses, navigation, found


@pytest.mark.parametrize(("lens", "wrong"), [(LENS, 0.0), (LENS, 0.1), (WINDOW, 0.0)])
def test_tie_points_and_laser_hold_a_survey_to_the_millimetre(lens, wrong):
    scale = []
    for seed in range(3):
        poses, navigation, found = _run(lens, wrong, seed=seed)
        assert _rms(navigation.poses.C_local, poses.C_local) > 0.03
        assert 2e-4 < _rms(found.poses.C_local, poses.C_local) < 0.004
        size = [np.linalg.norm(C - C.mean(0)) for C in (found.poses.C_local, poses.C_local)]
        scale.append(size[0] / size[1] - 1)
    assert 0 < np.sqrt(np.mean(np.square(scale))) < 1e-3


def test_the_laser_gives_the_scale():
    scale = []
    for laser in (True, False):
        poses, _, found = _run(laser=laser, seed=3)
        size = [np.linalg.norm(C - C.mean(0)) for C in (found.poses.C_local, poses.C_local)]
        scale.append(abs(size[0] / size[1] - 1))
    assert scale[0] < 1e-3 < scale[1] < 0.05


def test_the_stated_sigmas_are_those_of_navigation_shared_by_all():
    poses, _, found = _run(seed=1)
    z = (found.poses.C_local - poses.C_local) / found.sigma_m
    assert (np.abs(z) < 3).all()
    assert (found.sigma_m[:, :2] > 0.1).all()
    assert (found.sigma_m[:, :2] < 0.5).all()
    assert (found.sigma_m[:, 2] > 0.02).all()
    assert (found.sigma_m[:, 2] < 0.05).all()


def test_wrong_matches_are_left_out_and_the_noise_is_measured():
    rng, poses, points = np.random.default_rng(2), _survey(), scenes.seabed(0.15, count=20_000)
    sights = tracks.join(_matches(LENS, points, poses, rng, wrong=0.1))
    found = bundle.refine(LENS, poses, sights, {}, NO_LINES, _navigation(poses, rng), P)
    assert 0.27 < found.sigma_px < 0.34
    left = found.block.sights.image.size / sights.image.size
    assert 0.6 < left < 0.99
    assert np.abs(found.residual_px).max() < 3


@pytest.mark.parametrize("views", [2, 3, 6])
@pytest.mark.parametrize("noise_px", [0.15, 0.6])
def test_the_noise_of_sights_is_told_by_what_their_places_leave(views, noise_px):
    """Tie points take three directions of their coordinates, in two images all but one; some are wrong."""
    rng, count = np.random.default_rng(views), 4000
    noise = rng.normal(0, noise_px, (count, 2 * views))
    noise[:200] *= 10
    taken, _ = np.linalg.qr(rng.normal(size=(count, 2 * views, 3)))
    left = noise - np.einsum("nij,nkj,nk->ni", taken, taken, noise)
    track = np.repeat(np.arange(count), views)
    sights = tracks.Sights(np.tile(np.arange(views), count), track, np.zeros((len(track), 2)))
    assert bundle._noise_px(left.reshape(-1, 2), sights) == pytest.approx(noise_px, rel=0.08)


def test_without_tie_points_the_start_stands():
    poses = _survey()
    start = _chained(poses)
    assert bundle.adjust(LENS, start, tracks.join([]), {}, NO_LINES, None, P) is start


def test_without_navigation_the_first_image_is_the_datum():
    rng, poses, points = np.random.default_rng(4), _survey(), scenes.seabed(0.15, count=20_000)
    moved = Poses(poses.R_local_camera, poses.C_local + rng.normal(0, 0.01, poses.C_local.shape))
    sights = tracks.join(_matches(LENS, points, poses, rng))
    soundings = {k: scenes.cross(0.15, poses, k, rng) for k in range(18)}
    found = bundle.adjust(LENS, _chained(moved), sights, soundings, NO_LINES, None, P)
    np.testing.assert_allclose(found.poses.C_local[0], moved.C_local[0], atol=1e-4)
    assert 1e-4 < _rms(found.poses.C_local, poses.C_local) < 0.004
    assert found.sigma_m[0].max() < 1e-4 < found.sigma_m[-1].max() < 0.02


def test_without_navigation_tie_points_must_join_all_and_ranges_give_the_scale():
    rng, poses, points = np.random.default_rng(5), _survey(), scenes.seabed(0.15, count=20_000)
    sights, known = tracks.join(_matches(LENS, points, poses, rng)), np.ones(18, bool)
    under = points[np.linalg.norm(points[:, :2] - poses.C_local[0, :2], axis=1) < 0.6]
    ranges = laser_ranges.measure(poses, under, {0: scenes.cross(0.15, poses, 0, rng)}, 10)
    assert bundle.determined(known, sights, ranges).all()
    assert not bundle.determined(known, sights, ranges.take(np.zeros(len(ranges.image), bool))).any()
    halves, rows = sights.image < 9, np.arange(18)
    apart = sights._replace(track=np.unique(sights.track * 2 + halves, return_inverse=True)[1])
    np.testing.assert_array_equal(bundle.determined(known, apart, ranges), rows < 9)  # the range is of image 0
    alone = sights.take(sights.image != 17)
    np.testing.assert_array_equal(bundle.determined(known, alone, ranges), rows != 17)
    np.testing.assert_array_equal(bundle.determined(rows != 17, alone, ranges), rows != 17)


def test_an_image_that_nothing_holds_does_not_keep_the_others_from_being_adjusted():
    rng, poses, points = np.random.default_rng(4), _survey(), scenes.seabed(0.15, count=20_000)
    moved = Poses(poses.R_local_camera, poses.C_local + rng.normal(0, 0.01, poses.C_local.shape))
    sights = tracks.join(_matches(LENS, points, poses, rng))
    soundings = {k: scenes.cross(0.15, poses, k, rng) for k in range(18)}
    alone, start = sights.take(sights.image != 17), _chained(moved)
    found = bundle.adjust(LENS, start, alone, soundings, NO_LINES, None, P)
    assert 1e-4 < _rms(found.poses.C_local[:17], poses.C_local[:17]) < 0.004
    step, first = (C[17] - C[16] for C in (found.poses.C_local, moved.C_local))
    assert np.linalg.norm(step) == pytest.approx(np.linalg.norm(first))
    assert 0 < np.linalg.norm(step - first) < 0.02
    assert (found.sigma_m[17] == start.sigma_m[17]).all()
    assert found.sigma_m[16].max() < 0.02


def test_the_map_lies_where_the_images_that_navigation_knows_say():
    rng, poses, points = np.random.default_rng(6), _survey(), scenes.seabed(0.15, count=20_000)
    navigation, lost, wrong = _navigation(poses, rng), np.arange(5, 10), 12
    sights = tracks.join(_matches(LENS, points, poses, rng))
    soundings = {k: scenes.cross(0.15, poses, k, rng) for k in range(18)}
    usual = bundle.adjust(LENS, _chained(navigation.poses), sights, soundings, NO_LINES, navigation, P)
    C, sigma = navigation.poses.C_local.copy(), navigation.sigma_horizontal.copy()
    C[lost] += [3.0, 2.0, 0.0]
    C[wrong, 2] += 5.0
    sigma[lost] = 30.0
    misled = navigation._replace(poses=navigation.poses._replace(C_local=C), sigma_horizontal=sigma)
    found = bundle.adjust(LENS, usual, sights, soundings, NO_LINES, misled, P)
    off = found.poses.C_local - usual.poses.C_local
    assert 0 < np.linalg.norm(off[:, :2], axis=1).max() < 0.1
    assert 0 < np.abs(off[:, 2]).max() < 0.03


def test_what_nothing_holds_leaves_the_start():
    rng, poses, points = np.random.default_rng(5), _survey(), scenes.seabed(0.15, count=20_000)
    sights = tracks.join(_matches(LENS, points, poses, rng))
    alone = sights.take(sights.image != 17)
    start = _chained(poses)
    assert bundle.adjust(LENS, start, alone, {}, NO_LINES, None, P) is start
