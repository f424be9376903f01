import cv2
import numpy as np
import pytest
from seamosaic.schemas.parameters import LaserParameters
from seamosaic.tasks import board_shape, corner_fit
from seamosaic.tasks import calibration_board as board
from seamosaic.tasks import calibration_board_start as start
from seamosaic.tasks import calibration_targets as targets
from seamosaic.tasks.calibration_lines import Area
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
    return start.first_camera(pairs, (true.camera.width, true.camera.height), "brown", FREE)


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
    fourth = data.laser_image == 4
    assert np.isfinite(good.left_out_m[fourth]).all()
    before, after = (np.nan_to_num(found.left_out_m[fourth], nan=np.inf) for found in (good, bad))
    before, after = np.sqrt(np.mean(before**2)), np.sqrt(np.mean(after**2))
    assert after > 3 * before


def bent_scene(true, bow_m, count=9, misprint_m=0.0):
    """As `seen`, on a board bowed like a shallow trough; the light from exact rays onto the bowed board.

    Misprinted, its columns are apart by turns too much and too little, and it is wavy from row to row.
    """
    data, (R, t) = seen(true, count, corner_px=0.03), board_poses(count)
    shape = board_shape.Shape(np.zeros(2), 0.3, np.array([bow_m, 0, 0, 0, 0, 0.5 * bow_m, 0]))
    on_board = data.corner_board + np.outer(board_shape.heights(shape, data.corner_board[:, :2]), [0, 0, 1])
    on_board = on_board + misprint_m * np.sin(data.corner_board[:, [0, 0, 1]] / 0.04) * [1, 0, 2]
    X = np.einsum("pij,pj->pi", R[data.corner_image], on_board) + t[data.corner_image]
    rng, parts = np.random.default_rng(3), []
    for k in range(count):
        for s, sheet in enumerate(true.laser.sheets):
            normal, along = R[k].T @ np.array(sheet.normal), np.linspace(-0.25, 0.25, 30)
            offset = sheet.offset - np.array(sheet.normal) @ t[k]
            line = np.column_stack([np.zeros(30), along, np.zeros(30)])
            for _ in range(6):
                line[:, 0] = (offset - normal[1] * along - normal[2] * line[:, 2]) / normal[0]
                line[:, 2] = board_shape.heights(shape, line[:, :2])
            uv = project(true.camera, line @ R[k].T + t[k])
            ok = np.isfinite(uv).all(1) & ((uv > 0) & (uv < [1215, 911])).all(1) & (np.abs(line[:, 0]) < 0.5)
            noise = np.column_stack([rng.normal(0, 0.2, ok.sum()), np.zeros(ok.sum())])
            parts.append((uv[ok] + noise, np.full(ok.sum(), s), np.full(ok.sum(), k), np.full(ok.sum(), 0.2)))
    corner = project(true.camera, X) + rng.normal(0, 0.03, (len(X), 2))
    ok = np.isfinite(corner).all(1)
    light = (np.concatenate(part) for part in zip(*parts, strict=True))
    return board.BoardData(corner[ok], data.corner_board[ok], data.corner_image[ok], *light, count), shape


@pytest.mark.slow
def test_the_shape_of_a_bent_board_is_found():
    true = calibration()
    data, shape = bent_scene(true, 0.006)
    flat, bent = (board.calibrate_board(data, true.camera, (), bent=bent) for bent in (False, True))
    rms = [np.sqrt(np.nanmean(found.left_out_m**2)) for found in (flat, bent)]
    assert 1e-5 < rms[1] < 0.5 * rms[0]
    assert bent.corner_sigma_px < 0.05 < flat.corner_sigma_px
    xy = data.corner_board[:63, :2]
    off = board_shape.heights(bent.shape, xy) - board_shape.heights(shape, xy)
    plane = np.column_stack([xy, np.ones(len(xy))])
    off = off - plane @ np.linalg.lstsq(plane, off, rcond=None)[0]
    assert np.sqrt(np.mean(off**2)) < 0.0006
    for s, sheet in enumerate(true.laser.sheets):
        assert angle_deg(bent.sheets[s][:3], sheet.normal) < 0.15


