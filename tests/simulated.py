"""Small simulated missions and their truth, for tests: thin wrappers around `workflows.simulate`."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from seamosaic.schemas.calibration import Calibration
from seamosaic.tasks.simulation_laser import LaserTruth, laser_truth
from seamosaic.tasks.simulation_navigation import Cameras
from seamosaic.tasks.simulation_terrain import Terrain, cones, height
from seamosaic.workflows.simulate import simulate


class Truth(NamedTuple):
    """File names in order of time, their poses (local frame), the seabed and the calibration."""

    images: tuple[str, ...]
    poses: Cameras
    terrain: Terrain
    calibration: Calibration


def small_mission(
    folder: Path, scene: str = "reef", images: int = 6, width: int = 608, seed: int = 1, **overrides: Any
) -> Path:
    """A mission of a few small images on a seabed no finer than they show; overrides as in `simulate`."""
    defaults: dict[str, Any] = {
        "survey": {"lines": 2 if images >= 6 else 1},
        "texture": {"cell_m": max(0.003, 1.5 / width)},
        "terrain": {"cell_m": 0.01 if width > 200 else 0.03},
    }
    merged = {key: value | overrides.get(key, {}) for key, value in defaults.items()}
    return simulate(scene, folder, seed=seed, images=images, width=width, **(overrides | merged))


def read_truth(mission: Path) -> Truth:
    """The truth beside a simulated mission."""
    truth = json.loads((mission / "truth/truth.json").read_text())
    with np.load(mission / "truth/terrain.npz") as t:
        cell = float(t["cell"])
        terrain = Terrain(t["h"], float(t["half"]), cell, float(t["depth"]), cones(t["h"], cell))
    R, C = (np.array([frame[key] for frame in truth["frames"]]) for key in "RC")
    calibration = Calibration.model_validate(yaml.safe_load((mission / "calibration.yaml").read_text()))
    return Truth(tuple(frame["image"] for frame in truth["frames"]), Cameras(R, C), terrain, calibration)


def laser_truth_of(mission: Path, image: str) -> LaserTruth:
    """The exact laser line of one image of a mission, by the image's file name."""
    truth = read_truth(mission)
    k, laser = truth.images.index(Path(image).name), truth.calibration.laser
    assert laser is not None
    pose = Cameras(truth.poses.R_local_camera[k : k + 1], truth.poses.C_local[k : k + 1])
    return laser_truth(truth.terrain, truth.calibration.camera, laser.sheets, laser.origin, pose)


def height_of(truth: Truth, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """True elevation (N,) of the seabed at local positions (N,)."""
    return height(truth.terrain, x, y).astype(float)
