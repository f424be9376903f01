"""Progress of long work: bars on a terminal, one line a minute in a log."""

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from .job import log

_LOG_EVERY_S = 60.0


def log_to_stderr(verbose: bool) -> None:
    """Send the log to standard error: coloured on a terminal, plain lines elsewhere; details if verbose."""
    if sys.stderr.isatty():
        handler: logging.Handler = RichHandler(console=Console(stderr=True), show_path=False)
    else:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    log.handlers = [handler]
    log.setLevel(logging.DEBUG if verbose else logging.INFO)


@contextmanager
def progress(mission: str, step: str, total: int) -> Iterator[Callable[[int], None]]:
    """A function to call with the number of tasks that ended."""
    if sys.stderr.isatty():
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
