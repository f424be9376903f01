"""What a second worker brings: `python benchmarks/workers.py [--images 120] [--width 3648] [--folder FOLDER]`.

Processes one mission, without dense matching, with one worker and with two, and prints a line of JSON: of each stage
that works in parallel its wall time with one over that with two, and of all of them; and what the client with its
scheduler (graphs, scheduling, gathering) takes while they work, as a share of all processor time then.
"""

import argparse
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import dask
import mission as whole
import psutil
from seamosaic.schemas.parameters import Parameters
from seamosaic.schemas.scene import SCENES
from seamosaic.workflows.executor import ClusterExecutor
from seamosaic.workflows.run import run

# A step of the stage, and the step within the stage that is one task: its time is taken off
_STAGES = {
    "extract, match": ("extract", "adjust"),
    "cells, surface": ("cells", "growth"),
    "terrain": ("terrain", ""),
    "mosaic": ("mosaic", "planar-align"),
    "mesh": ("mesh", ""),
}


class _Overhead:
    """Processor time of this process while the cluster works."""

    def __init__(self) -> None:
        self.seconds, original = 0.0, ClusterExecutor.compute

        def compute(executor: ClusterExecutor, *given: Any) -> list[Any]:
            before = _own_seconds()
            try:
                return original(executor, *given)
            finally:
                self.seconds += _own_seconds() - before

        ClusterExecutor.compute = compute


def _own_seconds() -> float:
    times = psutil.Process().cpu_times()
    return times.user + times.system


def measure(folder: Path, images: int, width: int) -> dict[str, Any]:
    mission, overhead = whole.simulated(folder, images, width), _Overhead()
    parameters = Parameters.model_validate({"bathymetry": {"dense": False}})
    walls, shares = {}, {}
    for workers in (1, 2):
        out, overhead.seconds = folder / "out-workers", 0.0
        shutil.rmtree(out, ignore_errors=True)
        made = run(str(mission), out, parameters, workers=workers)
        worked = sum(step.core_seconds for step in made.steps)
        shares[workers] = overhead.seconds / (overhead.seconds + worked)
        steps = {step.name: step for step in made.steps}
        walls[workers] = {stage: round(_seconds(steps, *names), 2) for stage, names in _STAGES.items()}
    total = {workers: sum(found.values()) for workers, found in walls.items()}
    return {
        "images": images,
        "width_px": width,
        "times_as_fast": round(total[1] / total[2], 3),
        "by_stage": {name: round(walls[1][name] / walls[2][name], 2) for name in walls[2]},
        "wall_s": {
            workers: {name: round(value, 1) for name, value in found.items()} for workers, found in walls.items()
        },
        "overhead_share": {workers: round(share, 4) for workers, share in shares.items()},
    }


def _seconds(steps: dict[str, Any], name: str, alone: str) -> float:
    whole = (steps[name].ended - steps[name].started).total_seconds()
    return whole - (steps[alone].core_seconds if alone else 0.0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--images", type=int, default=120)
    parser.add_argument("--width", type=int, default=SCENES["full"].width)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "seamosaic-benchmark")
    arguments = parser.parse_args()
    dask.config.set({"distributed.worker.preload": [str(Path(whole.__file__).resolve())]})
    print(json.dumps(measure(arguments.folder, arguments.images, arguments.width)))
