"""The one-page report of a calibration: what was found, how sure it is, and what the data cannot tell."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..schemas.calibration import DISTORTION, Calibration
from ..tasks.calibration_refraction import PinholeError
from ..tasks.calibration_sheets import Sensitivity
from .report import template
from .report_figures import data_uri

Array = NDArray[np.float64]

DETERMINED, PARTLY = 0.5, 0.9
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")


class Row(NamedTuple):
    """A parameter: its value with 1-sigma, and the one it started from with the sigma of that; None if there is none.

    Values are in `unit`. `share` is the sigma over the prior's.
    """

    name: str
    unit: str
    value: float
    sigma: float
    start: float | None = None
    prior: float | None = None

    @property
    def share(self) -> float:
        return self.sigma / self.prior if self.prior else 1.0

    @property
    def verdict(self) -> str:
        """What the data say of it, against what was assumed before."""
        if self.prior is None:
            return ""
        if self.share < DETERMINED:
            return "determined"
        return "partly determined" if self.share < PARTLY else "not determined"


class Figured(NamedTuple):
    """A picture with its words."""

    title: str
    uri: str
    caption: str


class LeftOut(NamedTuple):
    """A line of the leave-one-out table: what was left out, and what happened to it."""

    name: str
    values: tuple[str, ...]


class Page(NamedTuple):
    """What the report says.

    Attributes
    ----------
    title, way : of the page. facts : name and value of what was used. rows : parameters.
    statements : plain sentences on what the data can and cannot determine.
    left_out_header, left_out : the check with parts of the data left out.
    pictures : residual maps and sensitivity. warnings : what the user should look at.
    """

    title: str
    way: str
    facts: tuple[tuple[str, str], ...]
    rows: tuple[Row, ...]
    statements: tuple[str, ...]
    left_out_header: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    pictures: tuple[Figured, ...]
    warnings: tuple[str, ...] = ()


def write_page(path: Path, page: Page) -> None:
    """Write the page as one self-contained HTML file."""
    path.write_text(template("calibration.html").render(page=page), encoding="utf-8")


def residual_map(
    uv: Array, residual: Array, size: tuple[int, int], groups: NDArray, names: Sequence[str], unit: str
) -> Figure:
    """Residuals where they are in the image, one panel for each sheet or kind.

    Parameters
    ----------
    uv : (N, 2) pixels. residual : (N,) in `unit`. size : width and height. groups : (N,) index of the name.
    """
    figure = Figure(figsize=(4.6 * len(names) + 0.9, 3.6), layout="constrained")
    limit = max(float(np.percentile(np.abs(residual), 97)), 1e-9) if len(residual) else 1.0
    panels = figure.subplots(1, len(names), squeeze=False)[0]
    image = None
    for number, (axes, name) in enumerate(zip(panels, names, strict=True)):
        own = groups == number
        image = axes.scatter(*uv[own].T, c=residual[own], s=5, cmap="RdBu_r", vmin=-limit, vmax=limit, linewidths=0)
        axes.set(xlim=(0, size[0]), ylim=(size[1], 0), aspect="equal", title=name, xlabel="u (px)", ylabel="v (px)")
    if image is not None:
        figure.colorbar(image, ax=list(panels), label=unit, shrink=0.85, extend="both")
    return figure


def sensitivity_figure(sensitivity: Sensitivity, covariance: Array, steps: Array, names: Sequence[str]) -> Figure:
    """Altitude error of each sheet parameter at one sigma, and of all together, by altitude.

    Parameters
    ----------
    covariance : (S, S) of the steps. steps : (8, S) normals and offsets by step. names : S of them.
    """
    figure = Figure(figsize=(8.6, 3.8), layout="constrained")
    axes = figure.subplots()
    effect = 1e3 * np.abs(sensitivity.gradient @ steps) * np.sqrt(np.diag(covariance))
    for k, name in enumerate(names):
        style = ("-", "--")[k // max(1, len(names) // 2) % 2]
        axes.plot(sensitivity.altitude_m, effect[:, k], style, color=_COLOURS[k % 3], label=name, lw=1.2)
    total = 1e3 * sensitivity.sigma_m(steps @ covariance @ steps.T)
    axes.plot(sensitivity.altitude_m, total, color="black", lw=2.4, label="all together, with their correlations")
    axes.plot(sensitivity.altitude_m, sensitivity.altitude_m, ":", color="grey", label="0.1 % of the altitude")
    axes.set(xlabel="altitude (m)", ylabel="1-sigma of mean altitude (mm)", yscale="log")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, ncols=2)
    return figure


def pinhole_figure(error: PinholeError) -> Figure:
    """What fitting a camera without refraction would do, by altitude."""
    figure = Figure(figsize=(8.6, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.axhspan(-0.1, 0.1, color="#009e73", alpha=0.15, label="±0.1 %")
    axes.plot(
        error.altitude_m, error.fitted_percent, color=_COLOURS[0], label="brown camera and sheets fitted in water"
    )
    axes.plot(
        error.altitude_m,
        error.camera_only_percent,
        "--",
        color=_COLOURS[1],
        label="brown camera fitted, sheets as true",
    )
    axes.set(xlabel="altitude (m)", ylabel="error of mean altitude (%)")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def bars(values: Sequence[Array], names: Sequence[str], label: str, unit: str) -> Figure:
    """Values (n,) of each image, a colour for each name."""
    figure = Figure(figsize=(8.6, 3.0), layout="constrained")
    axes = figure.subplots()
    for k, (value, name) in enumerate(zip(values, names, strict=True)):
        axes.plot(np.arange(1, len(value) + 1), value, "o-", ms=3, lw=0.8, color=_COLOURS[k % 4], label=name)
    axes.axhline(0, color="grey", lw=0.8)
    axes.set(xlabel=label, ylabel=unit)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def picture(title: str, figure: Figure, caption: str) -> Figured:
    """A figure inside the page."""
    return Figured(title, data_uri(figure), caption)


def camera_rows(calibration: Calibration, sigma: dict[str, float]) -> list[Row]:
    """Rows of the camera's numbers, sigma by name."""
    camera = calibration.camera
    names = DISTORTION[camera.model]
    value = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    value |= dict(zip(names, camera.distortion, strict=False))
    return [Row(f"camera {k}", "px" if k in ("fx", "fy", "cx", "cy") else "", value[k], s) for k, s in sigma.items()]
