"""The laser's colour against that of the bottom's texture."""

import numpy as np
import pytest
from seamosaic.schemas.parameters import LaserParameters
from seamosaic.tasks import laser_colour, medians, triangulation

from tests.tasks.laser_scenes import COLOUR, LIGHT, WHITE, camera, columns, encoded
from tests.tasks.test_laser_hostile import bottom

VIEW = camera()


def textured(seed: int, snr: float, contrast: float, noise: float = 0.008) -> tuple[np.ndarray, np.ndarray]:
    """A line snr times the noise high on pale and dark ground, which dims the line, too; and its columns (2, H)."""
    rng = np.random.default_rng(seed)
    ground, u = bottom(seed, contrast), columns(VIEW, 2.7, 0.1)
    x = np.arange(VIEW.width)
    line = np.sum([np.exp(-0.5 * ((x - u[k][:, None]) / 2.5) ** 2) for k in (0, 1)], axis=0)
    albedo = ground[..., 1] / 0.25
    light = ground + snr * noise * (line * albedo)[..., None] * COLOUR
    return encoded(light + rng.normal(0, noise, light.shape)), u


@pytest.mark.parametrize(("snr", "contrast", "recall"), [(10, 0.15, 0.97), (10, 0.4, 0.95), (6, 0.3, 0.75)])
def test_a_faint_line_on_strong_texture(snr: float, contrast: float, recall: float):
    found = wrong = visible = 0
    for seed in range(2):
        image, u = textured(seed, snr, contrast)
        soundings = triangulation.sound(image, VIEW, LIGHT, LaserParameters()).soundings
        off = np.abs(soundings.uv[:, 0] - u[soundings.arm, soundings.uv[:, 1].astype(int)]) > 3
        found, wrong = found + int((~off).sum()), wrong + int(off.sum())
        visible += int(((u > 3) & (u < VIEW.width - 4) & (np.abs(u[0] - u[1]) > 13)).sum())
    assert recall < found / visible < 1.03
    assert wrong <= 0.002 * found
    # without colour the same line is lost among the stones
    image, u = textured(0, snr, contrast)
    grey = triangulation.sound(np.ascontiguousarray(image[..., 1]), VIEW, LIGHT, LaserParameters()).soundings
    right = np.abs(grey.uv[:, 0] - u[grey.arm, grey.uv[:, 1].astype(int)]) < 3
    assert right.sum() < 0.6 * found


def test_evidence_has_the_laser_and_not_the_texture():
    rng = np.random.default_rng(0)
    texture = 0.3 * np.exp(rng.normal(0, 0.3, (120, 300)))[..., None] * WHITE
    laser = np.zeros((120, 300))
    laser[:, 150] = 0.2
    image = encoded(texture + laser[..., None] * COLOUR)
    seen = laser_colour.evidence(image, 2.2)
    apart = np.arange(300) != 150
    assert np.median(seen[:, 150]) - np.median(seen) == pytest.approx(0.2, abs=0.02)
    assert 0.001 < seen[:, apart].std() < 0.1 * texture[..., 1].std()
    assert laser_colour.without_grey_channels(image, 2.2) is image
    grey = laser_colour.without_grey_channels(np.repeat(image[..., 1:2], 3, axis=2), 2.2)
    np.testing.assert_array_equal(grey, image[..., 1])
    same = laser_colour.evidence(grey, 2.2)
    np.testing.assert_allclose(same, laser_colour.linear_light(2.2)[image[..., 1]], atol=1e-6)


def test_running_median_keeps_to_most():
    height = np.full(200, 0.3)
    height[50:58] = 3.0
    assert medians.running_median(height) == pytest.approx(0.3, rel=0.05)
