"""The house's layers (DESIGN, "The house"): who may import whom, and what tasks may not touch."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = {
    "schemas": {"schemas"},
    "tasks": {"tasks", "schemas"},
    "catalog": {"catalog", "schemas"},
    "workflows": {"workflows", "tasks", "catalog", "schemas"},
}
# Tasks take arrays and give arrays.
FORBIDDEN_IN_TASKS = {
    "dask",
    "distributed",
    "fsspec",
    "pathlib",
    "os",
    "io",
    "shutil",
    "tempfile",
    "xarray",
    "rasterio",
}
FILES = [path for layer in LAYERS for path in sorted((ROOT / layer).rglob("*.py"))]


def imported(path: Path, source: str) -> Iterator[tuple[int, str]]:
    """Line and absolute name of every import of a file; ours start with `seamosaic.`."""
    package = ["seamosaic", *path.relative_to(ROOT).parent.parts]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *filter(None, [node.module])])
            yield node.lineno, base
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)


def violations(path: Path, source: str) -> list[str]:
    layer = path.relative_to(ROOT).parts[0]
    found = []
    for line, name in imported(path, source):
        top, *rest = name.split(".")
        ours = top == "seamosaic"
        if ours and rest and rest[0] not in LAYERS[layer]:
            found.append(f"{path.name}:{line}: {layer} imports {name}")
        if top in LAYERS:
            found.append(f"{path.name}:{line}: {name} is imported by its bare name, not relatively")
        if layer == "tasks" and top in FORBIDDEN_IN_TASKS:
            found.append(f"{path.name}:{line}: tasks import {name}")
    return found + (_opened(path, source) if layer == "tasks" else [])


def _opened(path: Path, source: str) -> list[str]:
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    return [
        f"{path.name}:{call.lineno}: tasks open a file"
        for call in calls
        if isinstance(call.func, ast.Name) and call.func.id == "open"
    ]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_layers(path: Path) -> None:
    assert violations(path, path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("layer", "source"),
    [
        ("schemas", "from ..tasks.camera import rays"),
        ("schemas", "from .. import tasks"),
        ("tasks", "from ..catalog import rasters"),
        ("tasks", "def f():\n    import fsspec"),
        ("tasks", "import os.path"),
        ("tasks", "from pathlib import Path"),
        ("tasks", "open('x')"),
        ("catalog", "from seamosaic.tasks import camera"),
        ("catalog", "from ..workflows.cli import main"),
        ("workflows", "import tasks.camera"),
    ],
)
def test_a_violation_is_found(layer: str, source: str) -> None:
    assert violations(ROOT / layer / "example.py", source)


def test_what_is_allowed_is_not_found() -> None:
    source = "import numpy\nfrom ..schemas.calibration import Camera\nfrom . import camera\nfrom .camera import rays"
    assert violations(ROOT / "tasks" / "example.py", source) == []
