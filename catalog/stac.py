"""The archive as a static STAC catalogue: a collection for each mission, an item for each version of its products.

PRODUCTS/catalog.json, PRODUCTS/<mission id>/collection.json and PRODUCTS/<mission id>/items/v1.json, ...: made anew
from the versions that are there, file by file, each whole or not at all, and nothing is linked before it exists.
"""

from collections.abc import Collection
from datetime import datetime
from pathlib import PurePosixPath
from typing import Final, NamedTuple

import pystac

from . import json_files, versions
from .versions import Version

CATALOG: Final = "catalog.json"
_COLLECTION, _ITEMS, _OWN_ITEM = "collection.json", "items", "metadata/stac-item.json"
_VERSION_EXTENSION: Final = "https://stac-extensions.github.io/version/v1.2.0/schema.json"
_WORLD: Final = (-180.0, -90.0, 180.0, 90.0)  # what STAC asks for where there is no position


class MissionEntry(NamedTuple):
    """What a collection says of its mission. start, end : first and last exposure, ISO 8601, UTC."""

    id: str
    title: str
    platform: str
    start: str
    end: str


def update_mission(products: str, entry: MissionEntry, title: str) -> None:
    """Bring a mission's collection, its items and the catalogue up to date with the versions that are there.

    Parameters
    ----------
    title : of the archive.
    """
    found = versions.list_versions(products, entry.id)
    read = [_item(entry.id, version, newest=version is found[-1]) for version in found]
    made = {version.number: item for version, item in zip(found, read, strict=True) if item is not None}
    if not made:
        return
    folder = f"{products.rstrip('/')}/{entry.id}"
    for number, item in made.items():
        json_files.write_json(f"{folder}/{_ITEMS}/v{number}.json", item.to_dict(include_self_link=False))
    collection = _collection(entry, list(made.values()))
    for number in made:
        collection.add_link(_link(pystac.RelType.ITEM, f"./{_ITEMS}/v{number}.json", pystac.MediaType.GEOJSON))
    json_files.write_json(f"{folder}/{_COLLECTION}", collection.to_dict(include_self_link=False))
    kept = {f"v{number}.json" for number in made}
    for name in json_files.names(f"{folder}/{_ITEMS}"):
        if name not in kept:
            json_files.remove(f"{folder}/{_ITEMS}/{name}")
    update_catalog(products, title, whole=False)


def latest(products: str, mission_id: str) -> int:
    """Number of the newest version that a mission's collection names; 0 for none."""
    found = json_files.read_json(f"{products.rstrip('/')}/{mission_id}/{_COLLECTION}") or {}
    named = [PurePosixPath(link["href"]).stem for link in found.get("links", []) if link.get("rel") == "item"]
    return max((int(name[1:]) for name in named), default=0)


def update_catalog(products: str, title: str, *, whole: bool = True) -> None:
    """Bring catalog.json up to date with the collections that are there.

    Two at once are both right in the end: each looks again after it has written.

    Parameters
    ----------
    whole : also look whether what is linked is still there, which takes a request for each mission.
    """
    written = _linked(products, title)
    while (there := _collections(products, () if whole else written or ())) != written:
        catalog = pystac.Catalog(
            id="seamosaic-archive", title=title or None, description=title or "Maps of the seabed by seamosaic"
        )
        for name in there:
            catalog.add_link(_link(pystac.RelType.CHILD, f"./{name}/{_COLLECTION}"))
        catalog.clear_links("root")
        catalog.add_link(_link("root", f"./{CATALOG}"))
        json_files.write_json(f"{products.rstrip('/')}/{CATALOG}", catalog.to_dict(include_self_link=False))
        written = there


def _linked(products: str, title: str) -> list[str] | None:
    """Missions that catalog.json links; None if it has another title."""
    found = json_files.read_json(f"{products.rstrip('/')}/{CATALOG}") or {}
    if found and found.get("title") != (title or None):
        return None
    links = found.get("links", [])
    return [PurePosixPath(link["href"]).parent.name for link in links if link.get("rel") == pystac.RelType.CHILD]


def _collections(products: str, known: Collection[str] = ()) -> list[str]:
    """Missions that have a collection. known : those for which this need not be looked at."""
    root = products.rstrip("/")
    missions = [name for name in json_files.names(root) if name != CATALOG]
    return [name for name in missions if name in known or json_files.exists(f"{root}/{name}/{_COLLECTION}")]


def _link(relation: str, target: str, media_type: str = pystac.MediaType.JSON) -> pystac.Link:
    return pystac.Link(relation, target, media_type)


def _item(mission_id: str, version: Version, newest: bool) -> pystac.Item | None:
    """The item that the run wrote, with its place in the catalogue; None if it is gone."""
    value = json_files.read_json(f"{version.path}/{_OWN_ITEM}")
    if not isinstance(value, dict):
        return None
    item = pystac.Item.from_dict(value)
    item.id = f"{mission_id}-v{version.number}"  # the run that wrote it could only guess its number
    for asset in item.assets.values():
        asset.href = f"../v{version.number}/{asset.href.removeprefix('../')}"
    item.properties |= {"version": str(version.number), "deprecated": not newest}
    item.stac_extensions = [*item.stac_extensions, _VERSION_EXTENSION]
    item.clear_links()
    item.collection_id = mission_id
    item.add_link(_link("root", f"../../{CATALOG}"))
    for relation in ("parent", "collection"):
        item.add_link(_link(relation, f"../{_COLLECTION}"))
    return item


def _collection(entry: MissionEntry, items: list[pystac.Item]) -> pystac.Collection:
    boxes = [item.bbox for item in items if item.bbox] or [list(_WORLD)]
    west, south, east, north = zip(*boxes, strict=True)
    extent = pystac.Extent(
        pystac.SpatialExtent([[min(west), min(south), max(east), max(north)]]),
        pystac.TemporalExtent([list(_span(entry))]),
    )
    licences = {str(item.properties.get("license") or "other") for item in items[-1:]}
    collection = pystac.Collection(
        id=entry.id,
        title=entry.title or entry.id,
        description=f"Maps made from the survey {entry.title or entry.id}",
        extent=extent,
        license=licences.pop(),
        summaries=pystac.Summaries({"platform": [entry.platform]}) if entry.platform else None,
    )
    for relation in ("root", "parent"):
        collection.add_link(_link(relation, f"../{CATALOG}"))
    return collection


def _span(entry: MissionEntry) -> tuple[datetime, datetime]:
    start, end = (datetime.fromisoformat(text.replace("Z", "+00:00")) for text in (entry.start, entry.end))
    return start, end
