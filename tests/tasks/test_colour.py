import numpy as np
import pytest
from seamosaic.tasks import colour


def light(height=240, width=320):
    """Lamps: bright left of the middle, a quarter in the corners, red taken by the water."""
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    return np.exp(-0.7 * ((x + 0.2) ** 2 + y**2))[..., None] * np.array([0.5, 1.0, 0.9])


def survey(rng, count=36):
    """Images (n, 240, 320, 3) of blotchy ground in that light, some of it dark."""
    images = []
    for k in range(count):
        blotches = np.kron(rng.uniform(0.6, 1.4, (12, 16)), np.ones((20, 20)))[..., None]
        images.append(np.clip(150 * light() * blotches * (0.5 if k % 3 == 0 else 1.0), 0, 255).astype(np.uint8))
    return images


def test_lighting_is_taken_out():
    rng = np.random.default_rng(0)
    images = survey(rng)
    bare = np.zeros(images[0].shape[:2], bool)
    gain = colour.lighting(np.stack([colour.thumbnail(image, bare) for image in images]))
    grey = np.clip(150 * light(), 0, 255).astype(np.uint8)
    flat = colour.flatten(grey, gain)
    assert grey[..., 1].std() / grey[..., 1].mean() > 0.25
    for band in range(3):
        assert flat[..., band].std() / flat[..., band].mean() < 0.05
    assert flat[..., 1].mean() == pytest.approx(grey[..., 1].mean(), rel=0.2)
    # the colour is nearer to grey, and still that of the sea
    before, after = (image[..., 0].mean() / image[..., 1].mean() for image in (grey, flat))
    assert before + 0.1 < after < 0.9


def test_the_ground_is_not_taken_for_light():
    rng = np.random.default_rng(1)
    images = survey(rng)
    bare = np.zeros(images[0].shape[:2], bool)
    gain = colour.lighting(np.stack([colour.thumbnail(image, bare) for image in images]))
    contrast = np.kron(np.tile([[0.7, 1.3], [1.3, 0.7]], (6, 8)), np.ones((20, 20)))[..., None]
    flat = colour.flatten(np.clip(120 * light() * contrast, 0, 255).astype(np.uint8), gain).astype(float)
    bright, dark = (flat[..., 1][(contrast[..., 0] == c)].mean() for c in (1.3, 0.7))
    assert bright / dark == pytest.approx(1.3 / 0.7, rel=0.05)


def test_the_laser_leaves_no_trace():
    rng = np.random.default_rng(2)
    mask = np.zeros((240, 320), bool)
    mask[110:132] = True  # in every image
    images = survey(rng)
    clean = colour.lighting(np.stack([colour.thumbnail(image, np.zeros_like(mask)) for image in images]))
    for image in images:
        image[mask] = 0, 255, 0
    masked = colour.lighting(np.stack([colour.thumbnail(image, mask) for image in images]))
    spoilt = colour.lighting(np.stack([colour.thumbnail(image, np.zeros_like(mask)) for image in images]))
    assert np.isfinite(masked).all()
    assert np.abs(np.log(masked / clean)).max() < 0.12
    assert np.abs(np.log(spoilt / clean)).max() > 0.3


def test_thumbnail_is_the_mean_of_what_is_not_masked():
    image = np.full((48, 64, 3), 80, np.uint8)
    mask = np.zeros((48, 64), bool)
    image[:2, :2], image[10:12, 20] = 255, 200
    mask[:2, :2], mask[10:12, 20] = True, True
    small = colour.thumbnail(image, mask)
    assert small.shape == (*colour.THUMBNAIL, 3)
    assert np.isnan(small[0, 0]).all()
    assert np.isfinite(small).sum() == small.size - 3
    np.testing.assert_allclose(small[np.isfinite(small)], 80, atol=1e-3)


def test_dark_corners_are_not_blown_up():
    gain = np.full((*colour.THUMBNAIL, 3), 50.0, np.float32)
    assert (colour.flatten(np.full((48, 64, 3), 10, np.uint8), gain) == 40).all()
