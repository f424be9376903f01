"""Laser detection, segmentation and triangulation of one image: time, precision, completeness.

    python benchmarks/laser.py

Simulates images (a temporary folder), measures them on one thread, with a worker's settings of memory, and prints: the
time of a 10-megapixel image over the time of decoding it; over signal to noise, RMS over the bound of Cramér and Rao,
recall, precision and the standard deviation of error over sigma.
"""

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import yaml
from seamosaic.schemas.calibration import Calibration, Camera, CrossGeometry, Laser
from seamosaic.schemas.parameters import LaserParameters
from seamosaic.tasks import line_profile, sheet_search, triangulation
from seamosaic.workflows.heap import WORKER_ENVIRONMENT
from seamosaic.workflows.simulate import simulate

PARAMETERS = LaserParameters()
LIGHT = Laser(origin=(1.2, 0, 0), planes=CrossGeometry(baseline=1.2, angle=25))
NOISE, GROUND = 0.012, 0.25
IMAGES, REPEATS = 2, 20
ROUGH = {"relief_m": 0.2, "boulders_per_m2": 1.5, "boulder_height_m": 0.6}
SCENES = (("reef", 1.6, None), ("reef", 4.0, None), ("reef", 2.5, ROUGH), ("night", 1.6, None), ("night", 4.0, ROUGH))


def seconds(work: Callable[[], object]) -> float:
    """Processor time: neighbours on the machine take none of it, but slow it by the memory that they use."""
    start = time.process_time()
    work()
    return time.process_time() - start


def speed(folder: Path) -> None:
    """Time of 10-megapixel images over the time of decoding them: narrow and wide lines, rough bottom, night.

    Detection, segmentation and triangulation, and in brackets with where the light is to be erased and the check of
    the calibration, which `sound` does, too.
    """
    print("scene | line, px | JPEG, MB | decode, ms | laser, ms | ratio, median | ratio, 90 % | soundings")
    for name, width_px, terrain in SCENES:
        mission = simulate(
            name,
            folder / f"{name}{width_px}",
            3,
            images=IMAGES,
            width=3648,
            survey={"lines": 1},
            laser={"width_px": width_px},
            terrain=terrain,
        )
        calibration = Calibration.model_validate(yaml.safe_load((mission / "calibration.yaml").read_text()))
        camera, light = calibration.camera, calibration.laser
        assert light is not None
        times, count, size = [], 0, 0.0
        for path in sorted((mission / "images").iterdir()):
            content = np.fromfile(path, np.uint8)
            bgr = np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR), np.uint8)
            count += len(triangulation.sound(bgr, camera, light, PARAMETERS).soundings.uv)
            size += len(content) / 1e6
            # in turn, so that both see the same neighbours on the machine
            for _ in range(REPEATS):
                decode = seconds(lambda c=content: cv2.imdecode(c, cv2.IMREAD_COLOR))
                laser = seconds(lambda b=bgr, c=camera, x=light: triangulation.on_both_sheets(b, c, x, PARAMETERS))
                sound = seconds(lambda b=bgr, c=camera, x=light: triangulation.sound(b, c, x, PARAMETERS))
                times.append((decode, laser, sound))
        decode, laser, sound = np.array(times).T
        cost = f"{1e3 * np.median(decode):.1f} | {1e3 * np.median(laser):.1f} ({1e3 * np.median(sound):.1f})"
        ratio = f"{np.median(laser / decode):.2f} ({np.median(sound / decode):.2f})"
        high = f"{np.quantile(laser / decode, 0.9):.2f}"
        line = f"{name} | {width_px} | {size / IMAGES:.1f} | {cost} | {ratio} | {high}"
        print(f"{line} | {count / IMAGES:.0f}", flush=True)


def drawn(snr: float, width_px: float, seed: int, gamma: float) -> tuple[Camera, np.ndarray, np.ndarray, np.ndarray]:
    """A cross on a level bottom under white noise: camera, image, columns (2, H) and widths (2,) along the row."""
    rng = np.random.default_rng(seed)
    camera = Camera(model="brown", width=1216, height=912, fx=1584, fy=1584, cx=608, cy=456)
    x, y = np.arange(1216), (np.arange(912) - 456) / 1584
    u = np.array([608 + 1584 * (s.offset / 2.7 - s.normal[1] * y - s.normal[2]) / s.normal[0] for s in LIGHT.sheets])
    width = width_px * np.hypot(1, np.abs(np.diff(u, axis=1)).mean(axis=1))
    line = sum(np.exp(-0.5 * ((x - u[k][:, None]) / width[k]) ** 2) for k in (0, 1))
    light = GROUND * np.array([0.95, 1, 0.6]) + snr * NOISE * np.asarray(line)[..., None] * np.array([0.2, 1, 0.15])
    light = np.clip(light + rng.normal(0, NOISE, light.shape), 0, 1)
    return camera, np.round(255 * light ** (1 / gamma)).astype(np.uint8), u, width


def precision(width_px: float, gamma: float, seeds: int = 4) -> None:
    """One row of the table for each signal to noise."""
    for snr in (3, 4, 5, 10, 20, 50):
        error, z, expected, visible = [], [], [], 0
        for seed in range(seeds):
            camera, image, u, width = drawn(snr, width_px, seed, gamma)
            small = sheet_search.reduce(image)
            arms = sheet_search.search(small, camera, LIGHT, PARAMETERS)
            line = line_profile.measure(image, arms, small.factor, PARAMETERS.gamma)
            off = line.uv[:, 0] - u[line.arm, line.uv[:, 1].astype(int)]
            error.append(off)
            z.append(off / line.sigma_px)
            expected.append(1.0623 * np.sqrt(width[line.arm]) / snr)
            apart = np.abs(u[0] - u[1]) > line_profile.APART * width.max()
            visible += int(((u > 0) & (u < camera.width - 1) & apart).sum())
        error, z, expected = (np.concatenate(part) for part in (error, z, expected))
        right = np.abs(error) < 5 * expected + 0.5
        ratio = np.sqrt((error[right] ** 2).mean() / (expected[right] ** 2).mean())
        recall = 100 * min(right.sum() / visible, 1)
        shares = f"{recall:.1f} | {100 * right.mean():.2f}"
        print(f"{width_px} | {gamma} | {snr} | {ratio:.2f} | {z[right].std():.2f} | {shares}", flush=True)


def main() -> None:
    """Both tables."""
    cv2.setNumThreads(1)
    print("line, px | gamma | SNR | RMS / bound | std of z | recall, % | precision, %")
    for width_px, gamma in ((1.6, 2.2), (1.6, 1.0), (3.0, 2.2)):
        precision(width_px, gamma)
    with tempfile.TemporaryDirectory() as folder:
        speed(Path(folder))


if __name__ == "__main__":
    if not WORKER_ENVIRONMENT.items() <= os.environ.items():  # memory is kept for the next image, as workers do
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **WORKER_ENVIRONMENT})
    main()
