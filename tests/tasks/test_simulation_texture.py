"""The simulated seabed's colour."""

import numpy as np
import pytest
from seamosaic.schemas.scene import TextureScene
from seamosaic.tasks.simulation_texture import MEAN_ALBEDO, blurred, make_texture, sample


def texture(seed: int = 0, half_m: float = 0.5, **fields) -> np.ndarray:
    return make_texture(TextureScene(**fields), half_m, np.random.default_rng(seed))


def test_contrast_is_as_asked_for():
    plain, mottled = (texture(contrast=c, spots_per_m2=0)[..., 1].astype(float) / 255 for c in (0.0, 0.1))
    assert plain.std() < 0.002
    assert 0.07 < mottled.std() / mottled.mean() < 0.14
    assert mottled.mean() == pytest.approx(MEAN_ALBEDO, rel=0.05)


def test_spots_add_outlines():
    sand, stones = (texture(contrast=0.1, spots_per_m2=n).astype(float) for n in (0, 200))
    changed = abs(sand - stones).max(axis=2) > 8
    assert 0.01 < changed.mean() < 0.6
    assert np.array_equal(stones, texture(contrast=0.1, spots_per_m2=200))


def test_row_zero_is_north_and_column_zero_west():
    image = np.zeros((100, 100, 3), np.uint8)
    image[10, 80] = 255  # 5.5 - 1 m north of the middle, 3.05 m east
    x, y = np.array([[3.05, -3.05]]), np.array([[3.95, 3.95]])
    found = sample(image, 5.0, x, y)
    assert found[0, 0] == pytest.approx([1, 1, 1])
    assert (found[0, 1] == 0).all()


def test_large_pixels_average_texels():
    fine = texture(contrast=0.2, spots_per_m2=0)
    assert blurred(fine, 0.003, 0.002) is fine
    coarse = blurred(fine, 0.003, 0.02).astype(float)
    assert coarse.std() < 0.9 * fine.std()
    assert coarse.mean() == pytest.approx(fine.mean(), rel=0.01)


def test_a_texture_with_a_period_repeats_itself():
    scene = TextureScene(cell_m=0.01, period_m=0.8)
    found = make_texture(scene, 1.5, np.random.default_rng(0))
    assert found.shape == (300, 300, 3)
    assert (found[:80] == found[80:160]).all()
    assert (found[:, 30:100] == found[:, 190:260]).all()
    assert (found[:40] != found[40:80]).mean() > 0.5
