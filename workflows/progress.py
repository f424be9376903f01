"""Progress of long work: bars on a terminal, one line a minute in a log."""

import json
import logging
import math
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Literal

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from .job import log

Style = Literal["bars", "lines", "json"]

_LOG_EVERY_S = 60.0
_LINE = "%(asctime)s %(levelname)s %(message)s"
_NAMED = re.compile(r"(?:^| )([a-z_]+)=(\S+)")


def log_to_stderr(verbose: bool, style: Style = "bars") -> None:
    """Send the log to standard error; details if verbose.

    style : bars for colours and progress bars where it is a terminal; lines for plain ones; json for one JSON object
        a line, with what a line says as `name=value` among its keys.
    """
    if style == "bars" and sys.stderr.isatty():
        handler: logging.Handler = RichHandler(console=Console(stderr=True), show_path=False)
    else:
        handler = logging.StreamHandler()
        handler.setFormatter(_JsonFormatter() if style == "json" else logging.Formatter(_LINE))
    log.handlers = [handler]
    log.setLevel(logging.DEBUG if verbose else logging.INFO)


class _JsonFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        message = record.getMessage()
        time_utc = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        named = {name: _plain(value) for name, value in _NAMED.findall(message)}
        line = {**named, "time": time_utc, "level": record.levelname.lower(), "message": message}
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


def _plain(value: str) -> str | float:
    try:
        number = float(value)
    except ValueError:
        return value
    return int(number) if number.is_integer() else number if math.isfinite(number) else value


@contextmanager
def progress(mission: str, step: str, total: int) -> Iterator[Callable[[int], None]]:
    """A function to call with the number of tasks that ended."""
    if any(isinstance(handler, RichHandler) for handler in log.handlers):
        columns = TextColumn("{task.description:10}"), BarColumn(), MofNCompleteColumn()
        with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=Console(stderr=True)) as bars:
            bar = bars.add_task(step, total=total)
            yield lambda count: bars.update(bar, advance=count)
        return
    started = said = time.monotonic()
    done = 0

    def advance(count: int) -> None:
        nonlocal said, done
        done += count
        now = time.monotonic()
        if now - said > _LOG_EVERY_S:
            said = now
            left = (now - started) / done * (total - done) if done else float("nan")
            log.info("mission=%s step=%s done=%d total=%d seconds_left=%.0f", mission, step, done, total, left)

    yield advance
    log.info("mission=%s step=%s done=%d total=%d seconds=%.1f", mission, step, done, total, time.monotonic() - started)
