"""What a run asks for: the same asks for nothing, and all the software behind the products counts."""

import shutil
import subprocess
import sys

import pytest
from fsspec.implementations.memory import MemoryFileSystem
from seamosaic.catalog import images, memory, missions, records
from seamosaic.catalog.filesystems import ObjectStoreError
from seamosaic.catalog.images import MissingImage
from seamosaic.catalog.store import Store
from seamosaic.schemas.parameters import Parameters
from seamosaic.workflows import footing, job, maps, products, report, request, run

# What carries results but does not decide them
NEUTRAL = {
    *(f"catalog.{name}" for name in ("json_files", "leases", "records", "store", "versions")),
    *(f"catalog.{name}" for name in ("filesystems", "publishing", "runs")),
    *("schemas.cluster", "workflows.clusters", "workflows.footing", "workflows.heap"),
    *(f"schemas.{name}" for name in ("base", "expectation", "parameters", "problems", "products", "provenance")),
    *(f"workflows.{name}" for name in ("executor", "job", "memory_need", "progress", "request", "session")),
}
LOADED = "import sys, seamosaic.workflows.run; print(*(name for name in sys.modules if name.startswith('seamosaic.')))"


def test_every_module_behind_the_products_is_in_the_code_of_a_request(monkeypatch):
    """A module that is forgotten would leave versions current that its change made stale."""
    for part, deciding in (("products", products), ("opening", request), ("workflow", run)):
        pages = [report.TEMPLATE] if deciding is products else []
        assert run.CODE[part] == job.code_version(*deciding.DECIDING, pages=pages)
    assert run._VERSIONS.items() <= run.CODE.items()
    seen = {}
    monkeypatch.setattr(job.inspect, "getsource", lambda module: seen.setdefault(module.__name__, "") and "")
    steps = ("dense", "extract", "layers", "maps", "match", "meshing", "mosaics", "solve", "products")
    modules = [vars(run)[name] for name in steps]
    for module in [*modules, *run.DECIDING, *products.DECIDING, *request.DECIDING]:
        job.code_version(module)
    loaded = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, check=True).stdout.split()
    names = {name.removeprefix("seamosaic.") for name in loaded} - {"schemas", "tasks", "catalog", "workflows"}
    missing = names - {name.removeprefix("seamosaic.") for name in seen} - NEUTRAL
    assert missing == set()
    assert names >= NEUTRAL


def ask(inputs="0" * 64, code=None, **parameters):
    return request.ask(inputs, Parameters.model_validate(parameters), code or run.CODE)


def test_inputs_parameters_and_code_make_a_request():
    digests = [
        ask(),
        ask("1" * 64),
        ask(grid={"cell_m": 0.05}),
        ask(code={**run.CODE, "dense": "other"}),
    ]
    assert len({one.digest for one in digests}) == 4
    assert ask(grid={"cell_m": "auto"}) == ask()


def test_the_version_that_was_asked_for_stands(reef):
    opened = memory.open_known(str(reef.mission), str(reef.out))
    asked = request.ask(memory.inputs_digest(opened), Parameters(), run.CODE)
    found = request.standing(str(reef.out), opened.mission.id, asked)
    assert found is not None
    assert found.path == reef.result.path
    assert request.provenance(found)["request"] == asked.model_dump(mode="json")
    other = request.ask(asked.inputs, Parameters.model_validate({"grid": {"cell_m": 0.05}}), run.CODE)
    assert request.standing(str(reef.out), opened.mission.id, other) is None


def test_a_rerun_opens_no_cluster_and_walks_no_step(reef, monkeypatch):
    monkeypatch.setattr(run, "open_executor", None)
    again = run.run(str(reef.mission), reef.out, Parameters())
    assert (again.path, again.new, again.steps) == (reef.result.path, False, ())
    assert again.quality == reef.result.quality


def test_other_software_that_comes_to_the_same_is_looked_at_once(reef, tmp_path, monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(reef.out, out)
    monkeypatch.setitem(run.CODE, "workflow", "another")
    again = run.run(str(reef.mission), out, Parameters(), scheduler="sync")
    assert (again.path.name, again.new) == ("v1", False)
    assert sum(step.count_reused for step in again.steps) == sum(step.count_total for step in again.steps) > 10
    assert run.run(str(reef.mission), out, Parameters(), scheduler="sync").steps == ()
    monkeypatch.undo()  # two machines with unlike software take turns
    assert run.run(str(reef.mission), out, Parameters(), scheduler="sync").steps == ()


def test_an_image_that_could_not_be_read_just_then_is_tried_again(reef, tmp_path, monkeypatch):
    out, read = tmp_path / "out", images.read_file

    def once_broken(url, path):
        if path.endswith(first):
            raise MissingImage("the disk is tired")
        return read(url, path)

    first = sorted((reef.mission / "images").iterdir())[0].name
    monkeypatch.setattr(images, "read_file", once_broken)
    quick = Parameters.model_validate({"bathymetry": {"dense": False}, "mosaic": {"cell_m": 0.02}})
    broken = run.run(str(reef.mission), out, quick, scheduler="sync")
    assert (broken.quality.trajectory.rejected, broken.request) == (1, None)
    monkeypatch.undo()
    again = run.run(str(reef.mission), out, quick, scheduler="sync")
    assert (again.path.name, again.quality.trajectory.rejected) == ("v2", 0)
    last = records.read_last_run(str(out), again.quality.mission.id)
    assert last is not None
    assert (last.outcome, last.version, last.request) == ("done", 2, again.request)


@pytest.mark.parametrize("hashed", [False, None])
def test_opening_without_reading_gives_no_inputs(reef, hashed):
    opened = missions.open_mission(str(reef.mission), {}, hashed=hashed)
    assert not opened.frames["sha256"].values.any()


def test_a_library_that_computes_makes_results_stale(monkeypatch):
    installed = [name for name, _ in footing.installed(*footing.COMPUTING)]
    assert {"shapely", "contourpy"} < set(installed)
    assert any(name.startswith("open3d") for name in installed)
    version, codes = footing.version, {job.code_version(maps)}
    for other in installed:
        monkeypatch.setattr(footing, "version", lambda name, other=other: "0" if name == other else version(name))
        codes.add(job.code_version(maps))
        footing.software.cache_clear()
        assert (other, "0") in footing.software()
    assert len(codes) == len(installed) + 1
    monkeypatch.undo()
    footing.software.cache_clear()


def test_cells_are_stale_with_the_tie_points_that_they_are_made_of():
    assert job.code_version(maps) != maps._VERSION


def test_a_worker_whose_store_does_not_answer_now_is_not_refused(monkeypatch):
    def failing(*_, **__):
        raise OSError("503: slow down")

    monkeypatch.setattr(MemoryFileSystem, "info", failing)
    with pytest.raises(ObjectStoreError, match="503"):
        footing.why_not("memory://nowhere", Store("memory://steps"), footing.Footing(footing.software(), "", ""))
