"""An archive as it is used: scheduled runs, two at once, reprocessing, comparing and pruning; and what goes wrong."""

import json
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import ExitStack, suppress
from pathlib import Path

import fsspec
import psutil
import pytest
import yaml
from seamosaic.catalog import json_files, leases, memory, records, stac, versions
from seamosaic.catalog.archives import open_archive
from seamosaic.catalog.pruning import Pruned
from seamosaic.schemas.problems import InvalidInput
from seamosaic.workflows import archive_run, cli, run
from seamosaic.workflows.archive_reprocess import change_parameters
from seamosaic.workflows.archive_run import Options, run_archive
from seamosaic.workflows.archive_states import assess_all
from seamosaic.workflows.compare import compare
from seamosaic.workflows.job import log
from typer.testing import CliRunner

from tests.catalog.test_stac import validate
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


def provenance(folder: Path, mission_id: str, number: int) -> dict:
    return json.loads((folder / f"products/{mission_id}/v{number}/metadata/provenance.json").read_text())


def computed(provenance: dict) -> dict[str, int]:
    return {step["name"]: step["count_computed"] for step in provenance["steps"]}


@pytest.mark.parametrize("count", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_the_life_of_an_archive(tmp_path, count):
    folder = make_archive(tmp_path / "archive", count, title="Plains")
    names = [f"plane-{k}" for k in range(count)]
    assert {states(folder)[name] for name in names} == {("new", 0)}

    # two scheduled runs at once, in processes of their own: each mission is processed by one of them
    other = subprocess.Popen([*RUN, str(folder)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    ours = run_archive(open_archive(str(folder)), SYNC)
    answer, _ = other.communicate()
    theirs = json.loads(answer)
    assert (other.returncode, ours.failed, theirs["failed"]) == (0, False, False)
    made = [one.id for one in ours.missions if one.outcome == "made"]
    made += [one["id"] for one in theirs["missions"] if one["outcome"] == "made"]
    assert Counter(made) == dict.fromkeys(names, 1)
    assert {states(folder)[name] for name in names} == {("current", 1)}
    for name in names:
        steps = provenance(folder, name, 1)["steps"]
        assert sum(step["count_computed"] for step in steps) == sum(step["count_total"] for step in steps) > 10
    assert not list((folder / "products/.leases").rglob("*.json"))
    catalog, items = validate(folder / "products")
    assert (catalog.title, len(items)) == ("Plains", count)

    # nothing changed: nothing is done
    again = run_archive(open_archive(str(folder)), SYNC)
    assert [(one.outcome, one.computed) for one in again.missions] == [("current", 0)] * count

    # some are made anew with another parameter: images, pairs and poses are reused
    chosen = names[1:]
    arguments = ["reprocess", str(folder), "--where", "not id == 'plane-0'", "--set", "grid.max_interpolation_m=0.1"]
    result = invoke(*arguments, "--scheduler", "sync", "--json")
    assert result.exit_code == 0, result.output
    assert {states(folder)[name] for name in chosen} == {("current", 2)}
    assert states(folder)["plane-0"] == ("current", 1)
    for name in chosen:
        counts = computed(provenance(folder, name, 2))
        assert [counts[step] for step in ("extract", "match", "adjust", "ties", "dense", "agreement")] == [0] * 6
        assert counts["surface"] > 0
    # the next scheduled run leaves it so
    assert {one.outcome for one in run_archive(open_archive(str(folder)), SYNC).missions} == {"current"}
    _, items = validate(folder / "products")
    assert len(items) == 2 * count - 1

    # the two versions differ where the parameter says
    two = folder / "products/plane-1"
    found = compare(two / "v1", two / "v2", tmp_path / "difference")
    assert found["parameters"] == [{"name": "grid.max_interpolation_m", "first": 1.0, "second": 0.1}]
    assert found["bathymetry"]["cells_lost"] > 1000
    assert found["bathymetry"]["cells_gained"] < 100
    assert found["trajectory"]["moved"]["position_max_m"] == 0
    assert (tmp_path / "difference/compare.html").stat().st_size > 10_000

    # without intermediate results, nothing has to be made; but a change makes what is missing
    products = {path: path.read_bytes() for path in folder.rglob("products/*/v*/*") if path.is_file()}
    result = invoke("prune", folder, "--keep-gb", "0")
    assert result.exit_code == 0, result.output
    assert not list(folder.glob("products/*/steps/**/*.npz"))
    assert {path: path.read_bytes() for path in products} == products
    assert {one.outcome for one in run_archive(open_archive(str(folder)), SYNC).missions} == {"current"}
    change_parameters(str(folder), [assess_all(open_archive(str(folder)))[0]], ["grid.max_interpolation_m=0.1"], False)
    last = run_archive(open_archive(str(folder)), SYNC)
    assert [one.outcome for one in last.missions] == ["made"] + ["current"] * (count - 1)
    assert computed(provenance(folder, "plane-0", 2))["extract"] == 4


@pytest.fixture(scope="module")
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


def state_of(folder: Path, mission_id: str = "plane-0"):
    return next(state for state in assess_all(open_archive(str(folder))) if state.id == mission_id)


def test_why_a_version_is_stale(archive, monkeypatch):
    mission = archive / "missions/m00"
    assert state_of(archive).why == ""
    monkeypatch.setitem(run.CODE, "dense", "another")
    assert state_of(archive).why == "other software: dense"
    monkeypatch.undo()
    write(archive, overrides=[{"where": "id like '*-0'", "set": {"grid.cell_m": 0.05, "mosaic.colour": "none"}}])
    found = state_of(archive)
    assert found.why == "grid.cell_m auto → 0.05, mosaic.colour flatfield → none"
    assert (found.state, found.would) == ("stale", "make v2")
    assert state_of(archive, "plane-1").state == "current"
    write(archive)
    calibration = mission / "calibration.yaml"
    calibration.write_text(calibration.read_text() + "\n")
    assert state_of(archive).why == "calibration.yaml changed"
    image = next((mission / "images").iterdir())
    image.write_bytes(image.read_bytes() + b"\0")
    assert state_of(archive).why == "1 of 4 images are new or were changed"
    image.unlink()
    calibration.write_text(calibration.read_text()[:-1])
    assert state_of(archive).why == "3 images instead of 4"


def test_an_image_that_was_only_touched_makes_no_version(archive):
    image = next((archive / "missions/m00/images").iterdir())
    image.touch()
    assert state_of(archive).state == "stale"
    outcomes = run_archive(open_archive(str(archive)), SYNC).missions
    assert [(one.outcome, one.version, one.computed) for one in outcomes] == [("current", 1, 0)] * 2
    assert state_of(archive).state == "current"


def test_bad_missions_do_not_stop_good_ones(archive):
    good, black, broken, twin = (archive / f"missions/{name}" for name in ("m00", "black", "broken", "twin"))
    for folder in (black, broken, twin):
        shutil.copytree(good, folder)
    for folder in (black, broken):
        text = (folder / "mission.yaml").read_text()
        (folder / "mission.yaml").write_text(text.replace("plane-0", folder.name))
    for image in (black / "images").iterdir():
        image.write_bytes(b"no picture")
    (black / "navigation.csv").write_text("\n".join((black / "navigation.csv").read_text().splitlines()[:2]) + "\n")
    (broken / "calibration.yaml").unlink()
    (twin / "mission.yaml").write_text(text.replace("plane-0", "plane-1"))
    shutil.rmtree(archive / "products/plane-0")
    result = invoke("run", archive, "--scheduler", "sync", "--json")
    assert result.exit_code == 1, result.output
    document = json.loads(result.stdout)
    outcomes = {Path(one["url"]).name: (one["outcome"], one["why"]) for one in document["missions"]}
    assert outcomes["m00"] == ("made", "")
    assert {name: outcomes[name][0] for name in ("broken", "twin", "m01")} == dict.fromkeys(
        ("broken", "twin", "m01"), "invalid"
    )
    assert "calibration.yaml" in outcomes["broken"][1]
    assert "give each mission.yaml an id of its own" in outcomes["twin"][1]
    assert outcomes["black"][0] in ("failed", "invalid")
    assert state_of(archive).state == "current"


def test_damaged_settings_are_no_defaults(archive):
    records.write_settings(f"{archive}/products", "plane-0", {"grid.cell_m": 0.05})
    path = archive / "products/plane-0/settings.json"
    path.write_text(path.read_text() + ",")
    state = state_of(archive)
    assert (state.state, "settings.json" in state.why) == ("invalid", True)


def test_products_that_cannot_be_read_are_those_of_one_mission(archive, monkeypatch):
    newest = versions.newest_version

    def closed(out, mission_id):
        if mission_id == "plane-0":
            raise PermissionError(13, "Permission denied")
        return newest(out, mission_id)

    monkeypatch.setattr(versions, "newest_version", closed)
    found = {state.id: state for state in assess_all(open_archive(str(archive)))}
    assert (found["plane-0"].state, "Permission" in found["plane-0"].why) == ("invalid", True)
    assert found["plane-1"].state == "current"


def test_a_failure_is_told_and_tried_again(archive, tiny_mission):
    """One mission has noise for images; the other's process is killed, as a system out of memory does."""
    shutil.rmtree(archive / "products/plane-0")
    write(archive)  # one at a time
    shutil.rmtree(archive / "missions/m01")
    tiny_mission.rename(archive / "missions/tiny")
    killer = threading.Thread(target=_kill_a_mission, args=(archive / "products/plane-0/steps",))
    killer.start()
    summary = run_archive(open_archive(str(archive)), SYNC)
    killer.join()
    assert summary.failed
    assert [(one.id, one.outcome) for one in summary.missions] == [("plane-0", "failed"), ("tiny", "failed")]
    assert summary.missions[0].why == "its process was ended by SIGKILL; out of memory is the usual reason"
    assert "nothing to map" in summary.missions[1].why
    found = state_of(archive)
    assert (found.state, found.would) == ("failed", "try again to make v1")
    assert found.why.startswith("its process was ended by SIGKILL")
    again = run_archive(open_archive(str(archive)), SYNC)
    assert [one.outcome for one in again.missions] == ["made", "failed"]
    assert (state_of(archive).state, state_of(archive, "tiny").state) == ("current", "failed")


def _kill_a_mission(steps: Path) -> None:
    """Kill the process that works on a mission: a child of a child of this one, the server that forks them."""
    _until(lambda: steps.exists())
    us, killed = psutil.Process(), []
    while not killed:
        for process in us.children(recursive=True):
            with suppress(psutil.NoSuchProcess):  # it ended meanwhile
                if process.ppid() != us.pid:
                    process.kill()
                    killed.append(process)


def _until(happened, process=None) -> None:
    deadline = time.monotonic() + 120
    while not happened():
        assert process is None or process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_run_that_was_killed_frees_its_missions_and_ends_its_processes(archive):
    write(archive, lease_s=3)
    shutil.rmtree(archive / "products/plane-0")
    process = subprocess.Popen([*RUN, str(archive)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _until(lambda: list((archive / "products").glob("plane-0/steps/extract/*/*.npz")), process)
    children = psutil.Process(process.pid).children(recursive=True)
    at_work = [child for child in children if child.ppid() != process.pid]
    for child in at_work:
        child.suspend()  # however long it takes to look at it
    running = state_of(archive)
    assert running.state == "running"
    assert f"process {process.pid} on" in running.why
    busy = run_archive(open_archive(str(archive)), SYNC)
    assert [one.outcome for one in busy.missions] == ["running", "current"]
    for child in at_work:
        child.resume()
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    _, alive = psutil.wait_procs(children, timeout=60)
    assert children
    assert not alive
    held = leases.holder(str(archive / "products"), "plane-0")
    if held is not None:
        time.sleep(max(0.0, held.heartbeat + held.term_s - time.time()) + 0.05)
    after = run_archive(open_archive(str(archive)), SYNC)
    assert [(one.outcome, one.version) for one in after.missions] == [("made", 1), ("current", 1)]
    assert after.missions[0].reused > 0
    assert not list((archive / "products/.leases").rglob("*.json"))


def test_an_archive_on_an_object_store(pair, s3):
    """Everything is there: archive.yaml, missions, results, leases and products."""
    url = s3.url("archive")
    store = fsspec.filesystem("s3")
    store.pipe_file(f"{url}/archive.yaml", b"format: 1\nmissions: ['missions/*']\n")
    store.put(f"{pair}/missions/m00", f"{url}/missions/m00", recursive=True)
    for expected in (("made", 1), ("current", 1)):
        summary = run_archive(open_archive(url), SYNC)
        assert [(one.outcome, one.version, one.why) for one in summary.missions] == [(*expected, "")]
    assert json_files.names(f"{url}/products/{leases.FOLDER}/plane-0") == []
    assert stac.latest(f"{url}/products", "plane-0") == 1
    said = invoke("prune", url, "--keep-gb", 0, "--json")
    assert json.loads(said.output)["entries"] > 10
    assert not store.find(f"{url}/products/plane-0/steps")
    row = json.loads(invoke("status", url, "--json").output)[0]
    assert (row["state"], row["version"], row["placed"]) == ("current", 1, 4)


def test_sigterm_gives_leases_back(archive):
    shutil.rmtree(archive / "products/plane-0")
    process = subprocess.Popen([*RUN, str(archive)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    _until(lambda: leases.holder(str(archive / "products"), "plane-0"), process)
    process.terminate()
    _, said = process.communicate()
    assert process.returncode == 143
    assert "run the same command again" in said
    assert leases.holder(str(archive / "products"), "plane-0") is None


def test_a_run_frees_what_is_over_the_limit(archive):
    write(archive, keep_gb=0)
    summary = run_archive(open_archive(str(archive)), SYNC)
    assert summary.pruned is not None
    assert summary.pruned.freed == summary.pruned.before > 100_000
    assert not list(archive.glob("products/*/steps/**/*.npz"))


def test_a_run_that_cannot_free_anything_has_its_summary(archive, monkeypatch, caplog):
    def failing(*_, **__):
        raise OSError("503: slow down")

    monkeypatch.setattr(archive_run.pruning, "prune", failing)
    write(archive, keep_gb=0)
    shutil.rmtree(archive / "products/plane-1")
    change = archive / "missions/m01/mission.yaml"
    change.unlink()
    summary = run_archive(open_archive(str(archive)), SYNC)
    assert (summary.failed, summary.pruned) == (False, None)
    assert "not freed: 503: slow down" in caplog.text
    catalog, _ = validate(archive / "products")
    assert [child.id for child in catalog.get_children()] == ["plane-0"]  # plane-1 is gone


def test_the_command_says_what_it_could_not_free(tmp_path, monkeypatch):
    monkeypatch.setattr(
        archive_run.pruning, "prune", lambda *_, **__: Pruned(2, 1, 1, (), ("reef: Permission denied",))
    )
    result = invoke("prune", tmp_path, "--keep-gb", "0")
    assert (result.exit_code, "not freed: reef: Permission denied" in result.output) == (1, True)


class Stuck:
    """A process that ends only when it is killed."""

    exitcode, killed = None, False

    def join(self, timeout=None):
        if not self.killed:
            assert timeout is not None

    def kill(self):
        self.killed = True


@pytest.mark.parametrize(("answer", "outcome"), [(("done", 1, False, 0, 9), "current"), (None, "failed")])
def test_a_child_without_its_lease_is_waited_for_in_vain_no_longer_but_heard(archive, answer, outcome):
    child, opened = archive_run._Child.__new__(archive_run._Child), open_archive(str(archive))
    child._answers, sender = multiprocessing.Pipe(duplex=False)
    child.state, child._archive, child.process, child._started = state_of(archive), opened, Stuck(), 0.0
    child.lease, child.held = leases.take(opened.products, "plane-0"), ExitStack()
    child.lease.why = "its lease could not be renewed"
    child.lease.lost.set()
    if answer:
        sender.send(answer)
    sender.close()
    found = child.outcome()
    assert (found.outcome, child.process.killed) == (outcome, True)
    assert found.why == ("nothing changed" if answer else "its lease could not be renewed")


def test_a_mission_that_is_not_selected_is_left_alone(archive):
    write(archive, select="id != 'plane-1'", parameters=None)
    shutil.rmtree(archive / "products/plane-1")
    assert [one.outcome for one in run_archive(open_archive(str(archive)), SYNC).missions] == ["current", "left out"]


def test_parameters_are_checked_before_any_is_written(archive):
    found = assess_all(open_archive(str(archive)))
    for wrong in ("grid.cell_m=-1", "grid.cel_m=0.1", "grid.cell_m"):
        with pytest.raises(InvalidInput):
            change_parameters(str(archive), found, ["mosaic.colour=none", wrong], False)
    assert records.read_settings(str(archive / "products"), "plane-0") == {}
    said = change_parameters(str(archive), found, ["mosaic.colour=none"], True)
    assert said == dict.fromkeys(("plane-0", "plane-1"), "mosaic.colour flatfield → none")
    assert states(archive) == dict.fromkeys(("plane-0", "plane-1"), ("current", 1))


def test_a_version_that_is_missing_from_the_catalogue_is_added(archive):
    (archive / "products/plane-0/collection.json").unlink()
    (archive / "products/catalog.json").unlink()
    run_archive(open_archive(str(archive)), SYNC)
    _, items = validate(archive / "products")
    assert len(items) == 2


def test_status_for_a_person_and_for_programs(archive):
    shutil.rmtree(archive / "products/plane-1")
    said = invoke("status", archive).output
    assert all(word in said for word in ("plane-0", "current", "4/4", "plane-1", "new", "make v1"))
    rows = json.loads(invoke("status", archive, "--json").output)
    assert [(row["id"], row["state"], row["version"], row["would"]) for row in rows] == [
        ("plane-0", "current", 1, "nothing"),
        ("plane-1", "new", 0, "make v1"),
    ]
    assert rows[0]["placed"] == rows[0]["images"] == 4
    assert rows[0]["cells"] > 1000
    assert 0 < rows[0]["sigma_m"] < 0.1
    rows = json.loads(invoke("status", archive, "--json", "--where", "cells > 1000 and placed == 4").output)
    assert [row["id"] for row in rows] == ["plane-0"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("status", "{}/missions"), r"archive\.yaml"),
        (("run", "{}", "-o", "elsewhere"), "--out: found elsewhere"),
        (("run", "{}", "--set", "grid.cell_m=1"), "seamosaic reprocess"),
        (("run", "{}/missions/m00"), "Add -o OUT"),
        (("reprocess", "{}", "--where", "id == 'x'", "--set", "grid.cell_m=1"), "no mission"),
        (("prune", "{}/products"), "--keep-gb 0"),
        (("prune", "{}"), "--keep-gb 0"),
    ],
)
def test_what_a_user_can_get_wrong_is_said(pair, arguments, said):
    result = invoke(*(argument.format(pair) for argument in arguments))
    assert isinstance(result.exception, InvalidInput)
    assert re.search(said, str(result.exception))


def test_a_mission_for_programs(pair):
    result = invoke("run", pair / "missions/m00", "-o", pair / "products", "--json", "--scheduler", "sync")
    document = json.loads(result.stdout)
    assert (document["mission"], document["new"], document["steps"]) == ("plane-0", False, [])
