"""Faults put into a simulated survey: the map is not torn, and what is wrong is recovered or said."""

import csv
import shutil
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from seamosaic.schemas.parameters import Parameters
from seamosaic.workflows import match
from seamosaic.workflows.evaluate import evaluate
from seamosaic.workflows.run import run

from tests.simulated import small_mission

pytestmark = pytest.mark.slow
SURVEY = {"lines": 2}
Rows = list[dict[str, str]]


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """A survey without faults, and the rigid rms of its adjusted camera centres, metres."""
    mission = small_mission(tmp_path_factory.mktemp("clean") / "mission", images=16, width=912, seed=21, survey=SURVEY)
    rms = rigid_rms_m(mission)
    assert rms < 0.006
    return mission, rms


def rigid_rms_m(mission: Path, **where: Any) -> float:
    result = run(str(mission), mission.parent / "out", Parameters(), **({"workers": 2} | where))
    assert result.quality.trajectory is not None
    assert result.quality.trajectory.adjusted == 16
    return evaluate(result.path, mission)["trajectory"]["rigid_rms_m"]


def changed(clean: Path, folder: Path, change: Callable[[Rows], Rows]) -> Path:
    """A copy of a mission with another navigation.csv."""
    shutil.copytree(clean, folder / "mission")
    path = folder / "mission/navigation.csv"
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(change(rows))
    return folder / "mission"


def time_of(row: dict[str, str]) -> datetime:
    return datetime.fromisoformat(row["time"].replace("Z", "+00:00"))


def jump(rows: Rows) -> Rows:
    """Two metres to the north in the middle."""
    for row in rows[len(rows) // 2 :]:
        row["latitude"] = f"{float(row['latitude']) + 2 / 111_000:.9f}"
    return rows


def gap(rows: Rows) -> Rows:
    """Nothing for 20 s."""
    middle = time_of(rows[0]) + (time_of(rows[-1]) - time_of(rows[0])) / 2
    return [row for row in rows if abs(time_of(row) - middle) > timedelta(seconds=10)]


def late(rows: Rows) -> Rows:
    """A clock that is 0.3 s off."""
    for row in rows:
        row["time"] = (time_of(row) + timedelta(seconds=0.3)).isoformat().replace("+00:00", "Z")
    return rows


@pytest.mark.parametrize("fault", [jump, gap, late])
def test_navigation_that_is_wrong_does_not_tear_the_map(clean: tuple[Path, float], tmp_path: Path, fault):
    mission, rms = clean
    assert rigid_rms_m(changed(mission, tmp_path, fault)) < 3 * rms


def test_a_mount_two_degrees_off_does_not_bend_the_map(clean: tuple[Path, float], tmp_path: Path):
    mission, rms = clean
    tilted = changed(mission, tmp_path, lambda rows: rows)
    content = yaml.safe_load((tilted / "calibration.yaml").read_text())
    content["mount"]["rotation"][0] += 2
    (tilted / "calibration.yaml").write_text(yaml.safe_dump(content))
    assert rigid_rms_m(tilted) < 3 * rms


def test_a_tenth_of_wrong_matches_is_left_out(clean: tuple[Path, float], tmp_path: Path, monkeypatch):
    mission, rms = clean
    true, rng = match.between, np.random.default_rng(0)

    def between(*given: Any) -> Any:
        made = true(*given)
        if "uv_j" in made.arrays:
            wrong = rng.random(len(made.arrays["uv_j"])) < 0.1
            moved = np.where(wrong[:, None], rng.permutation(made.arrays["uv_j"]), made.arrays["uv_j"])
            made = made._replace(arrays={**made.arrays, "uv_j": moved.astype(np.float32)})
        return made

    monkeypatch.setattr(match, "between", between)
    copy = changed(mission, tmp_path, lambda rows: rows)
    assert rigid_rms_m(copy, scheduler="sync", workers=None) < 3 * rms


def test_a_seabed_that_repeats_itself_makes_no_false_loops(clean: tuple[Path, float], tmp_path: Path):
    texture = {"period_m": 2.5}  # more than an image shows, less than a line is long
    mission = small_mission(tmp_path / "mission", images=16, width=912, seed=21, survey=SURVEY, texture=texture)
    assert rigid_rms_m(mission) < 3 * clean[1]
