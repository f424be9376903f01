"""What it costs to know that nothing changed: `python benchmarks/archive.py [IMAGES]`.

A mission of so many hard links to one small image; processor time of reading it once, and of looking at it again as
`run` and `status` do. The size of the images does not matter: they are not read again.
"""

import os
import sys
import tempfile
import time
from datetime import timedelta
from pathlib import Path

import cv2
import numpy as np
from seamosaic.catalog import memory
from seamosaic.schemas.parameters import Parameters
from seamosaic.workflows import request
from seamosaic.workflows.run import CODE

from tests.conftest import CALIBRATION, MISSION, START


def make_mission(folder: Path, images: int) -> None:
    (folder / "images").mkdir(parents=True)
    (folder / "mission.yaml").write_text(MISSION)
    (folder / "calibration.yaml").write_text(CALIBRATION)
    rows = ["time,latitude,longitude,depth,altitude,roll,pitch,heading"]
    for i in range(-3, 2 * images + 3):
        time_utc = START + i * timedelta(seconds=0.5)
        rows.append(f"{time_utc.isoformat()},{43.042 + i * 1e-7:.8f},6.0127,12,3.1,0.1,-0.2,10")
    (folder / "navigation.csv").write_text("\n".join(rows) + "\n")
    first = folder / "images" / START.strftime("V_%Y%m%dT%H%M%S.%fZ.jpg")
    cv2.imwrite(str(first), np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))
    for i in range(1, images):
        os.link(first, folder / "images" / (START + timedelta(seconds=i)).strftime("V_%Y%m%dT%H%M%S.%fZ.jpg"))


def timed(name: str, make) -> None:
    started = time.process_time()
    make()
    print(f"{name}: {time.process_time() - started:.2f} core-seconds")


def main() -> None:
    images = int(sys.argv[1]) if len(sys.argv) > 1 else 6250
    with tempfile.TemporaryDirectory() as folder:
        mission, out = str(Path(folder) / "mission"), str(Path(folder) / "out")
        make_mission(Path(mission), images)
        timed(f"first opening of {images} images", lambda: memory.open_known(mission, out))

        def again() -> None:
            opened = memory.open_known(mission, out)
            request.standing(out, opened.mission.id, request.ask(memory.inputs_digest(opened), Parameters(), CODE))

        timed("run again", again)
        timed("status", lambda: memory.look(mission, out))


if __name__ == "__main__":
    main()