@pytest.mark.slow
def test_misprinted_corners_are_released_all_the_way():
    """With poses, lens and shape held while corners move, seven rounds stop far short, and the light is off by more."""
    true = calibration()
    data, _ = bent_scene(true, 0.006, misprint_m=0.0003)
    found = board.calibrate_board(data, true.camera, ("fx", "fy", "cx", "cy", "k1"), bent=True)
    assert 0.025 < found.corner_sigma_px < 0.036
    for s, sheet in enumerate(true.laser.sheets):
        assert angle_deg(found.sheets[s][:3], sheet.normal) < 0.025


def test_a_flat_board_stays_flat():
    true = calibration()
    found = board.calibrate_board(seen(true), true.camera, (), bent=True)
    low, high = -0.24, 0.24
    xy = np.stack(np.meshgrid([low, 0, high], [low, 0, high]), -1).reshape(-1, 2)
    assert np.abs(board_shape.heights(found.shape, xy)).max() < 0.002


def test_rays_meet_a_bent_board():
    shape = board_shape.Shape(np.array([0.1, 0.0]), 0.2, 0.001 * np.arange(1, 8))
    rng = np.random.default_rng(0)
    on_board = rng.uniform(-0.2, 0.2, (50, 2))
    X = np.column_stack([on_board, board_shape.heights(shape, on_board)])
    origin = np.array([0.05, 0.02, -1.5]) + np.zeros((50, 3))
    assert board_shape.meet(shape, origin, X - origin) == pytest.approx(X, abs=1e-5)


@pytest.mark.parametrize("light", [0.0, 1.5])
def test_corners_are_fitted_under_uneven_light(light: float):
    rng, (columns, rows) = np.random.default_rng(0), (5, 4)
    y, x = np.mgrid[:200, :220].astype(float)
    A = np.array([[0.97, 0.06], [-0.05, 1.02]])
    where = np.array([20.3, 18.6])
    square = 30.0
    a, b = ((np.stack([x, y], -1) - where) @ np.linalg.inv(A).T / square).transpose(2, 0, 1)
    edge = [np.tanh(6 * np.sin(np.pi * c)) for c in (a, b)]
    image = (100 + 50 * edge[0] * edge[1]) * np.exp(-light * (220 - x) / 220) + rng.normal(0, 1, x.shape)
    i, j = np.meshgrid(np.arange(1, 6), np.arange(1, 5))
    true = where + square * np.column_stack([i.ravel(), j.ravel()]) @ A.T
    grey = np.clip(image, 0, 255).astype(np.uint8)
    found = corner_fit.refined(grey, true + rng.uniform(-1.2, 1.2, true.shape), (columns, rows))
    assert 0.001 < np.sqrt(np.mean((found - true) ** 2)) < 0.06


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
    light = targets.parallel_lines(image, Area(targets.outline(found[1], 0.25), beside=True), 3, LaserParameters())
    for s, (top, bottom) in enumerate(lines):
        own = light.uv[light.sheet == s]
        assert len(own) > 100
        expected = top + (bottom - top) * own[:, 1] / 499
        assert np.median(np.abs(own[:, 0] - expected)) < 0.3
    assert not len(
        targets.parallel_lines(image, Area(targets.outline(found[1], 0.25), beside=True), 6, LaserParameters()).uv
    )


def test_light_elsewhere_is_not_taken_for_light_on_the_board():
    """What is behind the board carries more of each line than the board does."""
    image = picture([(560, 540), (620, 604), (690, 678)])
    board_uv = np.array([[585.0, 150], [645, 150], [645, 380], [585, 380]])
    light = targets.parallel_lines(image, Area(board_uv), 1, LaserParameters())
    assert len(light.uv) > 100
    assert Area(board_uv).holds(light.uv).all()
    assert np.median(np.abs(light.uv[:, 0] - (620 - 16 * light.uv[:, 1] / 499))) < 0.3


def test_charuco_board_is_found():
    target = cv2.aruco.CharucoBoard((7, 5), 0.04, 0.03, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    image = cv2.copyMakeBorder(target.generateImage((700, 500)), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    found = targets.corners(np.asarray(image, np.uint8), targets.Board("charuco", 7, 5, 0.04))
    assert found is not None
    assert len(found[0]) == 24
    assert np.allclose(np.diff(np.unique(np.round(found[0][:, 0], 6))), 0.04)
