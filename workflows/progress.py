"""What is said of long work: bars on a terminal, one line a minute in a log, as text or as JSON."""

import json
import logging
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from .job import log

_LOG_EVERY_S = 60.0
_FIELD = re.compile(r"(\w+)=%[-.0-9]*[a-z]")


class JsonLines(logging.Formatter):
    """One JSON object a line: time, level, the `name=%s` fields of the message, and what else it says as `message`."""

    def format(self, record: logging.LogRecord) -> str:
        template = str(record.msg)
        names, args = _FIELD.findall(template), record.args if isinstance(record.args, tuple) else ()
        named = zip(names, args, strict=False)
        rest = _FIELD.sub("", template).strip()
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            **{name: round(value, 3) if isinstance(value, float) else value for name, value in named},
        }
        if rest:
            line["message"] = rest % args[len(names) :] if len(args) > len(names) else rest
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str, ensure_ascii=False)


def log_to_stderr(verbose: bool, as_json: bool = False, bars: bool = True) -> None:
    """Send the log to standard error; details if verbose.

    JSON, or coloured on a terminal, with bars of progress, and plain lines elsewhere. bars : False where several
    processes write to one terminal.
    """
    handler: logging.Handler = logging.StreamHandler()
    if as_json:
        handler.setFormatter(JsonLines())
    elif bars and sys.stderr.isatty():
        handler = RichHandler(console=Console(stderr=True), show_path=False)
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    log.handlers = [handler]
    log.setLevel(logging.DEBUG if verbose else logging.INFO)


def is_json() -> bool:
    """Whether the log is for a program."""
    return any(isinstance(handler.formatter, JsonLines) for handler in log.handlers)


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
