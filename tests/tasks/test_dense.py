"""Dense matching on rendered pictures of a made seabed, behind each kind of lens."""

import cv2
import numpy as np
import pytest
from seamosaic.schemas.calibration import Camera
from seamosaic.tasks import dense, dense_refine
from seamosaic.tasks.camera import rays

from tests.tasks import scenes

RELIEF = 0.06
SIZE = {"width": 800, "height": 600, "fx": 1000.0, "fy": 1000.5, "cx": 396.0, "cy": 302.0}
PORT = {"distance": 0.035, "thickness": 0.012, "glass_index": 1.49, "water_index": 1.34}
LENSES = {
    "brown": Camera(model="brown", **SIZE, distortion=(-0.05, 0.02, 0.0004, -0.0003, 0.0)),
    "fisheye": Camera(model="fisheye", **SIZE, distortion=(0.02, -0.005, 0.0, 0.0)),
    "flat-port": Camera.model_validate({"model": "flat-port", **SIZE, "port": PORT}),
}
DEPTHS = 2.7, 3.3


def _texture():
    pixels = np.random.default_rng(0).normal(0, 1, (1500, 1500)).astype(np.float32)
    pixels = cv2.GaussianBlur(pixels, (0, 0), 1.5)
    return np.clip(128 + 40 * pixels / pixels.std(), 5, 245)


def _picture(lens, poses, k):
    """What a camera sees of the seabed of `scenes.height`, grey levels (H, W)."""
    v, u = np.mgrid[: lens.height, : lens.width]
    found = rays(lens, np.column_stack([u.ravel(), v.ravel()]).astype(float))
    R = poses.R_local_camera[k]
    o, d = found.origin @ R.T + poses.C_local[k], found.direction @ R.T
    X = o + d * ((-3 - o[:, 2]) / d[:, 2])[:, None]
    for _ in range(8):
        X = o + d * ((scenes.height(RELIEF, X[:, 0], X[:, 1]) - o[:, 2]) / d[:, 2])[:, None]
    at = ((X[:, :2] + 3) * 250).astype(np.float32).reshape(lens.height, lens.width, 2)
    return cv2.remap(_texture(), at[..., 0], at[..., 1], cv2.INTER_LINEAR).astype(np.uint8)


def _match(lens, poses, erase=None, spoil=None, scale=1):
    made = dense.rectify(lens, poses, 0, 1, DEPTHS, 1 / scale)
    assert made is not None
    sights, warped = [], []
    for k in (0, 1):
        grey = _picture(lens, poses, k)
        if spoil is not None:
            grey = spoil(grey)
        hidden = np.zeros(grey.shape, bool) if erase is None else erase
        sights.append(dense.sight(lens, made, poses.R_local_camera[k], k == 1))
        warped.append(dense.warp(made, sights[k], grey, hidden, scale))
    found = dense_refine.refine(dense.disparity(made, warped[0], warped[1]), warped[0], warped[1])
    return made, found.disparity, dense.points(made, found, sights[0], sights[1], 2)


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("second", [(0.0, 0.8, 0.02), (0.7, -0.1, 0.0)])
def test_points_lie_on_the_seabed(model, second):
    lens, poses = LENSES[model], scenes.cameras([[0, 0, 0], second], tilt_deg=1.5)
    _, found, relief = _match(lens, poses)
    X = relief.X_local
    error = X[:, 2] - scenes.height(RELIEF, X[:, 0], X[:, 1])
    assert np.isfinite(found).sum() > 60_000
    assert 0.01 < np.median(np.abs(error / relief.metres_per_px)) < 0.06
    # behind a flat port a pinhole would be off by centimetres
    assert abs(np.median(error)) < 0.0004
    assert np.quantile(np.abs(error), 0.95) < 0.004


def test_the_laser_and_plain_or_burnt_ground_are_left_out():
    lens, poses = LENSES["brown"], scenes.cameras([[0, 0, 0], [0, 0.8, 0]], tilt_deg=1)
    stripe = np.zeros((600, 800), bool)
    stripe[:, 390:420] = True
    everywhere, without = (np.isfinite(_match(lens, poses, erase)[1]).sum() for erase in (None, stripe))
    assert 0.85 < without / everywhere < 0.97
    for level in (128, 255):
        _, found, _ = _match(lens, poses, spoil=lambda grey, level=level: np.full_like(grey, level))
        assert not np.isfinite(found).any()


def test_depths_are_along_the_rectified_axis_whose_baseline_leans():
    lens, poses = LENSES["brown"], scenes.cameras([[0, 0, 0], [0.7, 0, -0.25]], tilt_deg=0)
    axes = dense.rectified_axes(poses, 0, 1)
    assert axes is not None
    X = scenes.seabed(0.0, size_m=1.5, count=400)
    depth = (X - poses.C_local[0]) @ axes[:, 2]
    made = dense.rectify(lens, poses, 0, 1, (depth.min(), depth.max()), 1.0)
    assert made is not None
    x = [(X - poses.C_local[k]) @ axes[:, 0] / depth * made.focal_px for k in (0, 1)]
    disparity = x[0] - x[1] - made.shift
    assert 0 <= disparity.min() < 1
    assert disparity.max() < made.disparities <= disparity.max() + 17
    # along the camera's own axis all of it is 3 m away
    assert np.ptp(depth) > 0.2


def test_where_depths_differ_much_pixels_are_coarser():
    lens, poses = LENSES["brown"], scenes.cameras([[0, 0, 0], [0.5, 0, 0]], tilt_deg=0)
    near, far = 0.8, 4.0
    made = dense.rectify(lens, poses, 0, 1, (near, far), 1.0)
    assert made is not None
    assert made.disparities == 256
    assert 0.4 < made.focal_px / lens.fx < 0.8
    last = made.focal_px * made.base_m / near - made.shift
    assert last < made.disparities


def test_pairs_that_say_nothing_of_depth_are_refused():
    lens = LENSES["brown"]
    for second in ([0, 0, 0], [0, 0, 0.8], [6, 0, 0]):
        assert dense.rectify(lens, scenes.cameras([[0, 0, 0], second], tilt_deg=0), 0, 1, DEPTHS, 1.0) is None


def test_small_cells_get_every_point_that_there_is():
    assert [dense.spacing(pixels) for pixels in (1.5, 3.9, 4.0, 20.0)] == [1, 1, 2, 2]
