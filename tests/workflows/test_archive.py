"""An archive as it is used: scheduled runs, two at once, reprocessing, comparing and pruning."""

import json
import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import fsspec
import pytest
from seamosaic.catalog import json_files, leases, records, stac
from seamosaic.catalog.archives import open_archive
from seamosaic.schemas.problems import InvalidInput
from seamosaic.workflows import run
from seamosaic.workflows.archive_reprocess import change_parameters
from seamosaic.workflows.archive_run import run_archive
from seamosaic.workflows.archive_states import assess_all
from seamosaic.workflows.compare import compare

from tests.catalog.test_stac import validate
from tests.workflows.archives import RUN, SYNC, invoke, make_archive, state_of, states, write


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


def test_a_run_frees_what_is_over_the_limit(archive):
    write(archive, keep_gb=0)
    summary = run_archive(open_archive(str(archive)), SYNC)
    assert summary.pruned is not None
    assert summary.pruned.freed == summary.pruned.before > 100_000
    assert not list(archive.glob("products/*/steps/**/*.npz"))


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
        (("prune", "{}/prodcts", "--keep-gb", "0"), "prodcts: found nothing; expected a folder of products"),
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
