"""Photographs of a chessboard in the light of a cross, rendered as a camera would take them."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from seamosaic.schemas.calibration import Calibration
from seamosaic.tasks.calibration_sheets import cast_rays
from seamosaic.tasks.camera import rays

_WHITE, _BLACK, _WALL = 0.75, 0.3, 0.55
_LINE_PX = 1.8
_FINER = 2


class Pixels(NamedTuple):
    """Rays of all sub-pixels (N, 3), and half a pixel beside them, camera frame."""

    origin: np.ndarray
    direction: np.ndarray
    origin_beside: np.ndarray
    direction_beside: np.ndarray


def pixels(true: Calibration) -> Pixels:
    """What a camera looks along, the same for every photograph."""
    camera = true.camera
    u, v = ((np.arange(size * _FINER) + 0.5) / _FINER - 0.5 for size in (camera.width, camera.height))
    uv = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    return Pixels(*rays(camera, uv), *rays(camera, uv + [0.5, 0.0]))


def photograph(
    true: Calibration, of: Pixels, R: np.ndarray, t: np.ndarray, inner: tuple[int, int], square_m: float, seed: int
) -> np.ndarray:
    """One photograph (H, W, 3) of a board with so many inner corners, its first at t, on a wall of the same plane."""
    camera, light = true.camera, true.laser
    assert light is not None
    board = np.append(R[:, 2], R[:, 2] @ t)
    X = cast_rays(of.origin, of.direction, board)
    x, y = ((X - t) @ R)[:, :2].T / square_m
    on_board = (x > -1) & (x < inner[0]) & (y > -1) & (y < inner[1])
    margin = (x > -1.6) & (x < inner[0] + 0.6) & (y > -1.6) & (y < inner[1] + 0.6)
    black = on_board & ((np.floor(x) + np.floor(y)) % 2 == 0)
    reflectance = np.select([black, margin], [_BLACK, _WHITE], _WALL)
    beam = np.zeros(len(X))
    for sheet in light.sheets:
        gap = X @ np.array(sheet.normal) - sheet.offset
        near = np.abs(gap) < 0.05
        beside = cast_rays(of.origin_beside[near], of.direction_beside[near], board)
        px = gap[near] / (2 * np.abs(beside @ np.array(sheet.normal) - sheet.offset - gap[near]))
        beam[near] += np.exp(-0.5 * (px / _LINE_PX) ** 2)
    glow = reflectance * beam
    bgr = np.stack([90 * reflectance, 90 * reflectance + 250 * glow, 80 * reflectance + 8 * glow], 1)
    fine = bgr.reshape(camera.height * _FINER, camera.width * _FINER, 3).astype(np.float32)
    small = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    soft = np.asarray(cv2.GaussianBlur(small, (0, 0), 0.7))
    return np.clip(soft + np.random.default_rng(seed).normal(0, 1.0, soft.shape), 0, 255).astype(np.uint8)


def write_photographs(
    folder: Path,
    true: Calibration,
    poses: tuple[np.ndarray, np.ndarray],
    inner: tuple[int, int] = (9, 6),
    square_m: float = 0.06,
) -> None:
    """A folder of photographs of the board whose middle is at the poses' translations, camera frame, metres."""
    folder.mkdir(parents=True)
    of, middle = pixels(true), 0.5 * square_m * np.array([inner[0] - 1, inner[1] - 1, 0])
    for k, (R, t) in enumerate(zip(*poses, strict=True)):
        image = photograph(true, of, R, t - R @ middle, inner, square_m, k)
        cv2.imwrite(str(folder / f"board{k:02d}.png"), image)
