"""Segmentation of the cross (paper III.C) from points made by geometry, without images."""

import functools

import numpy as np
import pytest
from seamosaic.schemas.calibration import Camera, CrossGeometry, Laser
from seamosaic.schemas.parameters import LaserParameters
from seamosaic.tasks import cross, laser
from seamosaic.tasks.triangulation import intersect, sheets_at

CAMERA = Camera(model="brown", width=1200, height=900, fx=1560, fy=1560, cx=600, cy=450)
LIGHT = Laser(origin=(1.2, 0, 0), planes=CrossGeometry(baseline=1.2, angle=25))
PARAMETERS = LaserParameters()
INVERSE_RANGE = (1 / PARAMETERS.range_max_m, 1 / PARAMETERS.range_min_m)
SHAPE = (CAMERA.height, CAMERA.width)


@functools.cache
def cross_points(depth, noise_px: float = 0.2, seed: int = 0) -> tuple[laser.LaserPoints, np.ndarray]:
    """Points of the cross on a bottom of depth(x_m, y_m), found row by row on the image, and their true arm."""
    rng = np.random.default_rng(seed)
    u = np.arange(20.0, CAMERA.width - 20)
    found, arms = [], []
    for v in range(CAMERA.height):
        uv = np.column_stack([u, np.full_like(u, v)])
        for arm, sheet in enumerate(LIGHT.sheets):
            X = intersect(CAMERA, sheet, uv)[0]
            gap = X[:, 2] - depth(X[:, 0], X[:, 1])
            # a crossing is where the gap changes sign by a small step, not where the bottom jumps
            change = np.flatnonzero((gap[1:] * gap[:-1] < 0) & (np.abs(np.diff(gap)) < 0.05))
            for k in change:
                found.append([u[k] + gap[k] / (gap[k] - gap[k + 1]) + rng.normal(0, noise_px), v])
                arms.append(arm)
    uv = np.array(found)
    n = len(uv)
    return laser.LaserPoints(uv, np.full(n, 100.0), np.full(n, 0.2), np.full(n, 2.6), 1), np.array(arms)


def segmented(points: laser.LaserPoints) -> cross.Cross:
    sheets = sheets_at(CAMERA, LIGHT, points.uv, PARAMETERS)
    return cross.segment(points, SHAPE, sheets, INVERSE_RANGE)


def box(x, y):
    return np.where((np.abs(x + 0.35) < 0.25) & (np.abs(y - 0.35) < 0.25), 2.6, 2.9)


def rock_under_the_crossing(x, y):
    return 2.9 - 0.6 * np.exp(-(((x + 0.1) / 0.3) ** 4) - (y / 0.35) ** 4)


BOTTOMS = {
    "level": lambda x, y: 2.6 + 0 * x,
    "tilted along x": lambda x, y: 2.6 + 0.5 * x,
    "tilted along y": lambda x, y: 2.6 - 0.4 * y,
    "45 degrees from the middle on": lambda x, y: 2.4 + np.maximum(x, 0),
    "ripples": lambda x, y: 2.8 + 0.03 * np.sin(9 * x + 5 * y),
    "box": box,
    "rock": rock_under_the_crossing,
}


@pytest.mark.parametrize("name", BOTTOMS)
def test_every_arm_is_told_on(name: str):
    points, truth = cross_points(BOTTOMS[name])
    found = segmented(points)
    told = found.arm >= 0
    assert told.mean() > 0.93
    assert (found.arm[told] == truth[told]).mean() > 0.998


@pytest.mark.parametrize("depth", [1.8, 2.6, 3.6])
def test_centre_is_where_the_sheets_meet(depth: float):
    points, _ = cross_points(lambda x, y: depth + 0 * x)
    found = segmented(points)
    assert found.centre is not None
    # the sheets meet in the plane y = 0, at x = d - z tan(alpha)
    expected = [600 + 1560 * (1.2 - depth * np.tan(np.radians(25))) / depth, 450]
    assert np.abs(found.centre - expected).max() < 5


