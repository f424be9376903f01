"""A small mission that every test may spoil in its own way, and an S3 server."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
import s3fs
from hypothesis import settings

from tests.fleet import S3, s3_server

settings.register_profile("tests", deadline=None, max_examples=60)  # time is no measure on a loaded machine
settings.load_profile("tests")

MISSION = """\
format: 1
id: tiny
title: A tiny mission
images:
  - {path: 'images/*.jpg', role: combined}
timestamps: {from: filename, pattern: '%Y%m%dT%H%M%S.%fZ'}
calibration: calibration.yaml
navigation:
  path: navigation.csv
  sigma: {horizontal: 0.4, depth: 0.03, roll: 0.27, pitch: 0.27, heading: 0.84}
"""

CALIBRATION = """\
format: 1
camera:
  model: brown
  width: 64
  height: 48
  fx: 80.0
  fy: 80.0
  cx: 31.5
  cy: 23.5
laser:
  origin: [1.2, 0.0, 0.0]
  planes: {baseline: 1.2, angle: 25, roll: 45}
"""

START = datetime(2026, 6, 3, 2, 14, 10, 136751, UTC)


def _navigation(images: int) -> str:
    rows = ["time,latitude,longitude,depth,altitude,roll,pitch,heading"]
    for i in range(-3, 2 * images + 3):
        time = START + i * timedelta(seconds=0.5)
        heading = (358 + i) % 360  # through north
        rows.append(f"{time.isoformat()},{43.042 + i * 1e-6:.8f},6.0127,{12 + 0.01 * i:.3f},3.1,0.1,-0.2,{heading}")
    return "\n".join(rows) + "\n"


@pytest.fixture
def tiny_mission(tmp_path: Path) -> Path:
    """Ten combined images of 64 x 48 pixels, a second apart, with navigation twice a second."""
    folder, count = tmp_path / "tiny", 10
    (folder / "images").mkdir(parents=True)
    (folder / "mission.yaml").write_text(MISSION)
    (folder / "calibration.yaml").write_text(CALIBRATION)
    (folder / "navigation.csv").write_text(_navigation(count))
    rng = np.random.default_rng(0)
    for i in range(count):
        name = (START + timedelta(seconds=i)).strftime("V_%Y%m%dT%H%M%S.%fZ.jpg")
        picture = rng.integers(0, 255, (48, 64, 3), np.uint8)
        assert cv2.imwrite(str(folder / "images" / name), picture)
    return folder


@pytest.fixture(scope="session")
def s3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[S3]:
    """An S3 server with a bucket, to which the environment leads."""
    with s3_server(tmp_path_factory.mktemp("s3")) as server, pytest.MonkeyPatch.context() as patch:
        for name, value in server.env.items():
            patch.setenv(name, value)
        s3fs.S3FileSystem.clear_instance_cache()
        s3fs.S3FileSystem().mkdir(server.bucket)
        yield server
        s3fs.S3FileSystem.clear_instance_cache()
