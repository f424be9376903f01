"""Small expressions that select missions: `platform == "Vortex" and start >= 2026-06-01`.

Python's comparisons, `and`, `or`, `not`, `in` and `like` over a fixed list of names; nothing is ever called or looked
up. Dates are texts (ISO 8601), so they compare as they are written: `start >= 2026-06` is everything from June on.
"""

import ast
import operator
import re
from collections.abc import Callable, Mapping
from fnmatch import fnmatchcase
from typing import Any, Final

from .problems import InvalidInput, Problem, inconsistent

# Of the mission itself, known before anything is processed
MISSION_NAMES: Final = ("id", "title", "platform", "start", "end", "images")
# Of its newest version; none of them is there without one
VERSION_NAMES: Final = (
    "version",
    "created",
    "placed",
    "cells",
    "cell_m",
    "area_m2",
    "sigma_m",
    "core_s",
    "seconds",
    "warnings",
)

_TEXTS: Final = ("id", "title", "platform", "start", "end", "created")

Row = Mapping[str, Any]

_DATE: Final = re.compile(r"(\"[^\"]*\"|'[^']*')|\b(\d{4}-\d\d(?:-\d\d(?:T[\d:.]+Z?)?)?)(?![\w-])")
_LIKE: Final = re.compile(r"(\"[^\"]*\"|'[^']*')|\blike\b")
_LIKE_SIGN: Final = "@"
_COMPARE: Final[dict[type[ast.cmpop], Callable[[Any, Any], bool]]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.In: lambda a, b: a in b,
    ast.NotIn: lambda a, b: a not in b,
}
_EXPECTED: Final = (
    f"comparisons joined by and, or, not, of {', '.join(MISSION_NAMES)} or, of the newest version, "
    f"{', '.join(VERSION_NAMES)}"
)
_REMEDY: Final = "Write it as platform == 'Vortex' and start >= 2026-06-01, or id like 'vortex-*'."


def check_expression(text: str) -> str:
    """The expression as it is, for models.

    Raises
    ------
    PydanticCustomError
        If it is none, or speaks of a version: what decides parameters must not depend on what they made.
    """
    try:
        compile_expression(text, MISSION_NAMES)
    except InvalidInput as error:
        problem = error.problems[0]
        raise inconsistent("", problem.found, problem.expected, problem.remedy) from None
    return text


def compile_expression(
    text: str, names: tuple[str, ...] = MISSION_NAMES + VERSION_NAMES, file: str = "--where"
) -> Callable[[Row], bool]:
    """A function that says whether a row of named values is selected; a value that is not there selects nothing.

    Raises
    ------
    InvalidInput
        If the text is no expression of these names.
    """
    source = _LIKE.sub(lambda found: found[1] or _LIKE_SIGN, text)
    source = _DATE.sub(lambda found: found[1] or f"'{found[2]}'", source)
    try:
        root = ast.parse(source, mode="eval").body
    except (SyntaxError, ValueError, RecursionError) as error:
        raise _wrong(file, f"{text!r} ({getattr(error, 'msg', error)})") from None
    fault = _fault(root, names)
    if fault:
        raise _wrong(file, f"{text!r} with {fault}")
    return lambda row: bool(_value(root, row))


def _wrong(file: str, found: str) -> InvalidInput:
    return InvalidInput([Problem(file, None, "", found, _EXPECTED, _REMEDY)])


def _fault(node: ast.AST, names: tuple[str, ...]) -> str:
    """What of a tree is not allowed; empty if all is."""
    if isinstance(node, ast.Name):
        return "" if node.id in names else f"the unknown name {node.id}"
    if isinstance(node, ast.Constant):
        return "" if isinstance(node.value, str | int | float | None) else f"the value {node.value!r}"
    if isinstance(node, ast.Compare) and all(type(sign) in _COMPARE for sign in node.ops):
        below: list[ast.expr] = [node.left, *node.comparators]
        if any(isinstance(one, ast.Name) and one.id in _TEXTS for one in below) and any(map(_is_number, below)):
            return f"{ast.unparse(node)}, a text beside a number (a date is 2026-06, a text is in quotes)"
    elif isinstance(node, ast.BoolOp):
        below = node.values
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        below = [node.operand]
    elif isinstance(node, ast.UnaryOp) and _is_negative(node):
        below = []
    elif isinstance(node, ast.Tuple | ast.List):
        below = node.elts
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
        below = [node.left, node.right]
    else:
        return f"{ast.unparse(node)}, which is no comparison"
    return next(filter(None, (_fault(one, names) for one in below)), "")


def _is_number(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float)


def _is_negative(node: ast.UnaryOp) -> bool:
    number = node.operand.value if isinstance(node.operand, ast.Constant) else None
    return isinstance(node.op, ast.USub) and isinstance(number, int | float)


def _value(node: ast.AST, row: Row) -> Any:
    if isinstance(node, ast.Name):
        return row.get(node.id)
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, ast.BoolOp):
        join = all if isinstance(node.op, ast.And) else any
        return join(_value(one, row) for one in node.values)
    if isinstance(node, ast.UnaryOp):
        value = _value(node.operand, row)
        return not value if isinstance(node.op, ast.Not) else -value
    if isinstance(node, ast.Tuple | ast.List):
        return [_value(one, row) for one in node.elts]
    if isinstance(node, ast.BinOp):
        return fnmatchcase(str(_value(node.left, row) or ""), str(_value(node.right, row)))
    assert isinstance(node, ast.Compare)
    return _compare(node, row)


def _compare(node: ast.Compare, row: Row) -> bool:
    values = [_value(one, row) for one in (node.left, *node.comparators)]
    for sign, a, b in zip(node.ops, values[:-1], values[1:], strict=True):
        try:
            if a is None or b is None or not _COMPARE[type(sign)](a, b):
                return False
        except TypeError:  # a text against a number
            return False
    return True
