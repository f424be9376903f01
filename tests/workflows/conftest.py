"""A small mission over a reef and its products, made once for all tests of the workflow; a small archive."""

import shutil
from pathlib import Path
from typing import NamedTuple

import pytest
from seamosaic.catalog import memory
from seamosaic.catalog.archives import open_archive
from seamosaic.schemas.parameters import Parameters
from seamosaic.workflows.archive_run import run_archive
from seamosaic.workflows.run import RunResult, run

from tests.simulated import small_mission
from tests.workflows.archives import SYNC, make_archive


class Processed(NamedTuple):
    mission: Path
    out: Path
    result: RunResult


@pytest.fixture(scope="session")
def reef(tmp_path_factory: pytest.TempPathFactory) -> Processed:
    folder = tmp_path_factory.mktemp("reef")
    mission, out = small_mission(folder / "mission", images=8), folder / "out"
    return Processed(mission, out, run(str(mission), out, Parameters(), scheduler="sync"))


@pytest.fixture(scope="session")
def pair(tmp_path_factory):
    """An archive of two missions that were processed, with the first one's second version made elsewhere."""
    folder = make_archive(tmp_path_factory.mktemp("pair") / "archive", 2, concurrency=2)
    assert not run_archive(open_archive(str(folder)), SYNC).failed
    return folder


@pytest.fixture
def archive(pair, tmp_path):
    shutil.copytree(pair, tmp_path / "archive")
    for mission in (tmp_path / "archive/missions").iterdir():  # it is elsewhere now
        memory.open_known(str(mission), str(tmp_path / "archive/products"))
    return tmp_path / "archive"
