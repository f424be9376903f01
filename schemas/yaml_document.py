"""YAML text as plain values that still know their lines.

Scalars follow YAML 1.2's core schema, not PyYAML's 1.1: `no` is a text, `1e-3` a number, `2026-06-03` and
`12:30` are texts. Sequences become tuples, as the models have them.
"""

import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import yaml
from yaml.reader import ReaderError

from .problems import InvalidInput, Problem

Path = tuple[str | int, ...]

_TAG = "tag:yaml.org,2002:"
_NULL, _BOOL, _INT, _FLOAT, _STR = (_TAG + name for name in ("null", "bool", "int", "float", "str"))


class _Loader(yaml.SafeLoader):
    """PyYAML's parser with the scalar rules of YAML 1.2."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012 - PyYAML's own class attribute, emptied here


_Loader.add_implicit_resolver(_NULL, re.compile(r"(?:~|null|Null|NULL|)$"), None)
_Loader.add_implicit_resolver(_BOOL, re.compile(r"(?:true|True|TRUE|false|False|FALSE)$"), None)
_Loader.add_implicit_resolver(_INT, re.compile(r"[-+]?[0-9]+$"), None)
_Loader.add_implicit_resolver(
    _FLOAT,
    re.compile(
        r"(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
    ),
    None,
)

_CONSTRUCT: dict[str, Callable[[str], object]] = {
    _NULL: lambda _: None,
    _BOOL: lambda text: text.lower() == "true",
    _INT: int,
    _FLOAT: lambda text: float(re.sub(r"\.(inf|nan)$", r"\1", text.lower())),
    _STR: str,
}


class Document(NamedTuple):
    """A YAML file, read.

    Attributes
    ----------
    file : its name as the user would write it.
    value : mappings as dict, sequences as tuple, scalars as None, bool, int, float or str; None if empty.
    root : PyYAML's node tree, for `line`.
    problems : duplicate keys and unusable scalars; the value leaves them out.
    """

    file: str
    value: object
    root: yaml.Node | None
    problems: list[Problem]

    def line(self, path: Sequence[str | int]) -> int:
        """Line (from 1) of the key or list item at a path, or of the deepest part of the path that is there."""
        node, line = self.root, 1 if self.root is None else self.root.start_mark.line + 1
        for step in path:
            key, node = _child(node, step)
            if node is None or key is None:
                break
            line = key.start_mark.line + 1
        return line


def _child(node: yaml.Node | None, step: str | int) -> tuple[yaml.Node | None, yaml.Node | None]:
    """Key node and value node one step down; the item itself serves as key in a sequence."""
    if isinstance(node, yaml.MappingNode):
        return next(((key, value) for key, value in node.value if _key(key) == str(step)), (None, None))
    if isinstance(node, yaml.SequenceNode) and isinstance(step, int) and step < len(node.value):
        return node.value[step], node.value[step]
    return None, None


def _key(node: yaml.Node) -> str:
    return node.value if isinstance(node, yaml.ScalarNode) else "(a list or mapping as key)"


def dotted(path: Sequence[str | int]) -> str:
    """The path as it is written in messages: `images.0.role`."""
    return ".".join(map(str, path))


def decode(content: str | bytes, file: str) -> str:
    """The text of a file that has to be UTF-8 (a byte order mark is dropped).

    Raises
    ------
    InvalidInput
        With the line of the first byte that is not UTF-8.
    """
    if isinstance(content, str):
        return content.removeprefix("\ufeff")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        found = f"a byte that is not UTF-8 (0x{content[error.start]:02x})"
        remedy = "Save the file again with the encoding UTF-8."
        raise InvalidInput([Problem(file, line, "", found, "text in UTF-8", remedy)]) from None


def parse(content: str | bytes, file: str) -> Document:
    """Read one YAML document.

    Raises
    ------
    InvalidInput
        If it is not UTF-8 or not YAML at all. What is wrong with single keys is in `Document.problems`.
    """
    text = decode(content, file)
    try:
        root = _compose(text)
        builder = _Builder(file)
        value = None if root is None else builder.build(root, ())
    except yaml.YAMLError as error:
        raise InvalidInput([_syntax_problem(error, text, file)]) from None
    except RecursionError:
        remedy = "Write it flat: no file of a mission is nested more than five deep."
        raise InvalidInput([Problem(file, None, "", "hundreds of nested levels", "a YAML mapping", remedy)]) from None
    return Document(file, value, root, builder.problems)


def _compose(text: str) -> yaml.Node | None:
    loader = _Loader(text)
    try:
        return loader.get_single_node()
    finally:
        loader.dispose()


class _Builder:
    """Turns nodes into values; remembers what it had to leave out."""

    def __init__(self, file: str):
        self.file = file
        self.problems: list[Problem] = []
        self._open: set[int] = set()
        self._done: dict[int, object] = {}

    def build(self, node: yaml.Node, path: Path) -> object:
        """The value of a node. An anchor's value is built once, however often it is referred to."""
        if id(node) in self._open:
            self._add(node, path, "an alias to something that contains it", "a value", "Write the value out.")
            return None
        if id(node) not in self._done:
            self._open.add(id(node))
            self._done[id(node)] = self._value(node, path)
            self._open.discard(id(node))
        return self._done[id(node)]

    def _value(self, node: yaml.Node, path: Path) -> object:
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, path)
        if isinstance(node, yaml.SequenceNode):
            return tuple(self.build(item, (*path, i)) for i, item in enumerate(node.value))
        try:
            return _CONSTRUCT[node.tag](node.value)
        except (KeyError, ValueError):
            found = f"{node.value[:60]!r} with the tag {node.tag.replace(_TAG, '!!')}"
            self._add(node, path, found, "a plain text, number, true or false", "Remove the tag or mend the value.")
            return None

    def _mapping(self, node: yaml.MappingNode, path: Path) -> dict[str, object]:
        values: dict[str, object] = {}
        lines: dict[str, int] = {}
        for key_node, value_node in node.value:
            key = _key(key_node)
            if key in values:
                found = f"the key a second time (first on line {lines[key]})"
                self._add(key_node, (*path, key), found, "each key once", "Remove one of the two.")
                continue
            values[key] = self.build(value_node, (*path, key))
            lines[key] = key_node.start_mark.line + 1
        return values

    def _add(self, node: yaml.Node, path: Path, found: str, expected: str, remedy: str) -> None:
        self.problems.append(Problem(self.file, node.start_mark.line + 1, dotted(path), found, expected, remedy))


def _syntax_problem(error: yaml.YAMLError, text: str, file: str) -> Problem:
    if isinstance(error, ReaderError):
        line = text[: int(error.position)].count("\n") + 1
        found = f"the control character 0x{ord(text[int(error.position)]):02x}"
        return Problem(file, line, "", found, "printable text", "Remove it, or save the file again as UTF-8.")
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    said = getattr(error, "problem", None) or getattr(error, "context", None) or str(error)
    line = None if mark is None else mark.line + 1
    remedy = "Check indentation, colons, quotes and brackets on this line and the one above."
    if "'\\t'" in said:
        remedy = "Indent with spaces: YAML allows no tab there."
    return Problem(file, line, "", f"a syntax error ({said})", "valid YAML", remedy)
