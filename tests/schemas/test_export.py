import json
from typing import Any

import pytest
import yaml
from seamosaic.schemas.calibration import Calibration
from seamosaic.schemas.cluster import Cluster
from seamosaic.schemas.export import FOLDER, MODELS, export, schema_text
from seamosaic.schemas.mission import Mission
from seamosaic.schemas.parameters import Parameters
from seamosaic.schemas.problems import InvalidInput
from seamosaic.schemas.yaml_input import load_model

# The examples of FORMATS, with numbers where it has letters.
MISSION = """\
format: 1
id: vortex-2026-06-03-a            # [a-z0-9][a-z0-9._-]*
title: Posidonia meadow, line set A
platform: Vortex
images:                            # one entry or more
  - {path: 'images/V_*.jpg', role: texture}
  - {path: 'images/L_*.jpg', role: laser}
timestamps: {from: filename, pattern: '%Y%m%dT%H%M%S.%fZ'}
calibration: calibration.yaml
navigation:
  path: navigation.csv
  time_offset: 0.0
  sigma: {horizontal: 0.4, depth: 0.03, roll: 0.27, pitch: 0.27, heading: 0.84}
crs: EPSG:32631
vertical_datum: EPSG:5714
tide: tide.csv
reporting: {organisation: Ifremer, licence: CC-BY-4.0}
"""

CALIBRATION = """\
format: 1
camera:
  model: flat-port
  width: 3648
  height: 2736
  fx: 4751.7
  fy: 4754.1
  cx: 1827.7
  cy: 1362.8
  distortion: [-0.05, 0.02, 4e-4, -0.0003, 0]
  port: {distance: 0.035, thickness: 0.012, glass_index: 1.49, water_index: 1.34}
laser:
  wavelength_nm: 532
  origin: [1.2, 0.0, 0.0]
  planes:
    - {name: a, normal: [-0.64254881, 0.70616535, -0.29742481], offset: -0.75366185}
    - {name: b, normal: [0.63759618, 0.70802607, 0.30359544], offset: 0.76450386}
mount: {translation: [0.35, 0.12, 0.25], rotation: [0.4, -0.6, 0.5]}
"""

CLUSTER = """\
kind: pbs
adapt: {min: 1, max: 40}
cores: 8
memory: 32 GiB
walltime: '02:30:00'
setup: [module load python]
"""

EXAMPLES: list[tuple[str, type, str]] = [
    ("mission", Mission, MISSION),
    ("mission", Mission, MISSION.replace("filename, pattern: '%Y%m%dT%H%M%S.%fZ'", "exif")),
    ("mission", Mission, MISSION.replace("filename, pattern: '%Y%m%dT%H%M%S.%fZ'", "csv, path: times.csv")),
    ("calibration", Calibration, CALIBRATION),
    (
        "calibration",
        Calibration,
        CALIBRATION[: CALIBRATION.index("  planes")] + "  planes: {baseline: 1.2, angle: 25, roll: 45}\n",
    ),
    ("cluster", Cluster, CLUSTER),
    ("parameters", Parameters, "grid: {cell_m: 0.05}\nmosaic: {cell_m: auto}\n"),
]


def validator(name: str) -> Any:
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(schema_text(name))
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("name", MODELS)
def test_the_committed_schemas_are_current(name: str) -> None:
    path = FOLDER / f"{name}.schema.json"
    assert path.read_text(encoding="utf-8") == schema_text(name), "run: python -m seamosaic.schemas.export"


def test_export_writes_them_all(tmp_path) -> None:
    assert {path.name for path in export(tmp_path / "json")} == {f"{name}.schema.json" for name in MODELS}
    assert {path.name for path in (tmp_path / "json").iterdir()} == {path.name for path in FOLDER.iterdir()}


@pytest.mark.parametrize(("name", "model", "text"), EXAMPLES)
def test_the_schema_accepts_what_we_accept(name: str, model: type, text: str) -> None:
    load_model(text, "f.yaml", model)
    assert list(validator(name).iter_errors(yaml.safe_load(text.replace("4e-4", "0.0004")))) == []


def _levels(value: Any) -> list[dict]:
    below = value.values() if isinstance(value, dict) else value if isinstance(value, list) else []
    return [*([value] if isinstance(value, dict) else []), *(level for item in below for level in _levels(item))]


@pytest.mark.parametrize(("name", "model", "text"), EXAMPLES)
def test_an_unknown_key_is_refused_at_every_level(name: str, model: type, text: str) -> None:
    document = yaml.safe_load(text.replace("4e-4", "0.0004"))
    check = validator(name)
    for level in _levels(document):
        level["surprise"] = 1
        assert not check.is_valid(document)
        with pytest.raises(InvalidInput, match=r"surprise: found an unknown key"):
            load_model(yaml.safe_dump(document), "f.yaml", model)
        del level["surprise"]
    assert check.is_valid(document)


@pytest.mark.parametrize(
    ("name", "model", "text", "wrong"),
    [
        ("calibration", Calibration, CALIBRATION, ("fx: 4751.7", "fx: -1")),
        ("calibration", Calibration, CALIBRATION, ("fx: 4751.7", "fx: '4751.7'")),
        ("calibration", Calibration, CALIBRATION, ("width: 3648", "width: 3648.5")),
        ("calibration", Calibration, CALIBRATION, ("[1.2, 0.0, 0.0]", "[1.2, 0.0]")),
        ("mission", Mission, MISSION, ("id: vortex", "id: Vortex")),
        ("mission", Mission, MISSION, ("id: vortex-2026-06-03-a", "id: 2026")),
        ("mission", Mission, MISSION, ("role: laser", "role: lazer")),
        ("mission", Mission, MISSION, ("format: 1", "format: 2")),
        ("mission", Mission, MISSION, ("crs: EPSG:32631", "crs: 32631")),
    ],
)
def test_both_refuse_the_same(name: str, model: type, text: str, wrong: tuple[str, str]) -> None:
    spoilt = text.replace(*wrong)
    assert spoilt != text
    assert not validator(name).is_valid(yaml.safe_load(spoilt.replace("4e-4", "0.0004")))
    with pytest.raises(InvalidInput):
        load_model(spoilt, "f.yaml", model)
