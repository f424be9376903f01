"""A fleet of workers that share nothing but an object store; the results are those of one thread, bit for bit."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import s3fs
from distributed import Client
from seamosaic.catalog import versions
from seamosaic.catalog.filesystems import ObjectStoreError
from seamosaic.schemas.parameters import Parameters
from seamosaic.schemas.problems import InvalidInput
from seamosaic.workflows import footing
from seamosaic.workflows import run as runner
from seamosaic.workflows.run import run
from upath import UPath

from tests import fleet
from tests.fleet import S3
from tests.products import differing


@pytest.fixture(scope="module")
def workers(s3: S3, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Two workers, each in a folder of its own; the scheduler's address."""
    folder = tmp_path_factory.mktemp("workers")
    with (
        fleet.scheduler(folder / "scheduler") as (address, _),
        fleet.worker(address, folder / "one"),
        fleet.worker(address, folder / "two"),
    ):
        with Client(address) as client:
            client.wait_for_workers(2, fleet.PATIENCE_S)
        yield address


def uploaded(s3: S3, mission: Path, name: str) -> str:
    s3fs.S3FileSystem(use_listings_cache=False).put(str(mission), f"{s3.bucket}/{name}", recursive=True)
    return s3.url(name)


def downloaded(path, folder: Path) -> Path:
    path.fs.get(path.path, str(folder), recursive=True)
    return folder


def test_two_workers_without_a_shared_disk_give_what_one_thread_gives(reef, s3, workers, tmp_path, monkeypatch):
    mission = uploaded(s3, reef.mission, "reef")
    result = run(mission, s3.url("maps"), Parameters(), scheduler=workers)
    assert (str(result.path), result.new) == (s3.url("maps", result.quality.mission.id, "v1"), True)
    assert differing(downloaded(result.path, tmp_path / "v1"), reef.result.path) == []
    fs = s3fs.S3FileSystem(use_listings_cache=False)
    left = [path for path in fs.find(f"{s3.bucket}/maps") if "/.tmp/" in path or "/.claims/" in path]
    assert left == []
    monkeypatch.setitem(runner.CODE, "workflow", "another")  # so that it goes over the steps again
    again = run(mission, s3.url("maps"), Parameters(), scheduler=workers)
    assert (again.new, sum(step.count_computed for step in again.steps)) == (False, 0)
    assert sum(step.count_reused for step in again.steps) > 10
    assert [version.number for version in versions.list_versions(s3.url("maps"), result.quality.mission.id)] == [1]


def test_workers_that_do_not_see_the_same_are_refused(tiny_mission, s3, workers, monkeypatch):
    remote = uploaded(s3, tiny_mission, "tiny")
    hidden = f"memory://{remote.rpartition('/')[2]}"  # of this process
    UPath(hidden).fs.put(f"{tiny_mission}/", f"{hidden}/", recursive=True)
    for mission, out, message in (
        (remote, "memory://maps", "does not see the store of results"),
        (hidden, s3.url("maps"), "does not see the mission"),
    ):
        with pytest.raises(InvalidInput, match=message) as caught:
            run(mission, out, Parameters(), scheduler=workers)
        assert len(caught.value.problems) == 2
    ours = (("seamosaic", "0123"), *footing.software()[1:])
    monkeypatch.setattr(runner, "software", lambda: ours)
    with pytest.raises(InvalidInput, match=r"seamosaic is .* here, 0123 there"):
        run(remote, s3.url("maps"), Parameters(), scheduler=workers)


def test_what_is_wrong_with_an_object_store_is_said(tiny_mission, s3, monkeypatch):
    with pytest.raises(InvalidInput, match="Make the bucket"):
        run(str(tiny_mission), "s3://nowhere/maps", Parameters(), scheduler="sync")
    with pytest.raises(InvalidInput, match=r"folder that holds mission\.yaml"):
        run("s3://nowhere/tiny", s3.url("maps"), Parameters(), scheduler="sync")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{fleet.free_port()}")
    s3fs.S3FileSystem.clear_instance_cache()
    with pytest.raises(ObjectStoreError, match="AWS_ENDPOINT_URL"):  # which another try may mend
        run(str(tiny_mission), s3.url("maps"), Parameters(), scheduler="sync")
    s3fs.S3FileSystem.clear_instance_cache()
