"""What a model expects at a key, in words, read from its JSON Schema."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from pydantic import BaseModel

Node = dict[str, Any]

_WORDS = {"number": "a number", "integer": "a whole number", "string": "a text", "boolean": "true or false"}
_BOUNDS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}


class Expectation(NamedTuple):
    """What is expected at one place.

    Attributes
    ----------
    text : in words, with bounds and unit.
    keys : the keys that a mapping may have there; empty if none is expected.
    kinds : JSON types that may stand there.
    """

    text: str
    keys: tuple[str, ...]
    kinds: frozenset[str]


class Expectations:
    """Answers for one model.

    Parameters
    ----------
    model : the pydantic model that a whole file is read into.
    """

    def __init__(self, model: type[BaseModel]):
        self._root: Node = model.model_json_schema()
        self._definitions: Node = self._root.get("$defs", {})

    def at(self, path: Sequence[str | int], value: object) -> Expectation:
        """What is expected at a path of a file whose value (of the whole file) is given.

        Where the model allows alternatives, those that cannot be meant, seen from the value, are left out.
        """
        places: list[Node] = [self._root]
        for step in path:
            branches = [branch for place in places for branch in self._branches(place)]
            places = [child for branch in _meant(branches, value) for child in _children(branch, step)]
            value = _step(value, step)
        branches = [branch for place in places for branch in self._branches(place)]
        meant = _meant(branches, value)
        keys = tuple(dict.fromkeys(key for branch in meant for key in branch.get("properties", ())))
        kinds = frozenset(_kind(branch) for branch in branches)
        return Expectation(self._words(places, branches), keys, kinds)

    def paths(self) -> Iterator[tuple[str, ...]]:
        """Every key of every mapping, as a path; list items are passed over."""
        yield from self._paths(self._root, ())

    def _paths(self, place: Node, above: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        for branch in self._branches(place):
            for key, child in branch.get("properties", {}).items():
                yield (*above, key)
                yield from self._paths(child, (*above, key))

    def _branches(self, place: Node) -> list[Node]:
        """The alternatives of a place, references followed."""
        if "$ref" in place:
            return self._branches(self._definitions[place["$ref"].rsplit("/", 1)[1]])
        alternatives = place.get("anyOf") or place.get("oneOf")
        if alternatives is None:
            return [place]
        return [branch for alternative in alternatives for branch in self._branches(alternative)]

    def _words(self, places: list[Node], branches: list[Node]) -> str:
        said = [_describe(branch) for branch in branches if _kind(branch) != "null" or len(branches) == 1]
        text = " or ".join(dict.fromkeys(said))
        notes = [place["description"] for place in places if "description" in place and _kind(place) != "object"]
        return f"{text} ({notes[0]})" if notes else text


def _kind(branch: Node) -> str:
    if "const" in branch or "enum" in branch:
        value = branch.get("const", branch.get("enum", [None])[0])
        return "string" if isinstance(value, str) else "integer"
    return str(branch.get("type", "any"))


def _kind_of(value: object) -> str:
    if isinstance(value, Mapping):
        return "object"
    if isinstance(value, str):
        return "string"
    return "array" if isinstance(value, Sequence) else "scalar"


def _meant(branches: list[Node], value: object) -> list[Node]:
    """The branches that a value can be meant as: of its kind, and whose constants it does not contradict."""
    kept = [branch for branch in branches if _kind(branch) == _kind_of(value)]
    if isinstance(value, Mapping):
        agreeing = [branch for branch in kept if not _contradicts(branch, value)]
        kept = agreeing or kept
    return kept or branches


def _contradicts(branch: Node, value: Mapping[str, object]) -> bool:
    return any(
        "const" in child and key in value and value[key] != child["const"]
        for key, child in branch.get("properties", {}).items()
    )


def _children(branch: Node, step: str | int) -> list[Node]:
    if isinstance(step, str):
        child = branch.get("properties", {}).get(step)
        return [] if child is None else [child]
    prefix = branch.get("prefixItems", [])
    child = prefix[step] if step < len(prefix) else branch.get("items")
    return [child] if isinstance(child, dict) else []


def _step(value: object, step: str | int) -> object:
    if isinstance(value, Mapping):
        return value.get(step)
    if isinstance(value, tuple) and isinstance(step, int) and step < len(value):
        return value[step]
    return None


def _describe(branch: Node) -> str:
    kind = _kind(branch)
    if "const" in branch:
        return str(branch["const"])
    if "enum" in branch:
        return one_of(branch["enum"])
    if kind == "object":
        return f"a mapping with {', '.join(branch.get('properties', {}))}"
    if kind == "array":
        return _describe_list(branch)
    if "pattern" in branch:
        return f"a text of the form {branch['pattern']}"
    bounds = [f"{sign} {_plain(branch[name])}" for name, sign in _BOUNDS.items() if name in branch]
    return " ".join(filter(None, [_WORDS.get(kind, kind), " and ".join(bounds)]))


def _plain(number: float) -> str:
    return str(int(number)) if number == int(number) else str(number)


def _describe_list(branch: Node) -> str:
    least, most = branch.get("minItems", 0), branch.get("maxItems", math.inf)
    items = branch.get("prefixItems") or [branch.get("items", {})]
    what = {"number": "numbers", "string": "texts"}.get(items[0].get("type", ""), "items")
    if least == most:
        return f"a list of {least} {what}"
    return f"a list of {f'{least} or more ' if least else ''}{what}"


def one_of(words: Sequence[object]) -> str:
    """`a, b or c`."""
    texts = list(map(str, words))
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} or {texts[-1]}"
