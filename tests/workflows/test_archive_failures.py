"""What goes wrong in an archive: bad missions, killed runs, lost leases, what cannot be read or freed."""

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import psutil
import pytest
from seamosaic.catalog import leases, records, versions
from seamosaic.catalog.archives import open_archive
from seamosaic.catalog.pruning import Pruned
from seamosaic.workflows import archive_run
from seamosaic.workflows.archive_run import run_archive
from seamosaic.workflows.archive_states import assess_all

from tests.catalog.test_stac import validate
from tests.workflows.archives import RUN, SYNC, invoke, state_of, write


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


def test_a_mission_whose_id_changes_is_left_to_the_next_run(archive, monkeypatch):
    seen = archive_run.archive_states.assess

    def renamed(opened, url, ours=False):
        found = seen(opened, url, ours)
        return found._replace(id="another", state="new") if ours and url.endswith("m00") else found

    shutil.rmtree(archive / "products/plane-0")
    monkeypatch.setattr(archive_run.archive_states, "assess", renamed)
    result = invoke("run", archive, "--scheduler", "sync", "--json")
    assert result.exit_code == 1
    outcomes = {Path(one["url"]).name: one["why"] for one in json.loads(result.stdout)["missions"]}
    assert "its id has become another meanwhile" in outcomes["m00"]
    assert not (archive / "products/another").exists()


def test_a_mission_that_breaks_what_looks_at_it_is_one_of_many(archive, monkeypatch):
    look = archive_run.archive_states.memory.look

    def broken(url, out):
        if url.endswith("m00"):
            raise RuntimeError("surprise")
        return look(url, out)

    monkeypatch.setattr(archive_run.archive_states.memory, "look", broken)
    states = {Path(state.url).name: (state.state, state.why) for state in assess_all(open_archive(str(archive)))}
    assert states.pop("m00") == ("invalid", "it cannot be read: surprise")
    assert states
    assert "invalid" not in {state for state, _ in states.values()}


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


def test_sigterm_gives_leases_back(archive):
    shutil.rmtree(archive / "products/plane-0")
    process = subprocess.Popen([*RUN, str(archive)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    _until(lambda: leases.holder(str(archive / "products"), "plane-0"), process)
    process.terminate()
    _, said = process.communicate()
    assert process.returncode == 143
    assert "run the same command again" in said
    assert leases.holder(str(archive / "products"), "plane-0") is None


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
