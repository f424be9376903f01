"""From YAML text to a model, or to a list of everything that is wrong with it."""

import difflib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any, Generic, NamedTuple, TypeVar

from pydantic import BaseModel, ValidationError

from .expectation import Expectation, Expectations, one_of
from .parameters import Parameters
from .problems import InvalidInput, Problem
from .yaml_document import Document, Path, dotted, parse

M = TypeVar("M", bound=BaseModel)

# Dropping a wrong value can make another one wrong, hardly a third.
_ATTEMPTS = 3


class Read(NamedTuple, Generic[M]):
    """A file read into a model.

    Attributes
    ----------
    model : the model; where there are problems, what could be made of the rest of the file (so that other
        files can be checked against it), or None.
    document : the YAML, for the lines of its keys; None where it is no YAML.
    problems : everything that is wrong.
    """

    model: M | None
    document: Document | None
    problems: list[Problem]


def load_model(content: str | bytes, file: str, model: type[M]) -> M:
    """Read a YAML file into a model.

    Parameters
    ----------
    content : the file's text, or its bytes (UTF-8).
    file : its name as the user would write it, for the messages.
    model : the pydantic model of the whole file.

    Raises
    ------
    InvalidInput
        With all problems: file, line, key, what was found, what was expected, what to do.
    """
    read = read_model(content, file, model)
    if read.problems or read.model is None:
        raise InvalidInput(read.problems)
    return read.model


def read_model(content: str | bytes, file: str, model: type[M]) -> Read[M]:
    """As `load_model`, but hands the problems back together with what could be read."""
    try:
        document = parse(content, file)
    except InvalidInput as error:
        return Read(None, None, list(error.problems))
    if not isinstance(document.value, dict):
        expected = expectations(model).at((), {}).text
        found = "an empty file" if document.value is None else shown(document.value)
        remedy = "Write `key: value` lines; docs/formats.md has all keys, README an example to start from."
        return Read(None, document, [*document.problems, Problem(file, 1, "", found, expected, remedy)])
    values, problems = validate(document.value, model, _Place(document))
    return Read(values, document, sorted([*document.problems, *problems], key=lambda p: p.line or 0))


def load_parameters(content: str | bytes | None, file: str, overrides: Sequence[str] = ()) -> Parameters:
    """Parameters from a file (or None) and from `--set key=value` on the command line, which win.

    Raises
    ------
    InvalidInput
        With all problems of both.
    """
    document = Document(file, {}, None, []) if content is None else parse(content, file)
    problems, values = list(document.problems), document.value
    if values is not None and not isinstance(values, dict):
        expected = expectations(Parameters).at((), {}).text
        problems.append(Problem(file, 1, "", shown(values), expected, "Write `key: value` lines."))
    merged: dict[str, Any] = dict(values) if isinstance(values, dict) else {}
    given: dict[Path, str] = {}
    for override in overrides:
        problems += _override(merged, given, override)
    parameters, more = validate(merged, Parameters, _Place(document, given))
    if problems or more or parameters is None:
        raise InvalidInput([*problems, *more])
    return parameters


def _override(values: dict[str, Any], given: dict[Path, str], override: str) -> list[Problem]:
    """Put one `key=value` into the values; remember that it came from the command line."""
    key, equals, text = override.partition("=")
    path = tuple(part.strip() for part in key.split("."))
    if not equals or not all(path):
        remedy = "Write it as --set grid.cell_m=0.05, without spaces around the equals sign."
        return [Problem("--set", None, "", repr(override), "key=value", remedy)]
    try:
        document = parse(text, f"--set {override}")
    except InvalidInput as error:
        return [problem._replace(line=None, key=key) for problem in error.problems]
    level = values
    for part in path[:-1]:
        below = level.get(part)
        level[part] = dict(below) if isinstance(below, dict) else {}
        level = level[part]
    level[path[-1]] = document.value
    given[path] = f"--set {override}"
    return [problem._replace(line=None, key=key) for problem in document.problems]


class _Place:
    """Where a key was given: in a file, or on the command line."""

    def __init__(self, document: Document, given: Mapping[Path, str] | None = None):
        self._document, self._given = document, dict(given or {})

    def of(self, path: Path) -> tuple[str, int | None]:
        for i in range(len(path), 0, -1):
            if path[:i] in self._given:
                return self._given[path[:i]], None
        for other, override in self._given.items():
            if path and other[: len(path)] == path:
                return override, None
        return self._document.file, None if self._document.root is None else self._document.line(path)


def validate(values: dict[str, Any], model: type[M], place: _Place) -> tuple[M | None, list[Problem]]:
    """A model from plain values; with problems, a model from the values that are not at fault, or None."""
    problems: list[Problem] = []
    for attempt in range(_ATTEMPTS):
        try:
            # Strict: "0.4" is no number and 1 no text, as in the published JSON Schema.
            return model.model_validate(values, strict=True), problems
        except ValidationError as error:
            found = _Findings(values, model, place).problems(error)
        if attempt == 0:
            problems = list(found.values())
        values = _copy(values)
        if not all([_drop(values, path) for path in found]):
            break
    return None, problems


