"""What every process that works on a mission has to have in common: the code, the mission and the store."""

import hashlib
import platform
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final, NamedTuple

from ..catalog.filesystems import ObjectStoreError
from ..catalog.mission_files import MissionFiles
from ..catalog.mission_inputs import MISSION
from ..catalog.store import Store
from ..schemas.problems import InvalidInput

# what stored steps compute with; Open3D comes as one of two
COMPUTING: Final = (
    *("numpy", "scipy", "opencv-python-headless", "gtsam", "pyproj", "shapely", "contourpy"),
    *("open3d-cpu", "open3d"),
)


class Footing(NamedTuple):
    """As the client has it.

    Attributes
    ----------
    software : name and version of what computes; of our own code its digest.
    mission_sha256 : of mission.yaml.
    mark : of this run in the store.
    """

    software: tuple[tuple[str, str], ...]
    mission_sha256: str
    mark: str


class OtherFooting(RuntimeError):
    """A worker runs other code, or does not see the mission or the store."""


def installed(*names: str) -> list[tuple[str, str]]:
    """Name and version of those distributions that are installed."""
    found = []
    for name in names:
        with suppress(PackageNotFoundError):
            found.append((name, version(name)))
    return found


@cache
def software() -> tuple[tuple[str, str], ...]:
    """Digest of our code, and versions of Python and of the libraries that compute."""
    root, sha = Path(__file__).parents[1], hashlib.sha256()
    for layer in ("schemas", "tasks", "catalog", "workflows"):
        for path in sorted((root / layer).glob("*.py")):
            sha.update(f"{layer}/{path.name}".encode() + path.read_bytes())
    python = ".".join(platform.python_version_tuple()[:2])
    libraries = installed(*COMPUTING, "dask", "distributed")
    return ("seamosaic", sha.hexdigest()[:12]), ("python", python), *libraries


software()  # of the files as they were when this process loaded them


def why_not(mission_url: str, store: Store, footing: Footing) -> str:
    """Why this process cannot work on a mission; empty if it can."""
    ours = dict(software())
    other = [
        f"{name} is {ours.get(name)} here, {value} there" for name, value in footing.software if ours.get(name) != value
    ]
    if other:
        return f"other software than where the run was started ({'; '.join(other)})"
    try:
        seen = MissionFiles(mission_url)
        seen.read(MISSION, None, [])
    except ObjectStoreError:  # which does not answer now; the task that comes will say so if it lasts
        raise
    except (InvalidInput, OSError) as error:
        return f"it does not see the mission ({error})"
    if seen.digests.get(MISSION) != footing.mission_sha256:
        return f"it sees another mission.yaml, or none, in {mission_url}"
    return "" if store.is_marked(footing.mark) else f"it does not see the store of results {store.url}"


@cache
def stand(mission_url: str, store: Store, footing: Footing) -> None:
    """Refuse to compute where the footing is another one; looked at once in each process."""
    reason = why_not(mission_url, store, footing)
    if reason:
        raise OtherFooting(f"worker refused: {reason}")
