"""The `seamosaic` command.

Exit codes: 0 done, 1 failed (of an archive: any mission), 2 invalid input, 130 interrupted, 143 ended by SIGTERM.
"""

import errno
import json
import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ..catalog import leases
from ..schemas.problems import InvalidInput, Problem
from . import archive_commands, options
from .calibrate_commands import app as calibrate_app
from .job import log
from .options import (
    ClusterOption,
    JsonOption,
    LogJsonOption,
    ParamsOption,
    SchedulerOption,
    SetOption,
    VerboseOption,
    WorkersOption,
)
from .progress import is_json, log_to_stderr

FAILED, INVALID, INTERRUPTED, TERMINATED = 1, 2, 130, 143

app = typer.Typer(
    name="seamosaic",
    help="Maps of the seabed from AUV stills, a laser cross and navigation: bathymetry, meshes and mosaics.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
app.add_typer(calibrate_app, name="calibrate")
for command in (archive_commands.status, archive_commands.reprocess, archive_commands.compare, archive_commands.prune):
    app.command()(command)
_console = Console()
_errors = Console(stderr=True)

MissionArgument = Annotated[
    str, typer.Argument(metavar="MISSION", help="Mission folder, or any URL that fsspec reads.")
]


@app.command()
def run(
    mission: Annotated[
        str, typer.Argument(metavar="MISSION|ARCHIVE", help="A mission, or a folder with archive.yaml: path or URL.")
    ],
    out: Annotated[
        str | None,
        typer.Option("--out", "-o", metavar="OUT", help="Folder or s3://...; products go to OUT/<mission id>/v1, ..."),
    ] = None,
    params: ParamsOption = None,
    set_: SetOption = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    cluster: ClusterOption = None,
    as_json: JsonOption = False,
    log_json: LogJsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Process a mission, or what is new or stale in an archive. What was computed before is not computed again."""
    from ..catalog.archives import is_archive
    from . import run as runner

    log_to_stderr(verbose, log_json)
    chosen = options.cluster(cluster, scheduler, workers)
    if is_archive(mission):
        _refuse_beside_an_archive(out, params, set_)
        archive_commands.run(mission, archive_commands.Running(scheduler, workers, chosen, as_json, log_json, verbose))
        return
    if out is None:
        remedy = "Add -o OUT; an archive, which has archive.yaml, names it there."
        raise InvalidInput([Problem("--out", None, "", "nothing", "the folder of the products", remedy)])
    result = runner.run(mission, out, options.parameters(params, set_), scheduler, workers, chosen)
    log.info("mission=%s step=%s path=%s new=%s", result.quality.mission.id, "done", str(result.path), result.new)
    if as_json:
        _console.print_json(json.dumps(_summary(result)))
    elif not log_json:
        _print_result(result)


def _refuse_beside_an_archive(out: str | None, params: Path | None, set_: list[str] | None) -> None:
    for option, given in (("--out", out), ("--params", params), ("--set", set_)):
        if given:
            remedy = "Put it into archive.yaml; `seamosaic reprocess` gives some missions other parameters."
            raise InvalidInput([Problem(option, None, "", str(given), "nothing, for an archive", remedy)])


def _summary(result: Any) -> dict[str, Any]:
    """A run for programs."""
    return {
        "mission": result.quality.mission.id,
        "path": str(result.path),
        "new": result.new,
        "steps": [step.model_dump(mode="json") for step in result.steps],
        "quality": result.quality.model_dump(mode="json"),
    }


@app.command()
def check(mission: MissionArgument, params: ParamsOption = None, set_: SetOption = None) -> None:
    """Say everything that is wrong with a mission, and what `run` would make of it."""
    from . import check as checker

    result = checker.check(mission, options.parameters(params, set_))
    checker.print_check(result, _console)
    if not result.valid:
        raise typer.Exit(INVALID)


@app.command()
def simulate(
    scene: Annotated[
        str,
        typer.Argument(
            metavar="SCENE", help="plane, box, pool, reef, sea, night, pairs, sand, port, floor, demo or full."
        ),
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="A new folder.")],
    seed: Annotated[int, typer.Option(help="Another seed, another seabed.")] = 0,
    images: Annotated[int | None, typer.Option(min=1, help="How many images.")] = None,
    width: Annotated[int | None, typer.Option(min=64, help="Width of an image, pixels; 4:3.")] = None,
) -> None:
    """Make a mission with its truth, in the public format."""
    from . import simulate as simulator

    path = simulator.simulate(scene, out, seed, **_overrides(images, width))
    _console.print(Text(f"{scene} mission with its truth in {path}"))


@app.command()
def evaluate(
    products: Annotated[Path, typer.Argument(metavar="PRODUCTS", help="OUT, OUT/<mission id> or OUT/<mission id>/vN.")],
    truth: Annotated[
        Path, typer.Option("--truth", metavar="TRUTH", help="Simulated mission, raster or LAS/LAZ cloud.")
    ],
) -> None:
    """Measure products against a truth; prints one JSON object."""
    from . import evaluate as evaluator

    _console.print_json(json.dumps(evaluator.evaluate(products, truth)))


@app.command()
def demo(out: Annotated[Path, typer.Argument(metavar="OUT", help="A new or an earlier demo's folder.")]) -> None:
    """Make a small mission, process it, measure it against its truth and say where to look."""
    from . import evaluate as evaluator
    from . import run as runner
    from . import simulate as simulator

    log_to_stderr(False)
    mission = out / "mission"
    if not mission.exists():
        _console.print("Making a small mission over a simulated reef ...")
        simulator.simulate("demo", mission)
    result = runner.run(str(mission), str(out / "products"), options.parameters(None, None))
    _print_result(result)
    measured = evaluator.evaluate(str(result.path), mission)
    _console.print("Against the simulation's truth:")
    _console.print_json(json.dumps(measured))
    _console.print(Text(f"\nLook at {result.path / 'report.html'} in a browser,"))
    _console.print(Text(f"and open {result.path / 'bathymetry.tif'} and {result.path / 'mosaic.tif'} in QGIS."))


def _overrides(images: int | None, width: int | None) -> dict[str, Any]:
    given = {"images": images, "width": width}
    return {name: value for name, value in given.items() if value is not None}


def _print_result(result: Any) -> None:
    quality = result.quality
    table = Table(
        title=Text(f"{quality.mission.id}: {'new version' if result.new else 'nothing changed,'} {result.path}")
    )
    table.add_column("step")
    for name in ("computed", "reused", "core seconds"):
        table.add_column(name, justify="right")
    for step in result.steps:
        table.add_row(step.name, str(step.count_computed), str(step.count_reused), f"{step.core_seconds:.1f}")
    _console.print(table if result.steps else table.title)
    figures = Table(show_header=False, box=None)
    for name, value in _figures(quality):
        figures.add_row(name, value)
    _console.print(figures)
    for warning in quality.warnings:
        _console.print(Text("warning: ", "yellow") + Text(warning))


def _figures(quality: Any):
    counts = quality.mission.images.by_status
    yield "images", f"{quality.mission.images.total}: " + ", ".join(f"{n} {kind}" for kind, n in sorted(counts.items()))
    if quality.soundings is not None:
        yield "laser soundings", f"{quality.soundings.count}"
    if quality.pairs is not None:
        yield "image pairs", f"{quality.pairs.linked} linked of {quality.pairs.tried} tried"
    if quality.bathymetry is not None:
        yield "bathymetry", f"{quality.bathymetry.area_m2:.1f} m², cells of {quality.bathymetry.cell_m:g} m"
    if quality.mosaic is not None:
        yield "mosaic", f"{quality.mosaic.area_m2:.1f} m², pixels of {1e3 * quality.mosaic.cell_m:g} mm"


def main() -> None:
    """Entry point: every error that a user can cause becomes a message and an exit code."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))  # workers are ended and leftovers removed
    try:
        app()
    except InvalidInput as error:
        from .check import print_problems

        if is_json():
            for problem in error.problems:
                log.error("step=%s %s", "invalid", problem)
        else:
            print_problems(error.problems, "invalid input", _errors)
        sys.exit(INVALID)
    except SystemExit as left:
        if left.code in (INTERRUPTED, TERMINATED):
            _say("stopped; run the same command again to go on from here")
        raise
    except Exception as error:  # the last resort: a message for the user, the traceback with --verbose
        log.debug("failed", exc_info=True)
        _say(f"failed: {str(error) or type(error).__name__}{_remedy(error)}")
        sys.exit(FAILED)
    finally:
        leases.give_back_all()


def _remedy(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return "; make room, then run the same command again to go on from here"
    return ""


def _say(why: str) -> None:
    """The last word, in the log where that is JSON."""
    if is_json():
        log.error("step=%s %s", "end", why)
    else:
        _errors.print(Text(why, "red"))


if __name__ == "__main__":
    main()
