"""Tables with a header row: read as columns of text, then as numbers or times, every fault with its line."""

import csv
import difflib
import io
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .problems import InvalidInput, Problem, on_lines
from .timestamps import iso, parse_times
from .yaml_document import decode

Array = NDArray[np.float64]


class Bounds(NamedTuple):
    """What the values of a column can be.

    Attributes
    ----------
    least, most : both included.
    unit : for the message.
    remedy : what to do with a value outside.
    """

    least: float
    most: float
    unit: str
    remedy: str = "Correct the value, or leave the cell empty if it was not measured."


class Table:
    """The cells of a CSV file and the problems found in it so far.

    Attributes
    ----------
    file : its name, for the messages.
    columns : name to cells, stripped of blanks; a column that is missing is not in it.
    lines : (N,) line number of each row, from 1.
    problems : what is wrong.
    """

    def __init__(self, file: str, columns: dict[str, list[str]], lines: NDArray[np.int64], problems: list[Problem]):
        self.file, self.columns, self.lines, self.problems = file, columns, lines, problems

    def __len__(self) -> int:
        return len(self.lines)

    def numbers(self, name: str, bounds: Bounds) -> Array:
        """A column as float64 (N,); NaN where the cell is empty, wrong or out of bounds, or the column missing."""
        cells = self.columns.get(name)
        if cells is None:
            return np.full(len(self), np.nan)
        values = _floats(cells)
        # An empty cell is a missing value; a cell that says NaN is a mistake upstream that should be seen.
        wrong = np.flatnonzero(~np.isfinite(values))
        wrong = wrong[[cells[i] != "" for i in wrong]] if len(wrong) else wrong
        remedy = "Write a number, or leave the cell empty if it was not measured."
        self._report(wrong, name, cells, f"a number, {bounds.unit}", remedy)
        with np.errstate(invalid="ignore"):
            outside = np.flatnonzero((values < bounds.least) | (values > bounds.most))
        expected = f"{bounds.least:g} to {bounds.most:g} {bounds.unit}"
        self._report(outside[np.isfinite(values[outside])], name, cells, expected, bounds.remedy)
        values[wrong] = values[outside] = np.nan
        return values

    def times(self) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """The column `time` as int64 nanoseconds since 1970 UTC (N,), and which of them (N,) are times."""
        cells = self.columns.get("time", [])
        if not cells:
            return np.zeros(len(self), np.int64), np.zeros(len(self), bool)
        times = parse_times(cells)
        expected = "ISO 8601 such as 2026-06-03T02:14:07.136Z, or POSIX seconds"
        self._report(times.bad, "time", cells, expected, "Correct the time, or remove the row.")
        good = np.ones(len(self), bool)
        good[times.bad] = False
        return times.ns, good

    def _report(self, rows: NDArray[np.int64], name: str, cells: list[str], expected: str, remedy: str) -> None:
        def found(i: int) -> str:
            return repr(cells[rows[i]][:40]) if cells[rows[i]] else "an empty cell"

        self.problems += on_lines(self.file, [int(self.lines[i]) for i in rows], name, found, expected, remedy)


def _floats(cells: list[str]) -> Array:
    filled = [cell or "nan" for cell in cells] if "" in cells else cells
    try:
        values = np.array(list(map(float, filled)), float)
    except ValueError:
        values = np.array([_float(cell) for cell in filled])
    if "_" in "".join(cells):  # Python reads 1_0 as 10; nobody else does
        values[["_" in cell for cell in cells]] = np.nan
    return values


