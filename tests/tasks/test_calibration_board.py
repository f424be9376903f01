import cv2
import numpy as np
import pytest
from seamosaic.schemas.parameters import LaserParameters
from seamosaic.tasks import calibration_board as board
from seamosaic.tasks import calibration_targets as targets
from seamosaic.tasks.calibration_sheets import angle_deg
from seamosaic.tasks.camera import project

from tests.tasks.calibration_scenes import board_poses, calibration

FREE = ("fx", "fy", "cx", "cy", "k1")


def seen(true, count=7, seed=0, corner_px=0.1, laser_px=0.2):
    """Corners and light of a board of 9 x 7 corners, squares of 60 mm."""
    rng, (R, t) = np.random.default_rng(seed), board_poses(count, seed)
    x, y = np.meshgrid(np.arange(9), np.arange(7))
    flat = 0.06 * np.column_stack([x.ravel() - 4, y.ravel() - 3, np.zeros(63)])
    corners, light = [], []
    for k in range(count):
        uv = project(true.camera, flat @ R[k].T + t[k])
        ok = ((uv > 0) & (uv < [1215, 911])).all(1)
        corners.append((uv[ok] + rng.normal(0, corner_px, (ok.sum(), 2)), flat[ok], np.full(ok.sum(), k)))
        for s, sheet in enumerate(true.laser.sheets):
            normal = R[k].T @ np.array(sheet.normal)
            offset = sheet.offset - np.array(sheet.normal) @ t[k]
            along = np.linspace(-0.4, 0.4, 30)
            line = np.column_stack([(offset - normal[1] * along) / normal[0], along, np.zeros(30)])
            uv = project(true.camera, line @ R[k].T + t[k])
            ok = np.isfinite(uv).all(1) & ((uv > 0) & (uv < [1215, 911])).all(1) & (np.abs(line[:, 0]) < 0.6)
            moved = uv[ok] + np.column_stack([rng.normal(0, laser_px, ok.sum()), np.zeros(ok.sum())])
            light.append((moved, np.full(ok.sum(), s), np.full(ok.sum(), k), np.full(ok.sum(), 0.2)))
    return board.BoardData(
        *(np.concatenate(part) for part in zip(*corners, strict=True)),
        *(np.concatenate(part) for part in zip(*light, strict=True)),
        count,
    )


def first(data, true):
    pairs = [
        (data.corner_board[data.corner_image == k], data.corner_uv[data.corner_image == k]) for k in range(data.images)
    ]
    return board.first_camera(pairs, (true.camera.width, true.camera.height), "brown", FREE)


def test_camera_and_sheets_within_their_sigmas():
    true = calibration()
    data = seen(true)
    found = board.calibrate_board(data, first(data, true), FREE)
    sigma = np.sqrt(np.diag(found.covariance))
    for k, name in enumerate(FREE[:4]):
        error = getattr(found.camera, name) - getattr(true.camera, name)
        assert abs(error) < 3.5 * sigma[k]
        assert 0.01 < sigma[k] < 10
    assert found.corner_sigma_px == pytest.approx(0.1, abs=0.02)
    for s, sheet in enumerate(true.laser.sheets):
        assert angle_deg(found.sheets[s][:3], sheet.normal) < 0.15
        assert abs(abs(found.sheets[s][3]) - abs(sheet.offset)) < 0.004
    assert 1e-5 < np.sqrt(np.nanmean(found.left_out_m**2)) < 0.01


def test_left_out_images_tell_a_wrong_light():
    true = calibration()
    data = seen(true)
    good = board.calibrate_board(data, true.camera, ())
    off = data.laser_uv + np.where(data.laser_image[:, None] == 4, [12.0, 0.0], 0.0)
    bad = board.calibrate_board(data._replace(laser_uv=off), true.camera, ())
    before, after = (
        np.nanmean(found.left_out_m[4]) if np.isfinite(found.left_out_m[4]).any() else np.inf for found in (good, bad)
    )
    assert after > 3 * before


def test_camera_behind_a_port():
    true = calibration(port=True)
    data = seen(true)
    start = true.camera.model_copy(update={"fx": 1175.0, "fy": 1200.0, "cx": 600.0, "cy": 455.0})
    found = board.calibrate_board(data, start, ("fx", "fy", "cx", "cy"))
    assert abs(found.camera.fx - true.camera.fx) < 3.5 * np.sqrt(found.covariance[0, 0])
    assert found.camera.port == true.camera.port


def picture(lines):
    """A tilted chessboard of 7 x 6 corners on grey, and green lines (u at the top, u at the bottom)."""
    squares = np.kron(np.indices((7, 8)).sum(0) % 2, np.ones((40, 40))) * 180 + 40
    page = np.full((400, 440), 220, np.float32)
    page[60:340, 60:380] = squares
    M = cv2.getPerspectiveTransform(
        np.array([[0, 0], [440, 0], [440, 400], [0, 400]], np.float32),
        np.array([[60, 80], [470, 60], [450, 430], [80, 410]], np.float32),
    )
    image = cv2.warpPerspective(page, M, (800, 500), borderValue=120.0, flags=cv2.INTER_AREA)
    bgr = np.repeat(cv2.GaussianBlur(image, (0, 0), 0.8)[..., None], 3, axis=2)
    v, u = np.mgrid[:500, :800]
    for top, bottom in lines:
        middle = top + (bottom - top) * v / 499
        bgr[..., 1] += 110 * np.exp(-0.5 * ((u - middle) / 2.0) ** 2)
    return np.clip(bgr + np.random.default_rng(0).normal(0, 1.5, bgr.shape), 0, 255).astype(np.uint8)


def test_finds_corners_and_numbers_lines_from_the_left():
    lines = [(560, 540), (620, 604), (690, 678)]
    image = picture(lines)
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    found = targets.corners(grey, targets.Board("chessboard", 7, 6, 0.01))
    assert found is not None
    assert found[0].shape == (42, 3)
    assert found[0].max() == pytest.approx(0.06)
    light = targets.parallel_lines(image, targets.outline(found[1], 0.25), 3, LaserParameters())
    for s, (top, bottom) in enumerate(lines):
        own = light.uv[light.sheet == s]
        assert len(own) > 100
        expected = top + (bottom - top) * own[:, 1] / 499
        assert np.median(np.abs(own[:, 0] - expected)) < 0.3
    assert not len(targets.parallel_lines(image, targets.outline(found[1], 0.25), 6, LaserParameters()).uv)


def test_charuco_board_is_found():
    target = cv2.aruco.CharucoBoard((7, 5), 0.04, 0.03, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    image = cv2.copyMakeBorder(target.generateImage((700, 500)), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    found = targets.corners(np.asarray(image, np.uint8), targets.Board("charuco", 7, 5, 0.04))
    assert found is not None
    assert len(found[0]) == 24
    assert np.allclose(np.diff(np.unique(np.round(found[0][:, 0], 6))), 0.04)
