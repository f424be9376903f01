"""What tasks need of memory: said before a run starts, refused where it cannot be had, and true."""

import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
import yaml
from seamosaic.schemas.calibration import Calibration
from seamosaic.schemas.parameters import Parameters
from seamosaic.schemas.problems import InvalidInput
from seamosaic.workflows import executor, memory_need
from seamosaic.workflows.check import check
from seamosaic.workflows.memory_need import GIB
from seamosaic.workflows.run import run

from tests.simulated import small_mission


def need(mission, parameters, images=6, range_m=2.7):
    calibration = Calibration.model_validate(yaml.safe_load((mission / "calibration.yaml").read_text()))
    return memory_need.needs(calibration.camera, parameters, images, range_m)


def test_a_plan_that_cannot_fit_is_refused_before_it_starts(tiny_mission, tmp_path, monkeypatch):
    monkeypatch.setattr(executor, "MEMORY_LIMIT", 4 * GIB)
    large = Parameters.model_validate({"mosaic": {"tile_cells": 8192}})
    with pytest.raises(InvalidInput) as refused:
        run(str(tiny_mission), tmp_path / "out", large, scheduler="threads", workers=2)
    (problem,) = refused.value.problems
    assert problem.key == "mosaic.tile_cells"
    assert problem.found == "a tile of the mosaic (8192 x 8192) needs 2.2 GiB"
    assert problem.expected == "at most the 2.0 GiB of a worker"
    assert "Make mosaic.tile_cells smaller, or give a worker more memory" in problem.remedy
    assert not list((tmp_path / "out").rglob("*.npz"))


def test_what_grows_with_the_mission_and_what_does_not(tiny_mission):
    few, many = (need(tiny_mission, Parameters(), images) for images in (100, 10_000))
    grown = [b.size - a.size for a, b in zip(few, many, strict=True)]
    assert [bool(more) for more in grown] == [False, True, False, False]
    assert 4.7 < grown[1] / GIB < 6.0  # 10,000 images with few soundings took 5.1 with Python and all (benchmarks)


def test_large_files_count(tiny_mission):
    calibration = Calibration.model_validate(yaml.safe_load((tiny_mission / "calibration.yaml").read_text()))
    small, large = (memory_need.needs(calibration.camera, Parameters(), 6, 2.7, size)[0].size for size in (0, GIB))
    assert 1.9 * GIB < large - small <= 2 * GIB  # the one that is worked on, and the next


def test_without_a_limit_nothing_is_refused(tiny_mission):
    memory_need.refuse_what_cannot_fit(need(tiny_mission, Parameters(), 10**6), None)


def test_check_says_it(tiny_mission):
    assert "GiB a worker" in dict(check(str(tiny_mission), Parameters()).plan)["memory"]


RUN = """\
import sys
from seamosaic.schemas.parameters import Parameters
from seamosaic.workflows.run import run
if __name__ == "__main__":
    chosen = {"mosaic": {"cell_m": 0.001, "tile_cells": 3072}}
    run(sys.argv[1], sys.argv[2], Parameters.model_validate(chosen), workers=1)
"""


def worker_peak(pid: int) -> int:
    """The largest resident memory, bytes, that a process below this one ever had: the worker's."""
    most = 0
    with suppress(psutil.NoSuchProcess):
        for below in psutil.Process(pid).children(recursive=True):
            with suppress(OSError):  # ended meanwhile
                status = Path(f"/proc/{below.pid}/status").read_text().splitlines()
                most = max([most, *(1024 * int(line.split()[1]) for line in status if line.startswith("VmHWM"))])
    return most


@pytest.mark.slow
def test_what_is_said_is_what_a_run_needs(tmp_path):
    """Neither less, which would end in the middle, nor so much more that what would fit is refused."""
    mission = small_mission(tmp_path / "mission", images=6, width=3648)
    script = tmp_path / "run.py"
    script.write_text(RUN)
    running = subprocess.Popen([sys.executable, script, mission, tmp_path / "out"])
    peak = 0
    while running.poll() is None:
        peak = max(peak, worker_peak(running.pid))
        time.sleep(0.1)
    assert running.returncode == 0
    assert list((tmp_path / "out").glob("*/v1/mosaic.tif"))
    said = max(need(mission, Parameters())).size
    assert 0.6 * said < peak < 1.1 * said
