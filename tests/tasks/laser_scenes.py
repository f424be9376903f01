"""A laser cross on a flat bottom, drawn row by row at known columns."""

from typing import NamedTuple

import numpy as np
from seamosaic.schemas.calibration import Camera, CrossGeometry, Laser

LIGHT = Laser(origin=(1.2, 0, 0), planes=CrossGeometry(baseline=1.2, angle=25))
COLOUR = np.array([0.2, 1.0, 0.15])
WHITE = np.array([0.95, 1.0, 0.6])


class Scene(NamedTuple):
    """An image and what is true of it: columns (2, H) of both arms, standard deviations (2,) along the row."""

    camera: Camera
    image: np.ndarray
    u: np.ndarray
    width: np.ndarray


def camera(width: int = 900) -> Camera:
    """A pinhole of three quarters' height."""
    focal = 1.3 * width
    return Camera(model="brown", width=width, height=width * 3 // 4, fx=focal, fy=focal, cx=width / 2, cy=width / 3)


def columns(view: Camera, depth: float, tilt: float) -> np.ndarray:
    """Columns (2, H) of the arms on the plane Z = depth + tilt Y."""
    y = (np.arange(view.height) - view.cy) / view.fy
    level = (1 - tilt * y) / depth
    u = []
    for sheet in LIGHT.sheets:
        nx, ny, nz = sheet.normal
        u.append(view.cx + view.fx * (sheet.offset * level - ny * y - nz) / nx)
    return np.array(u)


def scene(
    snr: float,
    seed: int = 0,
    width_px: float = 1.8,
    noise: float = 0.012,
    ground: float = 0.25,
    depth: float = 2.7,
    tilt: float = 0.1,
    gamma: float = 2.2,
) -> Scene:
    """White noise, a Gaussian line snr times as high as that noise, and an even bottom; linear light 0 to 1."""
    view, rng = camera(), np.random.default_rng(seed)
    u = columns(view, depth, tilt)
    width = width_px * np.hypot(1, np.abs(np.diff(u, axis=1)).mean(axis=1))
    x = np.arange(view.width)
    line = sum(np.exp(-0.5 * ((x - u[k][:, None]) / width[k]) ** 2) for k in (0, 1))
    light = ground * WHITE + snr * noise * np.asarray(line)[..., None] * COLOUR
    return Scene(view, encoded(light + rng.normal(0, noise, light.shape), gamma), u, width)


def encoded(light: np.ndarray, gamma: float = 2.2) -> np.ndarray:
    """Levels of linear light."""
    return np.round(255 * np.clip(light, 0, 1) ** (1 / gamma)).astype(np.uint8)