def _float(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


class _Rows(NamedTuple):
    """A CSV text split into cells.

    Attributes
    ----------
    header : cells of the first row that is not blank.
    header_line : its line.
    columns : the cells below each cell of the header, of the rows that have as many cells.
    lines : line of each of these rows.
    ragged : line and number of cells of the other rows.
    fault : line and reason where the text stops being CSV.
    """

    header: list[str]
    header_line: int
    columns: list[list[str]]
    lines: list[int]
    ragged: list[tuple[int, int]]
    fault: tuple[int, str] | None = None


def read_table(content: str | bytes, file: str, required: Sequence[str], optional: Sequence[str] = ()) -> Table:
    """Split a CSV file into columns; check its header and the number of cells in each row.

    Parameters
    ----------
    content : text, or bytes in UTF-8.
    required, optional : the columns that it must and may have, in any order.
    """
    try:
        text = decode(content, file)
    except InvalidInput as error:
        return Table(file, {}, np.zeros(0, np.int64), list(error.problems))
    rows = _quoted_rows(text) if '"' in text else _plain_rows(text)
    problems: list[Problem] = []
    if rows.fault is not None:
        remedy = "Save the table again as plain CSV with commas."
        problems.append(Problem(file, rows.fault[0], "", rows.fault[1], "a CSV table", remedy))
    if not rows.header:
        expected, remedy = f"a header row {','.join(required)}", "Write the header and the rows."
        problems = problems or [Problem(file, 1, "", "an empty file", expected, remedy)]
        return Table(file, {}, np.zeros(0, np.int64), problems)
    header = [name.strip() for name in rows.header]
    problems += _header_problems(file, rows.header_line, header, required, optional)
    problems += on_lines(
        file,
        [line for line, _ in rows.ragged],
        "",
        lambda i: f"{rows.ragged[i][1]} cells",
        f"{len(header)}, as in the header",
        "Add the missing commas (an empty cell is a missing value), or put texts with commas in quotes.",
    )
    if not rows.lines and not rows.ragged:
        problems.append(Problem(file, rows.header_line, "", "no rows", "one row a sample", "Write the rows."))
    columns = {name: list(map(str.strip, column)) for name, column in zip(header, rows.columns, strict=True)}
    return Table(file, columns, np.array(rows.lines, np.int64), problems)


def _plain_rows(text: str) -> _Rows:
    """Rows of a table without quotes, split as a whole: ten times as fast as row by row."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    used = [i for i, line in enumerate(lines) if line.strip()]
    if not used:
        return _Rows([], 1, [], [], [])
    header = lines[used[0]].split(",")
    commas = len(header) - 1
    complete = [i for i in used[1:] if lines[i].count(",") == commas]
    ragged = [(i + 1, lines[i].count(",") + 1) for i in used[1:] if lines[i].count(",") != commas]
    cells = ",".join([lines[i] for i in complete]).split(",") if complete else []
    columns = [cells[i :: len(header)] for i in range(len(header))]
    return _Rows(header, used[0] + 1, columns, [i + 1 for i in complete], ragged)


def _quoted_rows(text: str) -> _Rows:
    reader = csv.reader(io.StringIO(text, newline=""))
    rows: list[tuple[int, list[str]]] = []
    fault = None
    try:
        rows.extend((reader.line_num, row) for row in reader if any(cell.strip() for cell in row) or len(row) > 1)
    except csv.Error as error:
        fault = (reader.line_num, str(error))
    if not rows:
        return _Rows([], 1, [], [], [], fault)
    header_line, header = rows[0]
    complete = [(line, row) for line, row in rows[1:] if len(row) == len(header)]
    ragged = [(line, len(row)) for line, row in rows[1:] if len(row) != len(header)]
    columns = [[row[i] for _, row in complete] for i in range(len(header))]
    return _Rows(header, header_line, columns, [line for line, _ in complete], ragged, fault)


def _header_problems(
    file: str, line: int, header: list[str], required: Sequence[str], optional: Sequence[str]
) -> list[Problem]:
    wanted = ",".join(required)
    if len(header) == 1 and len(required) > 1 and any(sign in header[0] for sign in ";\t"):
        sign = "semicolons" if ";" in header[0] else "tabs"
        remedy = "Save it with commas between the cells and points as decimal signs."
        return [Problem(file, line, "", f"cells separated by {sign}", f"a header row {wanted}", remedy)]
    known = [*required, *optional]
    missing = [name for name in required if name not in header]
    problems = [
        Problem(file, line, name, "no such column", f"a header row {wanted}", f"Add the column {name}.")
        for name in missing
    ]
    for i, name in enumerate(header):
        if name in header[:i]:
            problems.append(Problem(file, line, name, "the column a second time", "each column once", "Remove one."))
        elif name not in known:
            close = difflib.get_close_matches(name.lower(), missing or known, n=1)
            remedy = f"Did you mean {close[0]}?" if close else "Remove the column."
            expected = f"only {', '.join(known)}"
            problems.append(Problem(file, line, name or f"column {i + 1}", "an unknown column", expected, remedy))
    return problems


def order_problems(file: str, lines: NDArray[np.int64], ns: NDArray[np.int64]) -> list[Problem]:
    """Problems of times (N,) that should increase from row to row but do not."""
    step = np.diff(ns)
    same, back = (np.flatnonzero(step == 0) + 1).tolist(), (np.flatnonzero(step < 0) + 1).tolist()
    return [
        *on_lines(
            file,
            [int(lines[i]) for i in same],
            "time",
            lambda i: f"{iso(ns[same[i]])}, the time of line {lines[same[i] - 1]}",
            "a later time on each row",
            "Remove one of the two rows, or write the times with their fractions of a second.",
        ),
        *on_lines(
            file,
            [int(lines[i]) for i in back],
            "time",
            lambda i: f"{iso(ns[back[i]])} after {iso(ns[back[i] - 1])}",
            "a later time on each row",
            "Sort the rows by time; if the clock was set back, cut the file there.",
        ),
    ]
