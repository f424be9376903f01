"""Soundings of simulated missions against their truth: how many, how precise, how honest, on the right arm or not.

    seamosaic simulate reef OUT --seed 41
    python benchmarks/soundings.py OUT ...

For each mission, over its images with a laser: share of the rows in which an arm can be seen that have a sounding;
sigma and robust 1-sigma of the error along the ray, millimetres; standard deviation of error over sigma, of those
within 8, along the ray and in pixels along the row (on a steep bottom what a point is aside adds to what it is too
deep); shares more than 10 and 30 mm off; shares that are on the other arm's line, and on no line; and how often
the arms' gap at their crossing is over its own 2 sigma.
"""

import json
import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import yaml
from seamosaic.schemas.calibration import Calibration
from seamosaic.schemas.parameters import LaserParameters
from seamosaic.tasks import triangulation
from seamosaic.tasks.camera import rays
from seamosaic.tasks.sheet_grid import on_sheets
from seamosaic.tasks.simulation_laser import laser_truth
from seamosaic.tasks.simulation_navigation import Cameras
from seamosaic.tasks.simulation_terrain import Terrain, cast, cones

PARAMETERS = LaserParameters()
# A point so near to a line of light, in pixels along the row, is on it; soundings of a row of two arms are told apart.
NEAR_PX = 4.0


class Measured(NamedTuple):
    """Soundings of one image, one entry each: sigma and error along the ray, metres; the same of the column; distances
    along the row to the nearest point of the own and of the other line, pixels."""

    sigma: np.ndarray
    error: np.ndarray
    sigma_px: np.ndarray
    off_own: np.ndarray
    off_other: np.ndarray
    visible: int
    seen: int
    gap: float
    reason: str


def terrain_of(folder: Path) -> Terrain:
    """The seabed of a mission."""
    with np.load(folder / "truth" / "terrain.npz") as t:
        h, cell = t["h"].astype(np.float32), float(t["cell"])
        return Terrain(h, float(t["half"]), cell, float(t["depth"]), cones(h, cell))


def distance(u: np.ndarray, v: np.ndarray, arm: np.ndarray, truth: tuple, number: np.ndarray) -> np.ndarray:
    """Pixels (N,) along the row from each point to the nearest true point of arms number (N,)."""
    row, true_u, true_arm = truth
    off = np.full(len(u), np.inf)
    for k in (0, 1):
        of_arm, mine = true_arm == k, np.flatnonzero(number == k)
        key = np.sort(row[of_arm] * 1e5 + true_u[of_arm])
        if not len(key) or not len(mine):
            continue
        wanted = v[mine] * 1e5 + u[mine]
        place = np.searchsorted(key, wanted)
        near = [wanted - key[np.clip(place + d, 0, len(key) - 1)] for d in (-1, 0)]
        off[mine] = np.where(np.abs(near[0]) < np.abs(near[1]), *near)
    return off


def measured(folder: Path, frame: dict, terrain: Terrain, calibration: Calibration) -> Measured:
    """One image."""
    camera, light = calibration.camera, calibration.laser
    assert light is not None
    image = cv2.imread(str(folder / "images" / frame["image"]), cv2.IMREAD_COLOR)
    R, C = np.array(frame["R"]), np.array(frame["C"])
    found = triangulation.sound(np.asarray(image, np.uint8), camera, light, PARAMETERS)
    s = found.soundings
    truth = laser_truth(terrain, camera, light.sheets, light.origin, Cameras(R[None], C[None]))
    lines = (truth.row, truth.u, truth.arm)
    origin, direction = rays(camera, s.uv)
    true_range = cast(terrain, origin @ R.T + C, direction @ R.T)
    error = np.linalg.norm(s.X_camera - origin, axis=1) - true_range
    own, other = (distance(*s.uv.T, s.arm, lines, number) for number in (s.arm, 1 - s.arm))
    visible = len(np.unique(truth.row * 2 + truth.arm))
    gap = found.agreement.gap_m / found.agreement.sigma_m if found.agreement else np.nan
    change = np.choose(s.arm, on_sheets(camera, light, *s.uv.T).per_px)
    sigma_px = s.sigma_m / np.abs(np.linalg.norm(s.X_camera - origin, axis=1) * change)
    return Measured(s.sigma_m, error, sigma_px, own, other, visible, len(s.uv), gap, found.reason)


def row(folder: Path, every: int) -> str:
    """One line of the table."""
    calibration = Calibration.model_validate(yaml.safe_load((folder / "calibration.yaml").read_text()))
    terrain = terrain_of(folder)
    frames = json.loads((folder / "truth" / "truth.json").read_text())["frames"]
    frames = [f for f in frames if f.get("role", "combined") != "texture"][::every]
    images = [measured(folder, frame, terrain, calibration) for frame in frames]
    sigma, error, sigma_px, own, other = (np.concatenate(part) for part in list(zip(*images, strict=True))[:5])
    z, own_z = error / sigma, own / sigma_px
    own, other = np.abs(own), np.abs(other)
    robust = 1.4826 * np.median(np.abs(error - np.median(error)))
    wrong_arm, nowhere = (own > NEAR_PX) & (other < NEAR_PX), (own > NEAR_PX) & (other > NEAR_PX)
    recall = 100 * sum(i.seen for i in images) / sum(i.visible for i in images)
    gaps = np.array([i.gap for i in images])
    gaps = gaps[np.isfinite(gaps)]
    shares = [100 * np.mean(part) for part in (np.abs(error) > 0.01, np.abs(error) > 0.03, wrong_arm, nowhere)]
    scores = ", ".join(f"{part[np.abs(part) < 8].std():.2f}" for part in (z, own_z))
    precision = f"{1e3 * np.median(sigma):.2f} | {1e3 * robust:.2f} | {scores}"
    return (
        f"{folder.name} | {len(images)} | {len(error) / len(images):.0f} | {recall:.1f} | {precision} | "
        f"{1e3 * np.median(error):.2f} | "
        + " | ".join(f"{share:.3f}" for share in shares)
        + f" | {(np.abs(gaps) > 2).sum()} of {len(gaps)}"
    )


def main() -> None:
    """The table; with --every N only each Nth image."""
    names, every = sys.argv[1:], 1
    if "--every" in names:
        k = names.index("--every")
        every, names = int(names[k + 1]), names[:k] + names[k + 2 :]
    cv2.setNumThreads(1)
    print(
        "mission | images | soundings | recall, % | sigma, mm | error, mm | std of z, ray, row | bias, mm | > 10 mm, %",
        end=" | ",
    )
    print("> 30 mm, % | other arm, % | no line, % | gap over 2 sigma")
    for name in names:
        print(row(Path(name), every), flush=True)


if __name__ == "__main__":
    main()
