"""What every task of a run needs to know, and how a step's result is found or made."""

import hashlib
import inspect
import logging
import sys
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..catalog.store import Entry, Store, digest
from ..schemas.base import Model
from ..schemas.calibration import Calibration
from ..schemas.parameters import Parameters
from .footing import COMPUTING, Footing, installed, stand

log = logging.getLogger("seamosaic")

_OURS = __package__.rpartition(".")[0] if __package__ else ""
_FOLLOWED = tuple(f"{_OURS}.{name}" for name in ("tasks", "catalog.image", "schemas.calibration"))


class Job(NamedTuple):
    """A mission being processed; small and picklable, it goes with every task.

    footing : what every process that computes must have in common with this one; None where there is no other.
    """

    mission_url: str
    mission_id: str
    store: Store
    calibration: Calibration
    parameters: Parameters
    footing: Footing | None = None


class Done(NamedTuple):
    """One step's result as it travels through the graph: where it is, not what it is.

    Attributes
    ----------
    step, key : of the store. computed : False if the store had it. seconds : of the computation, when it was made.
    info : the entry's small record.
    """

    step: str
    key: str
    computed: bool
    seconds: float
    info: dict[str, Any]


class Made(NamedTuple):
    """What a step computes: arrays and a small record."""

    arrays: Mapping[str, NDArray]
    info: Mapping[str, Any]


def code_version(*modules: ModuleType, pages: Iterable[Path] = ()) -> str:
    """Digest of the code behind a step: these modules, all of `tasks` and `catalog.images` that they use, the
    calibration's model, templates of pages, and the versions of the libraries that compute. A change makes the step's
    results stale."""
    seen: dict[str, ModuleType] = {}
    for module in modules:
        _follow(module, seen)
    text = "".join(inspect.getsource(seen[name]) for name in sorted(seen))
    text += "".join(page.read_text("utf-8") for page in pages)
    libraries = ",".join(f"{name}={number}" for name, number in installed(*COMPUTING))
    return hashlib.sha256((text + libraries).encode()).hexdigest()[:16]


def _follow(module: ModuleType, seen: dict[str, ModuleType]) -> None:
    """Add a module and those of ours that compute and that it takes names from."""
    if module.__name__ in seen:
        return
    seen[module.__name__] = module
    for value in vars(module).values():
        name = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None)
        if isinstance(name, str) and name.startswith(_FOLLOWED) and name in sys.modules:
            _follow(sys.modules[name], seen)


def stage(*models: Model) -> list[Any]:
    """What a step reads of the parameters or the calibration, as it enters the digest."""
    return [model.model_dump(mode="json") for model in models]


def array_digest(*arrays: NDArray) -> str:
    """SHA-256 of the bytes, shapes and types of arrays."""
    sha = hashlib.sha256()
    for array in arrays:
        sha.update(f"{array.dtype.str}{array.shape}".encode())
        sha.update(np.ascontiguousarray(array).tobytes())
    return sha.hexdigest()


def rounded_digest(*arrays: NDArray) -> str:
    """The same to nine digits after the point: the last bits of what was computed are the processor's."""
    return array_digest(*(np.round(array, 9) + 0.0 for array in arrays))  # no -0


def once(
    job: Job,
    step: str,
    code: str,
    inputs: Sequence[str],
    parameters: Any,
    make: Callable[[], Made],
    compress: bool | Collection[str] = False,
) -> Done:
    """The stored result of a step, made now if the store does not have it."""
    if job.footing is not None:
        stand(job.mission_url, job.store, job.footing)
    key = digest(step, code, inputs, parameters)
    known = job.store.info(step, key)
    if known is not None:
        job.store.touch(step, key)
        return Done(step, key, False, float(known["seconds"]), known)
    started = time.process_time()
    made = make()
    seconds = time.process_time() - started
    info = {**made.info, "seconds": round(seconds, 4)}
    job.store.put(step, key, made.arrays, info, compress)
    log.debug("mission=%s step=%s key=%s seconds=%.3f", job.mission_id, step, key[:12], seconds)
    return Done(step, key, True, seconds, info)


def load(job: Job, step: str, key: str, names: Collection[str] | None = None) -> Entry:
    """A result that an earlier step stored, or those of its arrays that are named.

    Raises
    ------
    LostEntry
        If it is gone or damaged; then it is forgotten, so that going over the steps again makes it anew.
    """
    return read(job.store, step, key, names)


def read(store: Store, step: str, key: str, names: Collection[str] | None = None) -> Entry:
    """`load` for what is remembered by store and key."""
    entry = store.get(step, key, names)
    if entry is None:
        store.remove(step, key)
        raise LostEntry(f"{store.path(step, key)} is gone or damaged and has to be made anew")
    return entry


class LostEntry(RuntimeError):
    """A stored result vanished during the run."""
