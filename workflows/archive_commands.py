"""The commands that work on archives: run, status, reprocess, compare, prune."""

import json
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ..schemas.cluster import Cluster
from ..schemas.problems import InvalidInput, Problem
from . import options
from .options import ClusterOption, JsonOption, LogJsonOption, SchedulerOption, VerboseOption, WorkersOption

FAILED = 1
_COLOURS = {
    **{"current": "green", "made": "green", "new": "cyan", "stale": "yellow", "running": "blue"},
    **{"failed": "red", "invalid": "red", "left out": "dim"},
}
_console = Console()

ArchiveArgument = Annotated[str, typer.Argument(metavar="ARCHIVE", help="A folder or URL with an archive.yaml.")]
WhereOption = Annotated[
    str | None,
    typer.Option("--where", metavar="EXPR", help="Which missions, e.g. platform == 'Vortex' and start >= 2026-06-01."),
]
DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Only say what would be done.")]


class Running(NamedTuple):
    """How missions are run, and how it is told."""

    scheduler: str | None
    workers: int | None
    cluster: Cluster | None
    as_json: bool
    log_json: bool
    verbose: bool


def run(archive: str, running: Running, only: set[str] | None = None) -> None:
    """`seamosaic run ARCHIVE`; only some of its missions where their ids are given."""
    from ..catalog.archives import open_archive
    from . import archive_run
    from .progress import log_to_stderr

    opened = open_archive(archive)
    bars = opened.config.concurrency == 1
    log_to_stderr(running.verbose, running.log_json, bars)
    given = running.scheduler, running.workers, running.cluster, running.verbose, running.log_json, bars
    summary = archive_run.run_archive(
        opened, archive_run.Options(*given), lambda state: only is None or state.id in only
    )
    if running.as_json:
        _console.print_json(json.dumps(_document(summary)))
    elif not running.log_json:
        _print_summary(summary)
    if summary.failed:
        raise typer.Exit(FAILED)


def _document(summary: Any) -> dict[str, Any]:
    counts: dict[str, int] = {}
    for one in summary.missions:
        counts[one.outcome] = counts.get(one.outcome, 0) + 1
    return {
        "archive": summary.archive,
        "started": summary.started,
        "ended": summary.ended,
        "failed": summary.failed,
        "counts": counts,
        "missions": [one._asdict() for one in summary.missions],
        "pruned": summary.pruned._asdict() if summary.pruned else None,
    }


def _print_summary(summary: Any) -> None:
    table = Table(title=Text(summary.archive), title_justify="left")
    for name in ("mission", "outcome", "version"):
        table.add_column(name)
    for name in ("computed", "reused", "seconds"):
        table.add_column(name, justify="right")
    table.add_column("why", overflow="fold")
    for one in summary.missions:
        counts = (str(one.computed), str(one.reused), f"{one.seconds:.1f}") if one.seconds else ("", "", "")
        table.add_row(_name(one), _coloured(one.outcome), _version(one.version), *counts, Text(one.why))
    _console.print(table)
    if summary.pruned is not None:
        _print_pruned(summary.pruned, dry_run=False)


def _name(one: Any) -> Text:
    return Text(one.id or one.url)


def _version(number: int) -> str:
    return f"v{number}" if number else ""


def _coloured(word: str) -> Text:
    return Text(word, _COLOURS.get(word, ""))


def status(archive: ArchiveArgument, where: WhereOption = None, as_json: JsonOption = False) -> None:
    """Say of every mission of an archive what stands, what the next run would do, and why. Nothing is computed."""
    states = _selected(archive, where)
    if as_json:
        _console.print_json(json.dumps([_state(state) for state in states]))
        return
    table = Table(title=Text(archive), title_justify="left")
    for name in ("mission", "version", "state"):
        table.add_column(name)
    for name in ("images", "cells", "sigma", "took"):
        table.add_column(name, justify="right")
    table.add_column("next run", no_wrap=True)
    table.add_column("why", overflow="fold")
    for state in states:
        cells = _name(state), _version(state.version), _coloured(state.state)
        table.add_row(*cells, *_figures(state), state.would, Text(state.why))
    _console.print(table)


def _state(state: Any) -> dict[str, Any]:
    about = {name: value for name, value in state.row.items() if name not in ("id", "version")}
    words = {"state": state.state, "why": state.why, "would": state.would}
    return {"id": state.id, "url": state.url, **words, "version": state.version, **about}


def _figures(state: Any) -> list[str]:
    """Images placed of all, cells, sigma and duration, as far as there are any."""
    row = state.row
    images = f"{row['placed']}/{row['images']}" if "placed" in row else str(row.get("images", ""))
    cells = f"{row['cells']:,}" if "cells" in row else ""
    sigma = f"{1e3 * row['sigma_m']:.1f} mm" if "sigma_m" in row else ""
    return [images, cells, sigma, f"{row['seconds']:.0f} s" if "seconds" in row else ""]


