"""Archives of small missions, and what is asked of them."""

import sys
from pathlib import Path

import yaml
from seamosaic.catalog.archives import open_archive
from seamosaic.workflows import cli
from seamosaic.workflows.archive_run import Options
from seamosaic.workflows.archive_states import assess_all
from seamosaic.workflows.job import log
from typer.testing import CliRunner

from tests.simulated import small_mission

SYNC = Options("sync")
RUN = [sys.executable, "-m", "seamosaic.workflows.cli", "run", "--scheduler", "sync", "--json"]


def make_archive(folder: Path, count: int, **config) -> Path:
    """An archive of small missions, each a second's work."""
    for k in range(count):
        small_mission(folder / f"missions/m{k:02d}", "plane", images=4, width=304, seed=k, survey={"lines": 1})
    write(folder, **config)
    return folder


def write(folder: Path, **config) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "archive.yaml").write_text(yaml.safe_dump({"format": 1, "missions": ["missions/*"], **config}))


def invoke(*arguments):
    """A command in this process; its log does not outlast it."""
    handlers = log.handlers
    try:
        return CliRunner().invoke(cli.app, [str(one) for one in arguments])
    finally:
        log.handlers = handlers


def states(folder: Path) -> dict[str, tuple[str, int]]:
    return {state.id: (state.state, state.version) for state in assess_all(open_archive(str(folder)))}


def state_of(folder: Path, mission_id: str = "plane-0"):
    return next(state for state in assess_all(open_archive(str(folder))) if state.id == mission_id)
