"""A small mission over a reef and its products, made once for all tests of the workflow."""

from pathlib import Path
from typing import NamedTuple

import pytest
from seamosaic.schemas.parameters import Parameters
from seamosaic.workflows.run import RunResult, run

from tests.simulated import small_mission


class Processed(NamedTuple):
    mission: Path
    out: Path
    result: RunResult


@pytest.fixture(scope="session")
def reef(tmp_path_factory: pytest.TempPathFactory) -> Processed:
    folder = tmp_path_factory.mktemp("reef")
    mission, out = small_mission(folder / "mission", images=8), folder / "out"
    return Processed(mission, out, run(str(mission), out, Parameters(), scheduler="sync"))
