"""Options that several commands share, and what is made of them."""

from pathlib import Path
from typing import Annotated

import typer

from ..schemas.cluster import Cluster
from ..schemas.parameters import Parameters
from ..schemas.problems import InvalidInput, Problem
from ..schemas.yaml_input import load_model, load_parameters

ParamsOption = Annotated[Path | None, typer.Option("--params", metavar="FILE", help="YAML file of parameters.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="One parameter, e.g. grid.cell_m=0.05; repeatable."),
]
WorkersOption = Annotated[int | None, typer.Option(min=1, help="Processes; default: one a core.")]
SchedulerOption = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler (tcp://...), or threads or sync.")
]
ClusterOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="YAML file of a cluster to start: local, slurm or pbs.")
]
VerboseOption = Annotated[bool, typer.Option("--verbose", "-v", help="Log every step that is computed.")]
LogJsonOption = Annotated[
    bool,
    typer.Option("--log-json", envvar="SEAMOSAIC_LOG_JSON", help="Log to standard error as JSON, one object a line."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="The outcome as one JSON document on standard output.")]


def parameters(file: Path | None, overrides: list[str] | None) -> Parameters:
    """Of --params and --set."""
    text = None if file is None else _text(file, "--params", "a YAML file of parameters")
    return load_parameters(text, str(file), overrides or [])


def cluster(file: Path | None, scheduler: str | None, workers: int | None) -> Cluster | None:
    """Of --cluster, which goes neither with --scheduler nor with --workers."""
    if file is None:
        return None
    for name, given in (("--scheduler", scheduler), ("--workers", workers)):
        if given is not None:
            remedy = "Leave one of the two away."
            raise InvalidInput([Problem("--cluster", None, "", f"--cluster and {name}", "one of them", remedy)])
    return load_model(_text(file, "--cluster", "a YAML file of a cluster"), str(file), Cluster)


def _text(file: Path, option: str, expected: str) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput([Problem(option, None, "", str(error), expected, "Correct the path.")]) from error
