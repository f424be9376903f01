"""What a new version takes over from the newest."""

import hashlib

import pytest
from seamosaic.schemas.provenance import Host, Provenance
from seamosaic.workflows import unchanged

from tests.workflows.test_report import full_quality

FILES = {"mosaic.tif": b"colours", "mosaic-source.tif": b"numbers", "bathymetry.tif": b"heights"}
NAMES = ["mosaic-source.tif", "mosaic.tif"]
KEY = "a" * 64


@pytest.fixture
def out(tmp_path):
    """A version with files of which nothing but bytes is read here."""
    folder = tmp_path / "out" / "reef" / "v1"
    (folder / "metadata").mkdir(parents=True)
    for name, content in FILES.items():
        (folder / name).write_bytes(content)
    provenance = Provenance(
        digest="x",
        mission_id="reef",
        created="2026-01-01T00:00:00Z",  # type: ignore[arg-type]
        software={},
        host=Host(platform="", cpu_count=1),
        inputs={},
        parameters={},
        parts={"mosaics": KEY},
        outputs={name: hashlib.sha256(content).hexdigest() for name, content in FILES.items()},
    )
    (folder / "metadata/provenance.json").write_text(provenance.model_dump_json())
    (folder / "quality.json").write_text(full_quality().model_dump_json())
    (tmp_path / "new").mkdir()
    return tmp_path / "out"


def take(out, key=KEY):
    new = out.parent / "new"
    return unchanged.take(unchanged.newest(str(out), "reef"), new, "mosaics", key), sorted(
        p.name for p in new.iterdir()
    )


def test_files_made_from_the_same_are_copied(out):
    assert take(out) == ({name: hashlib.sha256(FILES[name]).hexdigest() for name in NAMES}, NAMES)
    new = out.parent / "new/mosaic.tif"
    assert new.read_bytes() == FILES["mosaic.tif"]
    assert not new.samefile(out / "reef/v1/mosaic.tif")  # who edits one version must not edit another


def test_files_made_from_something_else_are_not(out):
    assert take(out, "b" * 64) == ({}, [])


@pytest.mark.parametrize("damage", ["changed", "gone"])
def test_damaged_files_are_not_taken_over(out, damage):
    file = out / "reef/v1/mosaic.tif"
    file.write_bytes(b"colour?") if damage == "changed" else file.unlink()
    assert take(out) == ({}, [])


def test_nothing_is_taken_from_a_version_of_another_format_or_from_none(out):
    (out / "reef/v1/quality.json").write_text("{}")
    assert unchanged.newest(str(out), "reef") is None
    assert unchanged.newest(str(out), "sea") is None
    assert take(out) == ({}, [])


def test_a_name_that_leads_out_of_the_version_is_not_followed(out):
    path = out / "reef/v1/metadata/provenance.json"
    outside = "mosaic/../../../outside.tif"
    (out / "outside.tif").write_bytes(b"others'")
    (out / "reef/v1/mosaic").mkdir()
    sha = hashlib.sha256(b"others'").hexdigest()
    text = path.read_text().replace('"mosaic.tif":', f'"{outside}": "{sha}", "mosaic.tif":')
    path.write_text(text)
    assert outside in text
    assert take(out) == ({name: hashlib.sha256(FILES[name]).hexdigest() for name in NAMES}, NAMES)
    assert not (out.parent.parent / "outside.tif").exists()
