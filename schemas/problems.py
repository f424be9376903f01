"""What is wrong with an input, said so that a person can mend it."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from pydantic_core import PydanticCustomError

# More of one kind in one file tell a reader nothing new.
LISTED_OF_A_KIND = 20


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

    def __reduce__(self):
        return InvalidInput, (self.problems,)


def on_lines(
    file: str, lines: Sequence[int], key: str, found: Callable[[int], str], expected: str, remedy: str
) -> list[Problem]:
    """The same kind of problem on many lines: the first twenty one by one, the others counted.

    Parameters
    ----------
    lines : line numbers from 1.
    found : says what is on the i-th of these lines.
    """
    problems = [
        Problem(file, int(line), key, found(i), expected, remedy) for i, line in enumerate(lines[:LISTED_OF_A_KIND])
    ]
    if len(lines) > LISTED_OF_A_KIND:
        rest, first = len(lines) - LISTED_OF_A_KIND, int(lines[LISTED_OF_A_KIND])
        problems.append(Problem(file, first, key, f"the same on {rest} more lines from here", expected, remedy))
    return problems


def inconsistent(key: str, found: str, expected: str, remedy: str) -> PydanticCustomError:
    """What a model's validator raises when values are fine alone but not together.

    `key` is relative to the model ("port.distance"); the other texts are those of a Problem.
    """
    return PydanticCustomError(
        "inconsistent",
        "{key}: found {found}; expected {expected}. {remedy}",
        {"key": key, "found": found, "expected": expected, "remedy": remedy},
    )
