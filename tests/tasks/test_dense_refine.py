"""Disparities refined on textures that are shifted by a known amount."""

import cv2
import numpy as np
import pytest
from seamosaic.tasks import dense_refine
from seamosaic.tasks.dense_refine import refine

SHAPE = 160, 200


def _texture(rng):
    pixels = cv2.GaussianBlur(rng.normal(0, 1, (SHAPE[0], SHAPE[1] + 60)).astype(np.float32), (0, 0), 1.6)
    return 128 + 48 * pixels / pixels.std()


def _pair(shift, noise=0.0, gain=1.0, offset=0.0):
    """Two evened images, the second showing what is at x of the first at x - shift(x, y)."""
    rng = np.random.default_rng(3)
    wide = _texture(rng)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    second = wide[:, 30 : 30 + SHAPE[1]]
    first = cv2.remap(wide, x + 30 - shift(x, y).astype(np.float32), y, cv2.INTER_LANCZOS4)
    images = [first, gain * (second - 128) + 128 + offset]
    images = [np.clip(np.rint(image + rng.normal(0, noise, SHAPE)), 0, 255).astype(np.uint8) for image in images]
    usable = np.ones(SHAPE, bool)
    return (images[0], usable), (images[1], usable)


def _inner(values):
    return values[20:-20, 30:-30]


@pytest.mark.parametrize("shift", [6.0625, 6.25, 6.5, 6.8125])
def test_a_shift_is_found_wherever_it_lies_between_whole_pixels(shift):
    start = np.full(SHAPE, round(shift), np.float32)
    found = _inner(refine(start, *_pair(lambda x, y: shift + 0 * x)).disparity)
    assert np.isfinite(found).all()
    assert abs(np.median(found) - shift) < 0.003
    assert 0.0001 < np.std(found) < 0.02


def test_a_slope_is_followed_though_matching_gave_steps():
    slope = lambda x, y: 6 + 0.04 * (x - 100) + 0.02 * y  # noqa: E731
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    steps = np.rint(slope(x, y)).astype(np.float32)
    off = _inner(refine(steps, *_pair(slope)).disparity - slope(x, y))
    before = np.abs(_inner(steps - slope(x, y)))
    assert 0.001 < np.nanmedian(np.abs(off)) < 0.15 * np.median(before)


def test_light_that_differs_moves_nothing():
    start = np.full(SHAPE, 6, np.float32)
    found = _inner(refine(start, *_pair(lambda x, y: 6.3125 + 0 * x, gain=0.9, offset=8)).disparity)
    assert abs(np.median(found) - 6.3125) < 0.005


def test_sigma_is_what_noise_makes():
    start, pair = np.full(SHAPE, 6, np.float32), _pair(lambda x, y: 6.4 + 0 * x, noise=6)
    found = refine(start, *pair)
    error = np.nanstd(_inner(found.disparity) - 6.4)
    assert 0.5 < np.median(_inner(found.sigma_px)) / error < 1.5
    quiet = refine(start, *_pair(lambda x, y: 6.4 + 0 * x))
    assert np.nanmedian(quiet.sigma_px) < 0.3 * np.nanmedian(found.sigma_px)


def test_noise_does_not_grow_from_round_to_round(monkeypatch):
    """What errs in one pixel errs against its neighbours, which a box of all of them would make larger each time."""
    start, pair = np.full(SHAPE, 6, np.float32), _pair(lambda x, y: 6.4 + 0 * x, noise=6)
    few = np.std(_inner(refine(start, *pair).disparity))
    monkeypatch.setattr(dense_refine, "_ROUNDS", 20)
    many = np.std(_inner(refine(start, *pair).disparity))
    assert 0.8 * few < many < 1.1 * few


def test_what_was_not_matched_or_has_no_texture_or_goes_elsewhere_is_left_out():
    start = np.full(SHAPE, 6, np.float32)
    start[:, :80] = np.nan
    pair = _pair(lambda x, y: np.where(y < 80, 6.2, 9.0) + 0 * x)
    found = refine(start, *pair).disparity
    assert np.isnan(found[:, :80]).all()
    assert np.isfinite(found[20:60, 100:170]).all()
    assert np.isnan(found[100:140, 100:170]).mean() > 0.5
    plain = (np.full(SHAPE, 128, np.uint8), np.ones(SHAPE, bool))
    assert np.isnan(refine(np.full(SHAPE, 6, np.float32), plain, plain).disparity).all()
