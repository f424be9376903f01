"""Figures of merit, each on data whose answer is known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from seamosaic.tasks import evaluation as ev


def relief(seed: int = 0, half_m: float = 3.0) -> ev.Surface:
    """Bumps of some decimetres, 12 m below, as a grid of 2 cm."""
    n = round(2 * half_m / 0.02) + 1
    rng, axis = np.random.default_rng(seed), np.linspace(-half_m, half_m, n)
    x, y = np.meshgrid(axis, axis)
    h = sum(
        a * np.exp(-((x - u) ** 2 + (y - v) ** 2) / w**2)
        for a, u, v, w in zip(
            rng.normal(0, 0.15, 60), *rng.uniform(-half_m, half_m, (2, 60)), rng.uniform(0.2, 0.6, 60), strict=True
        )
    )
    return ev.grid_surface(np.asarray(h), half_m, 0.02, 12.0)


def cells(surface: ev.Surface, n: int = 6000, seed: int = 1) -> np.ndarray:
    x, y = np.random.default_rng(seed).uniform(-1.8, 1.8, (2, n))
    return np.column_stack([x, y, surface(x, y)])


@settings(deadline=None, max_examples=30)
@given(
    st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    st.floats(0.5, 2.0),
    st.lists(st.floats(-50, 50), min_size=3, max_size=3),
)
def test_alignment_finds_any_similarity(turn: list[float], scale: float, shift: list[float]):
    A = np.random.default_rng(0).normal(0, 5, (12, 3))
    R = Rotation.from_rotvec(turn).as_matrix()
    found = ev.align(A, scale * A @ R.T + shift, scale=True)
    assert found.scale == pytest.approx(scale, rel=1e-6)
    assert pytest.approx(R, abs=1e-6) == found.R
    assert found.apply(A) == pytest.approx(scale * A @ R.T + shift, abs=1e-5)
    assert ev.align(A, A @ R.T).scale == 1


def test_alignment_never_mirrors():
    A = np.random.default_rng(0).normal(0, 1, (9, 3))
    assert np.linalg.det(ev.align(A, A * [1, 1, -1]).R) == pytest.approx(1)


def test_trajectory_errors_are_those_put_in():
    rng = np.random.default_rng(0)
    C = rng.uniform(-10, 10, (300, 3)) * [1, 1, 0.02]
    # the estimate is 1 % too small, noisy by 5 mm an axis, and 0.3 m to the east
    errors = ev.trajectory_errors(C / 1.01 + rng.normal(0, 0.005, C.shape) + [0.3, 0, 0], C)
    assert errors.scale_error_pct == pytest.approx(1.0, abs=0.02)
    assert errors.similarity_rms_m == pytest.approx(0.005 * np.sqrt(3), rel=0.1)
    assert 0.05 < errors.rigid_rms_m < 0.12
    assert errors.absolute_rms_m == pytest.approx(np.hypot(0.3, errors.rigid_rms_m), rel=0.05)


def test_grid_rows_go_north():
    h = np.zeros((3, 3))
    h[2, 0] = 1.0  # north-west
    surface = ev.grid_surface(h, 1.0, 1.0, 5.0)
    x, y = np.array([-1.0, -0.5, 1.0, -9.0]), np.array([1.0, 1.0, -1.0, 9.0])
    assert surface(x, y) == pytest.approx([-4.0, -4.5, -5.0, -4.0])


def test_shift_is_found_over_relief():
    surface, rng = relief(), np.random.default_rng(2)
    X = cells(surface)
    moved = X + [0.43, -0.27, 0.11] + rng.normal(0, 0.003, X.shape) * [0, 0, 1]
    shift = ev.fit_shift(moved, surface)
    assert (shift.east_m, shift.north_m, shift.up_m) == pytest.approx((-0.43, 0.27, -0.11), abs=0.003)
    assert abs(np.array([shift.yaw_deg, shift.tilt_east_deg, shift.tilt_north_deg])).max() < 0.05
    left = ev.spread(ev.residuals(moved, shift, surface))
    assert 0.0028 < left.rmse_m < 0.0035
    assert left.median_abs_m == pytest.approx(0.6745 * 0.003, rel=0.1)
    assert left.p95_abs_m == pytest.approx(1.96 * 0.003, rel=0.1)


def test_turn_and_tilt_are_found_with_their_signs():
    surface = relief()
    X = cells(surface)
    x, y = X[:, 0] - X[:, 0].mean(), X[:, 1] - X[:, 1].mean()
    yaw = np.radians(-2.0)
    turned = np.column_stack([np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y, X[:, 2]])
    turned[:, :2] += X[:, :2].mean(axis=0)
    turned[:, 2] -= np.radians(1.0) * (turned[:, 0] - turned[:, 0].mean())
    shift = ev.fit_shift(turned, surface)
    assert shift.yaw_deg == pytest.approx(2.0, abs=0.05)
    assert shift.tilt_east_deg == pytest.approx(1.0, abs=0.05)
    assert shift.tilt_north_deg == pytest.approx(0.0, abs=0.05)


def test_outliers_do_not_move_the_shift():
    surface = relief()
    X = cells(surface)
    X[::10, 2] += 0.5
    shift = ev.fit_shift(X, surface)
    assert abs(np.array([shift.east_m, shift.north_m, shift.up_m])).max() < 0.005


def test_over_a_plane_nothing_is_shifted_sideways():
    flat = ev.grid_surface(np.zeros((201, 201)), 2.0, 0.02, 12.0)
    shift = ev.fit_shift(cells(flat) + np.array([0, 0, 0.02]), flat)
    assert (shift.east_m, shift.north_m, shift.up_m) == pytest.approx((0, 0, -0.02), abs=1e-6)


@pytest.mark.parametrize(("claim", "low", "high"), [(1.0, 0.66, 0.70), (0.5, 0.36, 0.40), (2.0, 0.94, 0.97)])
def test_honesty_tells_too_proud_and_too_humble(claim: float, low: float, high: float):
    difference = np.random.default_rng(0).normal(0, 0.01, 20_000)
    within_1, within_2 = ev.honesty(difference, np.full(20_000, 0.01 * claim))
    assert low < within_1 < high
    assert within_1 < within_2


def test_honesty_needs_a_stated_sigma():
    assert ev.honesty(np.ones(3), np.array([0, np.nan, -1])) == (None, None)
    assert ev.honesty(np.array([1.0, 9.0]), np.array([2.0, np.nan])) == (1.0, 1.0)


def test_agreement_after_a_vertical_shift():
    z = np.random.default_rng(0).normal(0, 5, 5000)
    found = ev.agreement(z, z - 3 + np.random.default_rng(1).normal(0, 0.1, 5000))
    assert found.cells == 5000
    assert found.vertical_shift_m == pytest.approx(3, abs=0.01)
    assert found.median_abs_m == pytest.approx(0.06745, rel=0.1)
    assert found.p95_abs_m == pytest.approx(0.196, rel=0.1)


def test_altitude_bias():
    assert ev.altitude_bias_pct(np.array([2.02, 3.03, 9.0]), np.array([2.0, 3.0, 3.0])) == pytest.approx(1.0)


def test_coverage_of_half_a_footprint():
    flat = ev.grid_surface(np.zeros((201, 201)), 2.0, 0.02, 12.0)
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    down = np.diag([1.0, -1, -1])
    R, C = np.stack([down, down]), np.array([[0.0, 0, -10], [0.5, 0, -10]])
    # footprints 2 m square, half a metre apart; cells where x < 0 only
    x, y = (v.ravel() for v in np.meshgrid(np.arange(-2, 0, 0.05), np.arange(-2, 2, 0.05)))
    half = np.column_stack([x, y, flat(x, y)])
    found = ev.coverage(half, flat, 2.0, R, C, K)
    assert found.seen == pytest.approx(1 / 2.5, abs=0.03)
    assert found.seen_twice == pytest.approx(0.5 / 1.5, abs=0.03)
    assert ev.coverage(half, flat, 2.0, R[:1], C[:1], K).seen_twice is None
    upwards = ev.coverage(half, flat, 2.0, np.eye(3)[None], C[:1], K)
    assert upwards.seen is None