def _selected(archive: str, where: str | None) -> list[Any]:
    from ..catalog.archives import open_archive
    from ..schemas.expressions import compile_expression
    from . import archive_states

    selects = compile_expression(where) if where else None
    states = archive_states.assess_all(open_archive(archive))
    return [state for state in states if selects is None or selects(state.row)]


def reprocess(
    archive: ArchiveArgument,
    set_: Annotated[list[str], typer.Option("--set", metavar="KEY=VALUE", help="A parameter; repeatable.")],
    where: WhereOption = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    cluster: ClusterOption = None,
    as_json: JsonOption = False,
    log_json: LogJsonOption = False,
    verbose: VerboseOption = False,
    dry_run: DryRunOption = False,
) -> None:
    """Give missions of an archive other parameters, for good, and make new versions, reusing what does not depend on
    them."""
    from . import archive_reprocess
    from .progress import log_to_stderr

    log_to_stderr(verbose, log_json, bars=False)
    chosen = options.cluster(cluster, scheduler, workers)
    states = [state for state in _selected(archive, where) if state.look is not None]
    if not states:
        remedy = "Look at `seamosaic status` for what there is."
        raise InvalidInput([Problem("--where", None, "", "no mission", f"missions with {where}", remedy)])
    changed = archive_reprocess.change_parameters(archive, states, set_, dry_run)
    if dry_run:
        if as_json:
            _console.print_json(json.dumps(changed))
        else:
            for mission_id, words in changed.items():
                _console.print(Text(f"{mission_id}: {words}"))
        return
    running = Running(scheduler, workers, chosen, as_json, log_json, verbose)
    run(archive, running, set(changed))


def compare(
    first: Annotated[str, typer.Argument(metavar="V1", help="A version's folder or URL.")],
    second: Annotated[str, typer.Argument(metavar="V2", help="Another version of the same place.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FOLDER", help="For difference maps and a report.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Map the difference of two versions, and say by how much and by what they differ."""
    from . import compare as comparer

    found = comparer.compare(first, second, out)
    if as_json:
        _console.print_json(json.dumps(found))
    else:
        _print_comparison(found)
        if out is not None:
            _console.print(
                Text(f"Look at {out / 'compare.html'} in a browser and at {out / 'difference.tif'} in QGIS.")
            )


def _print_comparison(found: dict[str, Any]) -> None:
    from .compare import lines

    table = Table(title=Text(f"{found['second']} minus {found['first']}"), title_justify="left", show_header=False)
    for name, value in lines(found):
        table.add_row(Text(name, "cyan"), Text(value, overflow="fold"))
    _console.print(table)


def prune(
    place: Annotated[str, typer.Argument(metavar="ARCHIVE|OUT", help="An archive, or a folder of products.")],
    keep_gb: Annotated[
        float | None,
        typer.Option("--keep-gb", min=0, metavar="GB", help="What may stay (1e9 bytes); an archive has its own limit."),
    ] = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Free intermediate results, those first that were not used for longest. Products and running missions stay."""
    from ..catalog import pruning
    from ..catalog.archives import is_archive, open_archive

    out, limit = place, keep_gb
    if is_archive(place):
        archive = open_archive(place)
        out, limit = archive.products, archive.config.keep_gb if keep_gb is None else keep_gb
    if limit is None:
        remedy = "Add --keep-gb 0 to free everything, or keep_gb to archive.yaml."
        raise InvalidInput([Problem("--keep-gb", None, "", "nothing", "how many gigabytes may stay", remedy)])
    if out == place and not pruning.exists(out):
        remedy = "Name an archive, or the folder that runs were given with -o."
        raise InvalidInput([Problem(out, None, "", "nothing", "a folder of products", remedy)])
    pruned = pruning.prune(out, limit * 1e9, dry_run=dry_run)
    if as_json:
        _console.print_json(json.dumps(pruned._asdict()))
    else:
        _print_pruned(pruned, dry_run)
    if pruned.failed:
        raise typer.Exit(FAILED)


def _print_pruned(pruned: Any, dry_run: bool) -> None:
    said = "would be freed" if dry_run else "freed"
    gigabytes = f"{pruned.freed / 1e9:.2f} of {pruned.before / 1e9:.2f} GB"
    _console.print(Text(f"{gigabytes} of intermediate results {said}, {pruned.entries} of them"))
    for mission_id in pruned.busy:
        _console.print(Text(f"left alone, as a run is at work on it: {mission_id}"))
    for why in pruned.failed:
        _console.print(Text(f"not freed: {why}"))
