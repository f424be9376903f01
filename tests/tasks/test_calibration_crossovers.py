import numpy as np
import pytest
from seamosaic.tasks.calibration_crossovers import beside_lines, crossings, feet, thinned
from seamosaic.tasks.calibration_field import Feet, Matches, Points, crossing_heights


def two_lines(apart_m: float):
    """A line along x of image 0 and one along y of image 1, `apart_m` lower, on a slope."""
    t = np.linspace(-1, 1, 101)
    slope = 0.2
    first = np.column_stack([t, np.zeros(101), slope * t])
    second = np.column_stack([np.full(101, 0.31), t - 0.013, np.full(101, slope * 0.31) - apart_m])
    points = Points(np.zeros((202, 2)), np.repeat([0, 1], 101), np.zeros(202, np.int8), np.ones(202))
    return points, np.concatenate([first, second])


def test_crossing_is_found_and_measured_along_the_normal():
    points, X = two_lines(0.01)
    found = crossings(points, X)
    assert len(found.f) == 1
    place = X[found.p[0, 0]] + found.f[0] * (X[found.p[0, 1]] - X[found.p[0, 0]])
    assert place[:2] == pytest.approx([0.31, 0.0], abs=1e-9)
    assert crossing_heights(found, X)[0] == pytest.approx(0.01 / np.hypot(1, 0.2), rel=1e-6)


def test_gaps_of_a_line_are_not_crossed():
    points, X = two_lines(0.01)
    keep = np.ones(202, bool)
    keep[60:71] = False
    cut = Points(*(column[keep] for column in points))
    assert len(crossings(cut, X[keep]).f) == 0


def test_altimeter_feet_near_a_line():
    _, X = two_lines(0.0)
    image, offset = np.array([0, 0]), np.array([[0.2, 0.01, -2.5], [0.2, 0.5, -2.5]])
    found = feet(X, None, np.array([[0.0, 0.0, 2.5]]), image, offset)
    assert len(found.spot) == 1
    assert found.apart[0] == pytest.approx(0.01, abs=1e-6)


def test_altimeter_feet_take_matches_of_their_own_image_only():
    X = np.array([[0.0, 0.0, -2.0], [0.01, 0.0, -2.0], [np.nan, 0.0, -2.0]])
    seen_by = np.array([[1, 2], [0, 3], [0, 1]])
    found = feet(X, seen_by, np.zeros((4, 3)), np.array([0, 2]), np.array([[0.0, 0.0, -2.0], [0.0, 0.2, -2.0]]))
    assert found.spot.tolist() == [1]
    assert found.image.tolist() == [0]


def test_matches_beside_a_line_are_kept_before_others():
    points = Points(np.zeros((3, 2)), np.array([0, 0, 1]), np.zeros(3, np.int8), np.ones(3))
    slopes = np.array([[0.0, 0.0], [0.1, 0.0], [0.3, 0.3]])
    near, far = np.array([[0.005, 0.0]]), np.random.default_rng(0).uniform(0.5, 0.6, (100, 2))
    x_i = np.concatenate([near, far])
    matches = Matches(np.zeros(101, int), np.ones(101, int), x_i, x_i)
    found = beside_lines(points, matches, slopes, x_i, x_i + 1)
    assert found.match.tolist() == [0]
    assert found.point.tolist() == [0]
    none = np.zeros(0, np.intp)
    under = Feet(np.array([0]), np.zeros((1, 3)), np.array([100]), np.zeros(1))
    kept = thinned(matches, found, Feet(none, np.zeros((0, 3)), none, np.zeros(0)), 10)
    assert len(kept) == 11
    assert set(thinned(matches, found, under, 10)) == {*kept, 100}
    assert 0 in kept
