"""archive.yaml: where an archive's missions are, where their products go, and with what parameters."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from .base import Model
from .expressions import check_expression

Expression = Annotated[str, Field(min_length=1), AfterValidator(check_expression)]
Value = bool | int | float | str
Settings = Annotated[dict[str, Value], Field(min_length=1, description="parameter, such as grid.cell_m, to its value")]


class Override(Model):
    """Other parameters for some missions."""

    where: Annotated[Expression, Field(description="which missions, e.g. platform == 'Vortex'")]
    set: Settings


class Archive(Model):
    """An archive.yaml. Paths are relative to the folder that holds it; any of them may be a URL that fsspec reads."""

    format: Literal[1]
    title: str = ""
    missions: Annotated[
        tuple[Annotated[str, Field(min_length=1)], ...],
        Field(min_length=1, description="globs of folders that hold a mission.yaml, e.g. missions/*"),
    ]
    products: Annotated[str, Field(min_length=1, description="versions go to PRODUCTS/<mission id>/v1, v2, ...")] = (
        "products"
    )
    parameters: Annotated[
        str | None, Field(min_length=1, description="file of parameters for all missions, as for --params")
    ] = None
    select: Annotated[Expression | None, Field(description="missions that are processed; default: all")] = None
    overrides: Annotated[
        tuple[Override, ...], Field(description="in this order, later ones win; `seamosaic reprocess` wins over all")
    ] = ()
    concurrency: Annotated[int, Field(ge=1, le=64, description="missions that one run processes at a time")] = 1
    keep_gb: Annotated[
        float | None,
        Field(ge=0, description="intermediate results are pruned to this many gigabytes (1e9 bytes) after each run"),
    ] = None
    lease_s: Annotated[
        float,
        Field(ge=1, le=86_400, description="a mission whose run says nothing for so long is free again, seconds"),
    ] = 120.0
