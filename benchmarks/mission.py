"""What a whole mission costs: `python benchmarks/mission.py [--images 500] [--width 3648] [--dense] [--folder FOLDER]`.

Simulates `full` (or as many images of it as asked for, on lines of the same shape), processes it on a local cluster,
without dense matching unless asked for, and prints a line of JSON: core seconds an image, all products included, and
their ratio to decoding the same JPEG files in the same run; peak resident memory of all processes; then a rerun with
nothing changed, and one with another `grid.cell_m`.

The simulated images are hard links to a few files, and seamosaic would extract each file once. Here every image
counts as one of its own (`each_image_anew`), as those of a real mission are. Workers load this file: what they do not
need is imported where it is used.
"""

import argparse
import json
import multiprocessing
import os
import resource
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import dask
import numpy as np
import psutil
from seamosaic.schemas.parameters import Parameters
from seamosaic.schemas.scene import SCENES
from seamosaic.workflows import extract

if TYPE_CHECKING:
    from seamosaic.workflows.run import RunResult

_SAMPLE_S = 0.5


def dask_setup(_: Any) -> None:
    """Called in each worker, which loads this file first."""
    each_image_anew()


def each_image_anew() -> None:
    """Extractions are stored by the image's name too, so that one file under many names is many images."""
    original, once = extract._extract, extract.once

    def named(job: Any, image: extract.ImageTask, read: Any) -> Any:
        def once_a_name(job: Any, step: str, code: str, inputs: list[str], parameters: Any, make: Any) -> Any:
            return once(job, step, code, [*inputs, image.path], parameters, make)

        extract.once = once_a_name
        return original(job, image, read)

    extract._extract = named


def decode_seconds(mission: Path) -> float:
    """Core seconds of decoding an image, the mean over the mission's different files."""
    files = {path.stat().st_ino: path for path in (mission / "images").iterdir()}
    cv2.setNumThreads(1)
    data = [np.frombuffer(path.read_bytes(), np.uint8) for path in files.values()]
    began = time.process_time()
    for content in data:
        cv2.imdecode(content, cv2.IMREAD_COLOR)
    return (time.process_time() - began) / len(data)


@contextmanager
def peak_memory() -> Iterator[list[float]]:
    """The largest sum of the resident memory of this process and all below it, GiB, once the context is left."""
    found, over = [0.0], threading.Event()

    def watch() -> None:
        me = psutil.Process()
        while not over.wait(_SAMPLE_S):
            total = 0
            for process in (me, *me.children(recursive=True)):
                try:
                    total += process.memory_info().rss
                except psutil.Error:  # it ended meanwhile
                    continue
            found[0] = max(found[0], total / 2**30)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield found
    finally:
        over.set()
        thread.join()


def core_seconds() -> tuple[float, float]:
    """Of this process, and of all that it started and that ended."""
    own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime, others.ru_utime + others.ru_stime


def measured(mission: Path, out: Path, parameters: Parameters, workers: int) -> "tuple[RunResult, dict[str, float]]":
    from seamosaic.workflows.run import run

    began, before = time.monotonic(), core_seconds()
    with peak_memory() as peak:
        made = run(str(mission), out, parameters, workers=workers)
    client, others = (now - then for now, then in zip(core_seconds(), before, strict=True))
    figures = {"core_s": client + others, "client_core_s": client, "wall_s": time.monotonic() - began}
    figures["peak_gib"] = peak[0]
    return made, {name: round(value, 2) for name, value in figures.items()}


def simulated(folder: Path, images: int, width: int) -> Path:
    """So many images of `full`, on lines of the same shape; kept for the next time."""
    from seamosaic.workflows.simulate import simulate

    mission = folder / f"full-{images}-{width}"
    if not mission.exists():
        whole = SCENES["full"]
        lines = max(2, round(whole.survey.lines * (images / whole.images) ** 0.5))
        # in a process of its own, whose memory is not that of the run
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            pool.submit(simulate, "full", mission, images=images, width=width, survey={"lines": lines}).result()
    return mission


def measure(folder: Path, images: int, width: int, workers: int, dense: bool) -> dict[str, Any]:
    mission, out = simulated(folder, images, width), folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    quick: dict[str, Any] = {"bathymetry": {"dense": dense}}
    decoding = decode_seconds(mission)
    made, first = measured(mission, out, Parameters.model_validate(quick), workers)
    again, rerun = measured(mission, out, Parameters.model_validate(quick), workers)
    coarser = Parameters.model_validate({**quick, "grid": {"cell_m": 0.05}})
    other, changed = measured(mission, out, coarser, workers)
    each = first["core_s"] / images
    return {
        "images": images,
        "width_px": width,
        "workers": workers,
        "dense": dense,
        "core_s_per_image": round(each, 3),
        "decoding_s_per_image": round(decoding, 4),
        "times_decoding": round(each / decoding, 2),
        "run": first,
        "steps_core_s_per_image": {step.name: round(step.core_seconds / images, 4) for step in made.steps},
        "rerun": {**rerun, "computed": sum(step.count_computed for step in again.steps)},
        "cell_changed": {
            **changed,
            "share_of_first": round(changed["core_s"] / first["core_s"], 3),
            "computed": {step.name: step.count_computed for step in other.steps if step.count_computed},
        },
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--images", type=int, default=500)
    parser.add_argument("--width", type=int, default=SCENES["full"].width)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--dense", action="store_true", help="with dense matching")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "seamosaic-benchmark")
    arguments = parser.parse_args()
    dask.config.set({"distributed.worker.preload": [str(Path(__file__).resolve())]})
    print(json.dumps(measure(arguments.folder, arguments.images, arguments.width, arguments.workers, arguments.dense)))
