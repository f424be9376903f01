"""One image's share of a run."""

import pytest
import yaml
from seamosaic.catalog.digests import sha256
from seamosaic.catalog.store import Store
from seamosaic.schemas.calibration import Calibration
from seamosaic.schemas.parameters import Parameters
from seamosaic.workflows.extract import ImageTask, extract_batch
from seamosaic.workflows.job import Job

CHANGES = {
    "laser": ({"laser": {"range_max_m": 7.0}}, {}, None),
    "features": ({"features": {"max_features": 900}}, {}, None),
    "sheets": ({}, {"angle": 24}, None),
    "north": ({}, {}, 30),
}


@pytest.mark.parametrize(
    ("role", "read"),
    [
        ("combined", {"laser", "features", "sheets", "north"}),
        ("texture", {"features", "north"}),
        ("laser", {"laser", "sheets"}),
    ],
)
def test_an_image_is_made_again_for_what_its_role_reads(tiny_mission, role, read):
    values = yaml.safe_load((tiny_mission / "calibration.yaml").read_text())
    name = sorted(path.name for path in (tiny_mission / "images").iterdir())[0]
    digest = sha256((tiny_mission / "images" / name).read_bytes())

    def key(parameters: dict, sheets: dict, north_deg: int | None) -> str:
        planes = {**values["laser"]["planes"], **sheets}
        calibration = Calibration.model_validate({**values, "laser": {**values["laser"], "planes": planes}})
        store = Store(str(tiny_mission.parent / "steps"))
        job = Job(str(tiny_mission), "tiny", store, calibration, Parameters.model_validate(parameters))
        (done,) = extract_batch(job, [ImageTask(0, f"images/{name}", digest, role, north_deg)])
        entry = store.get(done.step, done.key)
        assert entry is not None
        assert ("thumbnail" in entry.arrays, "line_uv" in entry.arrays) == (role != "laser", role != "texture")
        return done.key

    usual = key({}, {}, None)
    assert {name for name, change in CHANGES.items() if key(*change) != usual} == read
