"""Times as they are written in tables and in file names; all become int64 nanoseconds since 1970, UTC."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .problems import inconsistent

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_ISO = re.compile(r"(?:19|20|21)\d\d-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d(?:\.\d{1,9})?)?Z?", re.ASCII)
_POSIX = re.compile(r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,2})?", re.ASCII)
# The year 2199; a larger number is milliseconds or worse.
_POSIX_END = 7_258_118_400
_YEARS = range(1900, 2200)

_DIRECTIVES = {
    "Y": r"\d{4}",
    "y": r"\d{2}",
    "m": r"\d{2}",
    "d": r"\d{2}",
    "j": r"\d{3}",
    "H": r"\d{2}",
    "M": r"\d{2}",
    "S": r"\d{2}",
    "f": r"\d{1,9}",
    "s": r"\d{9,10}",
    "z": r"Z|[+-]\d{2}:?\d{2}",
}


class Times(NamedTuple):
    """Parsed times.

    Attributes
    ----------
    ns : (N,) int64 nanoseconds since 1970 UTC; 0 where a text is no time.
    bad : indices of the texts that are no time.
    """

    ns: NDArray[np.int64]
    bad: NDArray[np.int64]


def parse_times(texts: Sequence[str]) -> Times:
    """Times of a table's column: ISO 8601 (UTC where no offset is given) or POSIX seconds, to the nanosecond."""
    if all(map(_ISO.fullmatch, texts)):
        try:
            days = np.array([text.removesuffix("Z") for text in texts], "datetime64[ns]")
            return Times(days.astype(np.int64), np.zeros(0, np.int64))
        except ValueError:
            pass  # a 13th month somewhere: find out where
    parsed = [parse_time(text) for text in texts]
    bad = np.array([i for i, ns in enumerate(parsed) if ns is None], np.int64)
    return Times(np.array([ns or 0 for ns in parsed], np.int64), bad)


def parse_time(text: str) -> int | None:
    """Nanoseconds since 1970 of one ISO 8601 time or number of POSIX seconds; None if it is neither."""
    if _POSIX.fullmatch(text):
        seconds = Decimal(text)
        return int(seconds * 10**9) if seconds < _POSIX_END else None
    # fromisoformat knows microseconds only; what follows is added.
    fraction = re.search(r"[.,](\d{6})(\d{1,3})(?=$|[Z+-])", text)
    rest = 0
    if fraction is not None:
        rest = int(fraction[2].ljust(3, "0"))
        text = text[: fraction.start(2)] + text[fraction.end(2) :]
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return None
    if len(text) <= len("2026-06-03") or moment.year not in _YEARS:
        return None
    return to_ns(moment) + rest


def to_ns(moment: datetime) -> int:
    """Nanoseconds since 1970 of a datetime; one without an offset is UTC."""
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    return (moment - _EPOCH) // timedelta(microseconds=1) * 1000


def iso(ns: int | np.int64) -> str:
    """A time as people read it: `2026-06-03T02:14:07.136751Z`, whole seconds without a fraction."""
    text = str(np.datetime64(int(ns), "ns"))
    whole, _, fraction = text.partition(".")
    fraction = fraction.rstrip("0")
    return f"{whole}.{fraction}Z" if fraction else f"{whole}Z"


def check_pattern(pattern: str) -> str:
    """Refuse a file name pattern from which no full time of day and date can be read (for pydantic)."""
    directives = re.findall(r"%(.?)", pattern)
    known = {*_DIRECTIVES, "%"}
    for directive in directives:
        if directive not in known:
            allowed = " ".join(f"%{letter}" for letter in _DIRECTIVES)
            raise inconsistent("", f"%{directive} in {pattern!r}", f"only {allowed} and %%", "Use one of these.")
    used = set(directives)
    date = used & {"Y", "y"} and (used >= {"m", "d"} or "j" in used)
    if "s" not in used and not (date and used >= {"H", "M"}):
        remedy = "A name without date or time cannot place an image: use timestamps from exif or csv."
        raise inconsistent("", repr(pattern), "year, month, day, hour and minute at least", remedy)
    if len(used - {"%"}) != len([d for d in directives if d != "%"]):
        raise inconsistent("", repr(pattern), "each directive once", "Write the other places out as plain text.")
    return pattern


def name_regex(pattern: str) -> re.Pattern[str]:
    """The regular expression of a strptime pattern; it finds every place of a name where the pattern fits."""
    parts = re.split(r"%(.)", pattern)
    regex = ""
    for i, part in enumerate(parts):
        if i % 2 == 0 or part == "%":
            regex += re.escape(part)
        else:
            regex += f"(?P<{part}>{_DIRECTIVES[part]})"
    return re.compile(f"(?={regex})", re.ASCII)


def time_in_name(regex: re.Pattern[str], stem: str) -> int | None:
    """Nanoseconds since 1970 found anywhere in a file's stem; None if the pattern fits nowhere.

    Parameters
    ----------
    regex : from `name_regex`.
    """
    for match in regex.finditer(stem):
        ns = _from_groups({key: value for key, value in match.groupdict().items() if value is not None})
        if ns is not None:
            return ns
    return None


def _from_groups(found: dict[str, str]) -> int | None:
    fraction = int(found.get("f", "0").ljust(9, "0"))
    if "s" in found:
        return int(found["s"]) * 10**9 + fraction
    year = int(found["Y"]) if "Y" in found else _two_digit_year(int(found["y"]))
    hour, minute, second = (int(found.get(key, "0")) for key in "HMS")
    try:
        if "j" in found:
            moment = datetime(year, 1, 1, hour, minute, second) + timedelta(days=int(found["j"]) - 1)
        else:
            moment = datetime(year, int(found["m"]), int(found["d"]), hour, minute, second)
    except ValueError:
        return None
    if moment.year != year or year not in _YEARS:
        return None
    return to_ns(moment) + fraction - _offset_ns(found.get("z", "Z"))


def _two_digit_year(year: int) -> int:
    """As strptime and POSIX have it: 69 to 99 are of the last century."""
    return year + (1900 if year >= 69 else 2000)


def _offset_ns(text: str) -> int:
    if text == "Z":
        return 0
    sign = -1 if text[0] == "-" else 1
    return sign * (int(text[1:3]) * 3600 + int(text[-2:]) * 60) * 10**9
