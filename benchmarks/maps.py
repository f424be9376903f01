"""What the maps cost: core seconds an image of the steps from poses to mosaics, and of writing all products.

    python benchmarks/maps.py [--images 20] [--folder FOLDER]

Simulates a mission of 10-megapixel images with a ground sample distance of 1 mm (kept in FOLDER for the next time),
maps it on one core with a mosaic of 2 mm, and prints a line of JSON.
"""

import argparse
import json
import multiprocessing
import resource
import shutil
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from seamosaic.schemas.parameters import Parameters
from seamosaic.workflows.run import run
from seamosaic.workflows.simulate import simulate

MAPS = ("ties", "dense", "agreement", "cells", "growth", "surface", "lighting", "planar-align", "mosaic", "mesh")
LAYERS = ("terrain", "contours")  # on top
ALTITUDE_M = 4.75  # of a lens of 4,752 px


def measure(folder: Path, images: int) -> dict:
    """Core seconds an image, by step; peak memory of the process, which includes extraction, GiB."""
    mission, out = folder / f"mission-{images}", folder / "out"
    if not mission.exists():
        survey = {"lines": max(1, round(images**0.5)), "altitude_m": ALTITUDE_M}
        scene = {"seed": 5, "images": images, "width": 3648, "survey": survey, "laser": {"brightness": 0.9}}
        # in a process of its own, whose memory is not that of the run
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            pool.submit(simulate, "reef", mission, **scene).result()
    shutil.rmtree(out, ignore_errors=True)
    parameters = Parameters.model_validate({"mosaic": {"cell_m": 0.002}})
    made = run(str(mission), out, parameters, scheduler="sync")
    seconds = {step.name: step.core_seconds / images for step in made.steps if step.name in MAPS + LAYERS}
    for version in made.path.parent.glob("v*"):
        shutil.rmtree(version)
    began = time.process_time()
    run(str(mission), out, parameters, scheduler="sync")
    total = sum(value for name, value in seconds.items() if name in MAPS)
    written = (time.process_time() - began) / images
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    figures = {**seconds, "maps": total, "products_and_report": written, "peak_gib": peak}
    return {"images": images, **{name: round(value, 3) for name, value in figures.items()}}


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--images", type=int, default=20)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "seamosaic-benchmark")
    arguments = parser.parse_args()
    print(json.dumps(measure(arguments.folder, arguments.images)))