def _holds(value: Any, step: str | int) -> bool:
    if isinstance(value, tuple):
        return isinstance(step, int) and step < len(value)
    return isinstance(value, dict) and step in value


def _at(value: Any, path: Path) -> Any:
    for step in path:
        value = value[step]
    return value


def _copy(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copy(item) for key, item in value.items()}
    return tuple(map(_copy, value)) if isinstance(value, tuple) else value


def _drop(values: Any, path: Path) -> bool:
    """Take the value at a path out; False if there is none, or if it is an item of a list."""
    if not path:
        return False
    values = _at(values, path[:-1])
    if not isinstance(values, dict) or path[-1] not in values:
        return False
    del values[path[-1]]
    return True


class _Findings:
    """Pydantic's errors said in our words."""

    def __init__(self, values: dict[str, Any], model: type[BaseModel], place: _Place):
        self._values, self._place, self._expectations = values, place, expectations(model)

    def problems(self, error: ValidationError) -> dict[Path, Problem]:
        """One problem a path: the members of a union complain each, but the user made one mistake."""
        problems: dict[Path, Problem] = {}
        for detail in error.errors(include_url=False):
            path = self._path(detail["loc"], detail["type"])
            path, found, expected, remedy = self._words(path, detail)
            file, line = self._place.of(path)
            problems.setdefault(path, Problem(file, line, dotted(path), found, expected, remedy))
        # A list whose items are wrong is called too short as well.
        return {path: problem for path, problem in problems.items() if not _has_below(path, problems)}

    def _path(self, location: tuple[int | str, ...], kind: str) -> Path:
        """Pydantic's location without the names that it puts in for the members of unions."""
        path: Path = ()
        value: Any = self._values
        for i, step in enumerate(location):
            last = i == len(location) - 1
            if _holds(value, step):
                value = value[step]
            elif not (last and kind == "missing" and isinstance(step, str)):
                continue  # also a missing item of a list: the list is too short
            path = (*path, step)
        return path

    def _words(self, path: Path, detail: Any) -> tuple[Path, str, str, str]:
        kind, context = detail["type"], detail.get("ctx", {})
        if kind == "inconsistent":
            path = (*path, *filter(None, context["key"].split(".")))
            return path, context["found"], context["expected"], context["remedy"]
        if kind == "extra_forbidden":
            return path, *self._unknown_key(path)
        if kind in ("union_tag_invalid", "union_tag_not_found") and isinstance(detail["input"], Mapping):
            return self._discriminator((*path, _tag_key(context)), detail["input"])
        expected = self._expectations.at(path, self._values)
        if kind == "missing" and path[-1] == detail["loc"][-1]:
            return path, "nothing", expected.text, f"Add the key {path[-1]}."
        if kind == "value_error":
            said = detail["msg"].removeprefix("Value error, ")
            return path, shown(detail["input"]), said, "Correct the value."
        value = _at(self._values, path)
        return path, shown(value), expected.text, _remedy(value, expected)

    def _discriminator(self, path: Path, value: Mapping[str, object]) -> tuple[Path, str, str, str]:
        key = str(path[-1])
        expected = self._expectations.at(path, self._values).text
        if key not in value:
            return path, "nothing", expected, f"Add the key {key}."
        return path, shown(value[key]), expected, "Choose one of these."

    def _unknown_key(self, path: Path) -> tuple[str, str, str]:
        key = str(path[-1])
        allowed = self._expectations.at(path[:-1], self._values).keys
        expected = f"only {one_of(allowed)} here"
        close = difflib.get_close_matches(key, allowed, n=1)
        here = tuple(step for step in path if isinstance(step, str))
        elsewhere = [dotted(other) for other in self._expectations.paths() if other[-1] == key and other != here]
        if elsewhere:
            return "an unknown key", expected, f"Did you mean {one_of(elsewhere)}?"
        if close:
            return "an unknown key", expected, f"Did you mean {close[0]}?"
        return "an unknown key", expected, "Remove it, or correct its spelling."


def _has_below(path: Path, paths: Iterable[Path]) -> bool:
    return any(len(other) > len(path) and other[: len(path)] == path for other in paths)


@cache
def expectations(model: type[BaseModel]) -> Expectations:
    """What a model expects; worked out once."""
    return Expectations(model)


def _tag_key(context: Mapping[str, str]) -> str:
    """The discriminating key as the file has it: pydantic gives "'from_' | 'from'"."""
    return context["discriminator"].split("|")[-1].strip(" '")


def _remedy(value: object, expected: Expectation) -> str:
    if isinstance(value, int | float) and expected.kinds <= {"string", "null"}:
        return "Put it in quotes."
    if isinstance(value, str) and not expected.kinds & {"string", "array", "object"}:
        return "Write a plain number, without unit or quotes."
    if value is None:
        return "Write a value, or remove the key."
    return "Correct the value."


def shown(value: object) -> str:
    """A value as it is shown in messages: short, on one line."""
    if value is None:
        return "no value"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return f"a mapping with {', '.join(map(str, list(value)[:8]))}" if value else "an empty mapping"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    if isinstance(value, str):
        return repr(value if len(value) <= 60 else value[:57] + "...")
    return str(value) if len(str(value)) < 40 else f"{str(value)[:37]}..."
