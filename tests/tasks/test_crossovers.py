"""Crossovers of laser lines: where they are, what they say, what they do for surveys that have nothing to match."""

import numpy as np
import pytest
from scipy.stats import chi2
from seamosaic.tasks import crossovers
from seamosaic.tasks.navigation import Poses

from tests.tasks import scenes, surveys


def _pair(relief_m=0.1, moved=(0.0, 0.0, 0.0)):
    """Lines of two cameras, and their poses, the second one `moved` from where it is."""
    poses = scenes.cameras([[0, 0, 0], [0.2, 0.7, 0]])
    rng = np.random.default_rng(0)
    X = {k: scenes.cross(relief_m, poses, k, rng, noise_m=0.0005, count=600) for k in (0, 1)}
    made = crossovers.lines({k: (own, np.repeat([0, 1], 600)) for k, own in X.items()})
    return Poses(poses.R_local_camera, poses.C_local + [[0, 0, 0], moved]), made


def test_lines_cross_on_one_surface():
    poses, made = _pair()
    found = crossovers.find(poses, made)
    assert len(found.i) == 2
    assert set(zip(found.i, found.j, strict=True)) == {(0, 1)}
    a, b = (x @ poses.R_local_camera[k].T + poses.C_local[k] for k, x in ((0, found.a), (1, found.b)))
    np.testing.assert_allclose(a[:, :2], b[:, :2], atol=1e-6)
    np.testing.assert_allclose(a[:, 2], scenes.height(0.1, *a[:, :2].T), atol=0.002)
    assert np.abs(found.apart_m).max() < 0.002
    assert (found.sigma_m < 0.002).all()


def test_apart_is_measured_along_the_normal_and_signed():
    poses, made = _pair(moved=(0, 0, 0.03))
    found = crossovers.find(poses, made)
    np.testing.assert_allclose(found.apart_m, 0.03 * found.normal[:, 2], atol=0.002)


def test_only_on_slopes_does_a_crossing_tell_sideways():
    for relief, low, high in ((0.0, 0.0, 1e-9), (0.15, 0.02, 0.7)):
        found = crossovers.find(*_pair(relief))
        assert low <= np.linalg.norm(found.normal[:, :2], axis=1).max() <= high


def test_steps_that_no_surface_explains_are_left_out():
    poses, made = _pair()
    found = crossovers.find(poses, made)
    many = crossovers.Crossovers(*(np.concatenate([column] * 10) for column in found))
    apart = many.apart_m.copy()
    apart[3] = 0.2
    left = crossovers.believable(many._replace(apart_m=apart), 3)
    assert len(left.i) == len(apart) - 1
    assert (left.sigma_m >= many.sigma_m[:1].min()).all()


def test_an_image_is_held_if_nearly_all_of_its_crossings_agree():
    found = crossovers.find(*_pair())
    every = crossovers.Crossovers(*(np.concatenate([column] * 5) for column in found))
    assert crossovers.holds(every, every, 3).tolist() == [True, True, False]
    assert crossovers.holds(every, every.take(np.arange(10) < 9), 3).tolist() == [True, True, False]
    assert not crossovers.holds(every, every.take(np.arange(10) < 6), 3).any()
    assert not crossovers.holds(found, found, 3).any()


@pytest.mark.parametrize("soundings", [{}, {0: (np.array([[0.1, 0.2, 3.0]]), np.array([0]))}])
def test_few_soundings_make_no_lines(soundings):
    poses, _ = _pair()
    none = crossovers.find(poses, crossovers.lines(soundings))
    assert len(crossovers.believable(none, 0).i) == 0
    assert not crossovers.holds(none, none, 2).any()


@pytest.mark.parametrize("name", ["night", "sand"])
def test_surveys_without_matches_become_better_than_their_navigation(name):
    made = surveys.survey(name, 11)
    found = surveys.adjusted(made)
    before, after = (surveys.rigid_rms(poses, made.true) for poses in (made.navigation.poses, found.poses))
    assert 5e-4 < after < 0.6 * before
    assert set(found.status) == {"adjusted"}
    off = found.poses.C_local - made.true.C_local
    assert (np.abs(off / found.sigma_m) < 4).all()
    height = off[:, 2] - off[:, 2].mean()
    assert 1e-4 < height.std() < 0.0015  # navigation's noise of depth is 3 mm


@pytest.mark.slow
@pytest.mark.parametrize(("name", "better"), [("night", 0.7), ("sand", 0.7), ("pairs", 0.2), ("reef", 0.1)])
def test_sigmas_are_those_of_the_errors(name, better):
    """Navigation's offset is drawn once a survey and axis: limits that one of a thousand honest estimators fails."""
    surveyed = range(500, 524)
    found = surveys.honesty(name, surveyed)
    assert 0.005 * found.navigation_mm < found.adjusted_mm < better * found.navigation_mm
    square, draws = np.square(found.z), len(surveyed)
    for mean, number in ((square, draws), (square.mean(), 3 * draws)):
        low, high = chi2.interval(0.999, number)
        assert ((low < number * mean) & (number * mean < high)).all()
