"""Differences of two maps: figures of known ones, whole or by windows."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from seamosaic.tasks import comparison, rotations


@pytest.fixture
def maps():
    """Two maps of 200 x 300 cells: the second 2 mm higher, with 5 mm of noise that both know of."""
    rng = np.random.default_rng(0)
    z1 = rng.normal(-10, 0.5, (200, 300))
    z2 = z1 + 0.002 + rng.normal(0, 0.005, z1.shape)
    z1[:10], z2[:, :30] = np.nan, np.nan
    sigma = np.full(z1.shape, 0.005 / np.sqrt(2))
    return z1, z2, sigma


def totals(z1, z2, sigma, rows):
    found = comparison.Totals(z1.size)
    for start in range(0, len(z1), rows):
        part = slice(start, start + rows)
        difference = comparison.difference(z1[part], z2[part], sigma[part], sigma[part])
        found.add(difference, np.isfinite(z1[part]), np.isfinite(z2[part]))
    return found


def test_figures_of_a_known_difference(maps):
    found = totals(*maps, 200)
    assert (found.common, found.gained, found.lost) == (190 * 270, 10 * 270, 190 * 30)
    metres, sigmas = found.metres(), found.sigmas()
    assert metres["mean"] == pytest.approx(0.002, abs=1e-4)
    assert metres["median"] == pytest.approx(0.002, abs=1e-4)
    assert metres["rmse"] == pytest.approx(np.hypot(0.002, 0.005), rel=0.01)
    assert metres["p95_abs"] == pytest.approx(0.0106, rel=0.02)  # of a normal law shifted by 0.4 sigma
    assert sigmas["rms"] == pytest.approx(np.sqrt(1 + 0.4**2), rel=0.01)
    assert sigmas["share_above_2"] == pytest.approx(0.063, abs=0.004)


def test_windows_do_not_matter(maps):
    whole, parts = totals(*maps, 200), totals(*maps, 7)
    assert parts.metres() == pytest.approx(whole.metres())
    assert parts.sigmas() == pytest.approx(whole.sigmas())


def test_a_sample_of_a_large_map_says_the_same(maps, monkeypatch):
    exact = totals(*maps, 50).metres()
    monkeypatch.setattr(comparison, "_SAMPLE", 6_000)
    sampled = totals(*maps, 50)
    assert sum(map(len, sampled._metres)) < 6_100
    assert sampled.metres()["rmse"] == pytest.approx(exact["rmse"])
    assert sampled.metres()["p95_abs"] == pytest.approx(exact["p95_abs"], rel=0.05)


def test_nothing_in_common_and_no_sigma(maps):
    z1, z2, sigma = maps
    assert totals(z1, np.full_like(z1, np.nan), sigma, 200).metres() is None
    found = totals(z1, z2, np.full_like(z1, np.nan), 200)
    assert found.sigmas() is None
    assert found.metres() is not None


def test_angle_between_quaternions():
    rng = np.random.default_rng(1)
    for angle in (0.0, 1e-5, 0.1, 90.0, 179.999):
        axis = rng.normal(size=3)
        a = Rotation.random(random_state=3)
        b = Rotation.from_rotvec(np.radians(angle) * axis / np.linalg.norm(axis)) * a
        one, other = (r.as_quat(scalar_first=True) for r in (a, b))
        assert rotations.quaternion_angle_deg(one, other) == pytest.approx(angle, abs=1e-7)
        assert rotations.quaternion_angle_deg(one, -other) == pytest.approx(angle, abs=1e-7)


def test_one_spike_is_the_largest_difference_however_large_the_map(maps, monkeypatch):
    z1, z2, sigma = maps
    z2[77, 123] = z1[77, 123] - 3.0
    monkeypatch.setattr(comparison, "_SAMPLE", 600)
    assert totals(z1, z2, sigma, 50).metres()["max_abs"] == pytest.approx(3.0)
