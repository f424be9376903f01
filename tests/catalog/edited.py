"""A mission that is spoilt, and what is said of it."""

import shutil
from pathlib import Path

import pytest
from seamosaic.catalog.missions import OpenedMission, open_mission
from seamosaic.schemas.problems import InvalidInput, Problem


def edit(path: Path, *changes: tuple[str, str]) -> None:
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)


def images(mission: Path) -> list[Path]:
    return sorted((mission / "images").iterdir())


def truncate(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def copy(path: Path) -> None:
    shutil.copy(path, path.with_name(path.stem + "_copy.jpg"))


def problems(mission: Path | str, **options) -> list[Problem]:
    with pytest.raises(InvalidInput) as caught:
        open_mission(str(mission), **options)
    assert all(p.file and p.found and p.expected and p.remedy for p in caught.value.problems)
    return list(caught.value.problems)


def problem(mission: Path | str) -> Problem:
    (found,) = problems(mission)
    return found


def status(opened: OpenedMission) -> dict[str, str]:
    return {
        Path(str(name)).name: str(text)
        for name, text in zip(opened.frames["image"].values, opened.frames["status"].values, strict=True)
        if text
    }


def without_navigation(mission: Path) -> None:
    path = mission / "mission.yaml"
    path.write_text(path.read_text().split("navigation:")[0])
