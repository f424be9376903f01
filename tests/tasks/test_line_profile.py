"""Precision, honesty and completeness of the measured line, against the bound of Cramér and Rao."""

import numpy as np
import pytest
from seamosaic.schemas.parameters import LaserParameters
from seamosaic.tasks import gaussian_fit, line_profile, sheet_search

from tests.tasks.laser_scenes import LIGHT, Scene, scene

PARAMETERS = LaserParameters()


def measured(made: Scene, image: np.ndarray | None = None) -> line_profile.Line:
    image = made.image if image is None else image
    small = sheet_search.reduce(image)
    arms = sheet_search.search(small, made.camera, LIGHT, PARAMETERS)
    return line_profile.measure(image, arms, small.factor, PARAMETERS.gamma)


def errors(line: line_profile.Line, made: Scene) -> np.ndarray:
    return line.uv[:, 0] - made.u[line.arm, line.uv[:, 1].astype(int)]


def visible(made: Scene) -> int:
    inside = (made.u > 3) & (made.u < made.camera.width - 4)
    return int((inside & (np.abs(made.u[0] - made.u[1]) > 5 * made.width.max())).sum())


@pytest.mark.parametrize("snr", [5, 10, 20, 50])
def test_scatter_is_near_the_bound_and_sigma_is_honest(snr: float):
    error, z, bound = [], [], []
    for seed in range(2):
        made = scene(snr, seed)
        line = measured(made)
        error.append(errors(line, made))
        z.append(error[-1] / line.sigma_px)
        bound.append(1.0623 * np.sqrt(made.width[line.arm]) / snr)
    error, z, bound = (np.concatenate(part) for part in (error, z, bound))
    near = np.abs(error) < 6 * bound + 0.5
    assert near.mean() > 0.995
    ratio = np.sqrt((error[near] ** 2).mean() / (bound[near] ** 2).mean())
    assert 0.93 < ratio < 1.3
    assert 0.9 < z[near].std() < 1.1
    assert abs(error[near].mean()) < 4 * bound.mean() / np.sqrt(len(error))


@pytest.mark.parametrize(("snr", "recall", "precision"), [(10, 0.99, 0.995), (4, 0.9, 0.99), (3, 0.7, 0.99)])
def test_recall_and_precision_of_faint_lines(snr: float, recall: float, precision: float):
    for ground in (0.0, 0.25):
        made = scene(snr, seed=5, ground=ground)
        line = measured(made)
        error = np.abs(errors(line, made))
        right = error < 3.5 * 1.0623 * np.sqrt(made.width.max()) / snr + 0.5
        assert right.mean() >= precision
        assert recall <= right.sum() / visible(made) < 1.03


@pytest.mark.parametrize(("height", "width_px"), [(1.8, 1.8), (2.4, 5.0), (4.8, 1.8), (4.8, 5.0)])
def test_a_saturated_line_is_measured_by_its_flanks(height: float, width_px: float):
    made = scene(height / 0.012, width_px=width_px)
    line = measured(made)
    assert (made.image[..., 1] == 255).sum() > 3 * made.camera.height
    error = errors(line, made)
    assert len(line.uv) > 0.95 * visible(made)
    assert abs(error.mean()) < 0.02
    assert error.std() < 0.15
    assert abs(np.median(error)) < 0.01
    # beside the crossing the other arm hides a flank, and sigma says so
    assert 0.005 < 1.4826 * np.median(np.abs(error)) < 0.06
    assert 0.85 < (error / line.sigma_px).std() < 1.15


def test_a_sloping_ground_does_not_draw_the_line():
    made = scene(12)
    slope = np.linspace(0.3, 1.0, made.camera.width)[None, :, None]
    image = np.round(made.image * slope).astype(np.uint8)
    line = measured(made, image)
    error = errors(line, made)
    assert len(line.uv) > 0.97 * visible(made)
    assert abs(error.mean()) < 0.03


def test_hidden_stretches_have_no_points():
    made = scene(20)
    bare = scene(0)
    hidden = np.zeros(made.camera.height, bool)
    hidden[120:190] = hidden[420:470] = True
    image = np.where(hidden[:, None, None], bare.image, made.image)
    line = measured(made, image)
    v = line.uv[:, 1].astype(int)
    assert hidden[v].mean() < 0.002
    assert len(v) > 0.95 * visible(made) * (~hidden).mean()


def test_the_crossing_is_not_guessed():
    made = scene(20)
    line = measured(made)
    apart = np.abs(made.u[0] - made.u[1])[line.uv[:, 1].astype(int)]
    assert 4 * made.width.min() < apart.min() < 7 * made.width.max()


@pytest.mark.parametrize("width", [1.2, 2.5])
def test_fit_of_single_profiles(width: float):
    rng, x = np.random.default_rng(0), np.arange(-14, 15)
    place = rng.uniform(-0.7, 0.7, 600)
    light = 0.5 * np.exp(-0.5 * ((x - place[:, None]) / width) ** 2) + rng.normal(0, 0.01, (600, 29))
    used = np.ones(light.shape, bool)
    used[::4, 14] = False
    found = gaussian_fit.fit(light.T.astype(np.float32), used.T.astype(np.float32), 1.2 * width, 1e-6)
    assert np.abs(found.width / width - 1).max() < 0.05
    assert 0.8 < (found.place - place).std() / (1.0623 * np.sqrt(width) / 50) < 1.4
    assert 0.75 < ((found.place - place) / found.sigma).std() < 1.15
    assert found.height == pytest.approx(0.5, rel=0.1)
    assert 30 < np.median(found.signal_to_noise) < 150


def test_ground_is_a_line_through_both_sides():
    x = np.arange(-20, 21, dtype=np.float32)
    light = np.tile(0.2 + 0.003 * x[:, None], 50)
    used = np.ones(light.shape, np.float32)
    np.testing.assert_allclose(gaussian_fit.ground(light, used, 2.0), light, atol=1e-5)
    used[x > 0] = 0
    one_sided = gaussian_fit.ground(light, used, 2.0)
    assert np.ptp(one_sided) < 1e-6
    assert not gaussian_fit.ground(light, np.zeros_like(used), 2.0).any()
