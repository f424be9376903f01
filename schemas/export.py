"""Writes the published JSON Schemas: `python -m seamosaic.schemas.export`."""

import json
from pathlib import Path

from .archive import Archive
from .base import Model
from .calibration import Calibration
from .cluster import Cluster
from .mission import Mission
from .parameters import Parameters
from .products import Quality
from .provenance import Provenance

FOLDER = Path(__file__).parent / "json"

MODELS: dict[str, type[Model]] = {
    "archive": Archive,
    "mission": Mission,
    "calibration": Calibration,
    "parameters": Parameters,
    "cluster": Cluster,
    "quality": Quality,
    "provenance": Provenance,
}


def schema_text(name: str) -> str:
    """The JSON Schema (2020-12) of a model, as it is committed."""
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:seamosaic:schema:{name}:1",
        **MODELS[name].model_json_schema(by_alias=True),
    }
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def export(folder: Path = FOLDER) -> list[Path]:
    """Write every schema as `<name>.schema.json`; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.schema.json" for name in MODELS]
    for name, path in zip(MODELS, paths, strict=True):
        path.write_text(schema_text(name), encoding="utf-8")
    return paths


if __name__ == "__main__":
    for written in export():
        print(written)
