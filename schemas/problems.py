"""What is wrong with an input, said so that a person can mend it."""

from collections.abc import Sequence
from typing import NamedTuple


class Problem(NamedTuple):
    """One thing that is wrong with an input file.

    Attributes
    ----------
    file : path of the file as the user would write it.
    line : line number from 1, or None where a line has no meaning (a missing file, an image).
    key : dotted key or column, empty where the whole file is meant.
    found, expected : what is there and what should be.
    remedy : what to do about it.
    """

    file: str
    line: int | None
    key: str
    found: str
    expected: str
    remedy: str

    def __str__(self) -> str:
        place = self.file if self.line is None else f"{self.file}:{self.line}"
        key = f" {self.key}:" if self.key else ""
        return f"{place}:{key} found {self.found}; expected {self.expected}. {self.remedy}"


class InvalidInput(Exception):
    """The input cannot be processed; carries every problem found, not only the first."""

    def __init__(self, problems: Sequence[Problem]):
        self.problems = tuple(problems)
        super().__init__("\n".join(map(str, self.problems)))
