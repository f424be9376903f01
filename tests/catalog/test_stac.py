"""The catalogue is STAC that other programs read, and current whoever writes at once."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime

import numpy as np
import pyproj
import pystac
import pystac.validation
import pytest
from seamosaic.catalog import json_files, metadata, rasters, stac, versions

ENTRY = stac.MissionEntry("reef", "A reef", "Vortex", "2026-06-03T10:00:00Z", "2026-06-03T11:30:00Z")
START, END = (datetime.fromisoformat(text.replace("Z", "+00:00")) for text in (ENTRY.start, ENTRY.end))


def make_version(products, mission_id, number, crs="EPSG:32631", left=25_000_000):
    folder = products / mission_id / f"v{number}"
    (folder / "metadata").mkdir(parents=True)
    (folder / "trajectory.csv").write_text("image")
    wkt = pyproj.CRS(crs).to_wkt() if crs else rasters.local_crs_wkt()
    with rasters.product_writer(folder, "bathymetry.tif", 0.02, left, 236_000_000, 60, 40, wkt) as writer:
        writer.write(0, 0, np.full((40, 60), -3.0))
    about = {"platform": "Vortex", "license": "CC-BY-4.0"}
    digests = metadata.output_digests(folder)
    metadata.write_stac_item(folder, mission_id, number, "A reef", START, END, digests, about)
    (folder / versions.PROVENANCE).write_text(json.dumps({"digest": str(number), "created": "2026-06-04T00:00:00Z"}))
    return folder


def validate(products):
    """Every file of the catalogue, against the core schemas that come with pystac."""
    catalog = pystac.Catalog.from_file(str(products / stac.CATALOG))
    items = list(catalog.get_items(recursive=True))
    for one in [catalog, *catalog.get_children(), *items]:
        text = one.to_dict()
        text["stac_extensions"] = []  # their schemas are elsewhere on the network
        pystac.validation.validate_dict(text)
    return catalog, items


def test_the_catalogue_is_valid_and_leads_to_every_file(tmp_path):
    for number in (1, 2):
        make_version(tmp_path, "reef", number, left=25_000_000 + 100 * number)
    stac.update_mission(str(tmp_path), ENTRY, "All reefs")
    catalog, items = validate(tmp_path)
    assert (catalog.title, [child.id for child in catalog.get_children()]) == ("All reefs", ["reef"])
    assert [item.id for item in items] == ["reef-v1", "reef-v2"]
    assert [item.properties["deprecated"] for item in items] == [True, False]
    for item in items:
        assert item.get_collection().id == "reef"
        assert {"bathymetry.tif", "trajectory.csv"} == set(item.assets)
        for asset in item.get_assets().values():
            assert (tmp_path / "reef" / item.id[-2:] / asset.title).samefile(asset.get_absolute_href())
    collection = next(catalog.get_children())
    (box,) = collection.extent.spatial.bboxes
    assert box[0] == min(item.bbox[0] for item in items) < max(item.bbox[0] for item in items) < box[2]
    assert collection.extent.temporal.intervals == [[START, END]]
    assert collection.license == "CC-BY-4.0"
    assert stac.latest(str(tmp_path), "reef") == 2


def test_a_mission_without_a_place_is_in_it_too(tmp_path):
    make_version(tmp_path, "pool", 1, crs=None)
    stac.update_mission(str(tmp_path), ENTRY._replace(id="pool", title=""), "")
    _, (item,) = validate(tmp_path)
    assert (item.geometry, item.bbox) == (None, None)
    assert set(item.assets) == {"trajectory.csv", "bathymetry.tif"}
    assert pyproj.CRS.from_wkt(item.properties["proj:wkt2"]).is_engineering
    assert item.common_metadata.start_datetime == START


def test_a_version_without_its_item_is_not_in_it(tmp_path):
    for number in (1, 2):
        folder = make_version(tmp_path, "reef", number)
    (folder / "metadata/stac-item.json").unlink()
    stac.update_mission(str(tmp_path), ENTRY, "")
    assert [item.id for item in validate(tmp_path)[1]] == ["reef-v1"]


def test_what_is_gone_is_no_longer_linked(tmp_path):
    for number in (1, 2):
        make_version(tmp_path, "reef", number)
    stac.update_mission(str(tmp_path), ENTRY, "")
    shutil.rmtree(tmp_path / "reef/v1")
    stac.update_mission(str(tmp_path), ENTRY, "")
    _, items = validate(tmp_path)
    assert [item.id for item in items] == ["reef-v2"]
    assert [path.name for path in (tmp_path / "reef/items").iterdir()] == ["v2.json"]


def test_a_mission_without_a_version_is_not_in_it(tmp_path):
    stac.update_mission(str(tmp_path), ENTRY, "")
    assert list(tmp_path.iterdir()) == []
    assert stac.latest(str(tmp_path), "reef") == 0


def test_many_at_once_leave_none_out(tmp_path):
    names = [f"reef-{k}" for k in range(8)]
    for name in names:
        make_version(tmp_path, name, 1, crs=None)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda name: stac.update_mission(str(tmp_path), ENTRY._replace(id=name), ""), names))
    catalog, _ = validate(tmp_path)
    assert [child.id for child in catalog.get_children()] == names


@pytest.mark.parametrize("number", [1, 2])
def test_the_items_of_the_versions_stay_as_they_are(tmp_path, number):
    item = make_version(tmp_path, "reef", number) / "metadata/stac-item.json"
    before = item.read_bytes()
    stac.update_mission(str(tmp_path), ENTRY, "")
    assert item.read_bytes() == before
    assert datetime.fromisoformat(json.loads(before)["properties"]["created"]) < datetime.now(UTC)


def test_a_catalogue_of_many_is_not_gone_through_for_each(tmp_path, monkeypatch):
    names = [f"reef-{k}" for k in range(5)]
    for name in names:
        make_version(tmp_path, name, 1, crs=None)
    asked, exists = [], json_files.exists
    monkeypatch.setattr(json_files, "exists", lambda url: asked.append(url) or exists(url))
    for name in names:
        stac.update_mission(str(tmp_path), ENTRY._replace(id=name), "All")
    asked.clear()
    stac.update_mission(str(tmp_path), ENTRY._replace(id=names[0]), "All")
    assert asked == []
    shutil.rmtree(tmp_path / names[1])
    (tmp_path / names[2] / "collection.json").unlink()
    stac.update_catalog(str(tmp_path), "All")
    catalog, _ = validate(tmp_path)
    assert [child.id for child in catalog.get_children()] == [names[0], *names[3:]]
    stac.update_catalog(str(tmp_path), "Others")
    assert validate(tmp_path)[0].title == "Others"