def test_the_crossing_itself_is_not_guessed():
    points, _ = cross_points(BOTTOMS["level"])
    found = segmented(points)
    near = np.abs(points.uv[:, 1] - 450) < 6
    far = np.abs(points.uv[:, 1] - 450) > 12
    assert near.any()
    assert (found.arm[near] == -1).all()
    assert (found.arm[far] >= 0).all()


def test_the_falling_arm_follows_from_the_normals():
    points, _ = cross_points(BOTTOMS["level"])
    found = segmented(points)
    for arm, sheet in enumerate(LIGHT.sheets):
        own = found.arm == arm
        u, v = points.uv[own].T
        slope = np.polyfit(u, v, 1)[0]
        assert np.sign(slope) == np.sign(-sheet.normal[0] / sheet.normal[1])


@pytest.mark.parametrize("hidden", [60, 150])
def test_broken_arms_without_a_visible_crossing(hidden: int):
    points, truth = cross_points(BOTTOMS["tilted along x"])
    v = points.uv[:, 1]
    seen = (np.abs(v - 450) > hidden) & ((v // 40) % 3 != 0)
    found = segmented(points.take(seen))
    assert found.centre is None
    assert (found.arm == truth[seen]).mean() > 0.995


def test_one_arm_alone():
    points, truth = cross_points(BOTTOMS["level"])
    for arm in (0, 1):
        found = segmented(points.take(truth == arm))
        told = found.arm >= 0
        assert told.mean() > 0.95
        assert (found.arm[told] == arm).all()


def test_short_strays_far_from_the_bottom_are_left_out():
    points, truth = cross_points(BOTTOMS["level"])
    stray = np.column_stack([np.full(15, 1000.0), np.arange(640.0, 655)])
    n = len(stray)
    uv = np.concatenate([points.uv, stray])
    many = laser.LaserPoints(uv, *(np.concatenate([f, np.full(n, f[0])]) for f in points[1:4]), 1)
    found = segmented(many)
    assert (found.arm[-n:] == -1).all()
    told = found.arm[:-n] >= 0
    assert told.mean() > 0.95
    assert (found.arm[:-n][told] == truth[told]).all()


def test_no_points_and_points_out_of_range():
    found = segmented(laser.no_points())
    assert found.centre is None
    assert found.arm.shape == (0,)
    far, _ = cross_points(lambda x, y: 2.6 + 0 * x)
    beyond = cross.segment(far, SHAPE, sheets_at(CAMERA, LIGHT, far.uv, PARAMETERS), (100.0, 200.0))
    assert (beyond.arm == -1).all()


def test_a_coarser_step_gives_the_same_arms():
    points, truth = cross_points(BOTTOMS["tilted along x"])
    every_third = points.uv[:, 1] % 3 == 1
    coarse = points.take(every_third)._replace(step_px=3)
    found = segmented(coarse)
    told = found.arm >= 0
    assert told.mean() > 0.9
    assert (found.arm[told] == truth[every_third][told]).all()
    assert found.centre is not None


def test_whole_line_has_no_gaps_but_the_wide_ones():
    points, _ = cross_points(BOTTOMS["level"], noise_px=0.0)
    v = points.uv[:, 1]
    narrow, wide = np.abs(v - 200) < 25, np.abs(v - 700) < 120
    kept = points.take(~narrow & ~wide)
    line = cross.whole_line(kept.uv, segmented(kept).arm, kept.step_px, SHAPE)

    def nearest(uv: np.ndarray) -> float:
        return float(np.hypot(*(line - uv).T).min())

    assert max(nearest(uv) for uv in points.uv[narrow]) < 2
    assert max(nearest(uv) for uv in points.uv[np.abs(v - 450) < 20]) < 2
    assert max(nearest(uv) for uv in points.uv[np.abs(v - 700) < 30]) > 60
    assert line[:, 1].min() == 0
    assert line[:, 1].max() == CAMERA.height - 1
