"""The pictures of report.html, each a data URI; drawn with matplotlib's objects, so several threads may draw at once.

Every raster is read at overview resolution: memory does not depend on the size of the map.
"""

import base64
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap, LogNorm, Normalize
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from ..catalog import rasters
from ..catalog.rasters import Overview
from ..catalog.trajectories import Row
from ..schemas.products import Quality

Array = NDArray[np.float64]
MAP_PX: Final = 1400
_DPI: Final = 110
_SUN_AZIMUTH_DEG, _SUN_HEIGHT_DEG = 315.0, 45.0
_RELIEF: Final = 0.35  # typical slope, rise over run, to which relief is exaggerated for shading
_STATUS_COLOURS: Final = {"adjusted": "#0072b2", "navigation": "#e69f00", "rejected": "#d55e00"}
_AXIS_COLOURS: Final = ("#0072b2", "#d55e00", "#009e73")
_BATCH: Final = 1_000_000
_LABELS_IN, _BAR_IN = 0.65, 1.0  # room for axis labels and for a colour bar, inches
_LABEL_BOX: Final = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1}


def data_uri(figure: Figure, kind: str = "png") -> str:
    """The figure as an image inside the page; jpeg for photographs."""
    stream = io.BytesIO()
    options: dict[str, Any] = {"pil_kwargs": {"quality": 85}} if kind == "jpeg" else {}
    figure.savefig(stream, format=kind, dpi=_DPI, bbox_inches="tight", pad_inches=0.06, **options)
    return f"data:image/{kind};base64,{base64.b64encode(stream.getvalue()).decode('ascii')}"


def hillshade(elevation: Array, cell_x_m: float, cell_y_m: float) -> Array:
    """Brightness 0..1 (rows, cols) of a relief lit from the north-west, row 0 north; NaN where there is none.

    Slopes are exaggerated so that the typical one is well seen, whatever the relief.
    """
    known = np.isfinite(elevation)
    if min(elevation.shape) < 2 or not known.any():
        return np.where(known, 0.5, np.nan)
    down, east = np.gradient(np.where(known, elevation, np.nan))
    slope_east, slope_north = np.nan_to_num(east / cell_x_m), np.nan_to_num(-down / cell_y_m)
    typical = float(np.sqrt(np.mean(slope_east[known] ** 2 + slope_north[known] ** 2)))
    factor = min(_RELIEF / typical, 20.0) if typical > 0 else 1.0
    azimuth, height = np.radians(_SUN_AZIMUTH_DEG), np.radians(_SUN_HEIGHT_DEG)
    towards_sun = factor * (slope_east * np.sin(azimuth) + slope_north * np.cos(azimuth))
    length = np.sqrt(1 + factor**2 * (slope_east**2 + slope_north**2))
    light = (np.sin(height) - np.cos(height) * towards_sun) / length
    return np.where(known, np.clip(light, 0, 1), np.nan)


def bathymetry_map(overview: Overview, geographic: bool) -> Figure | None:
    """Colour for elevation, shading for relief."""
    elevation = np.asarray(overview.values[0], float)
    if not overview.valid.any():
        return None
    low, high = (float(v) for v in np.nanpercentile(elevation, [1, 99]))
    norm = Normalize(low, high if high > low else low + 0.01)
    figure, axes = _map_axes(overview, geographic, 8.4, bar=True)
    image = axes.imshow(elevation, cmap="viridis", norm=norm, extent=overview.extent, interpolation="nearest")
    shade = hillshade(elevation, overview.cell_x_m, overview.cell_y_m)[..., None]
    colours = image.to_rgba(elevation)
    colours[..., :3] = np.clip(colours[..., :3] * (0.35 + 0.9 * np.nan_to_num(shade)), 0, 1)
    colours[..., 3] = overview.valid
    image.remove()
    axes.imshow(colours, extent=overview.extent, interpolation="nearest")
    figure.colorbar(image, ax=axes, label="elevation (m)", extend="both")
    return figure


def picture_map(overview: Overview, geographic: bool) -> Figure | None:
    """A colour mosaic, white where there is none."""
    if not overview.valid.any():
        return None
    figure, axes = _map_axes(overview, geographic, 8.4)
    pixels = np.where(overview.valid[..., None], np.moveaxis(overview.values[:3], 0, -1), 255).astype(np.uint8)
    axes.imshow(pixels, extent=overview.extent, interpolation="antialiased")
    return figure


def quantity_map(
    overview: Overview, geographic: bool, label: str, scale: float = 1.0, log: bool = False
) -> Figure | None:
    """One quantity in colour; with log, zeros are left out."""
    values = np.asarray(overview.values[0], float) * scale
    shown = overview.valid & (values > 0) if log else overview.valid
    if not shown.any():
        return None
    low, high = (float(v) for v in np.percentile(values[shown], [2, 98]))
    high = high if high > low else low + max(abs(low), 1e-3)
    norm = LogNorm(low, high) if log else Normalize(low, high)
    figure, axes = _map_axes(overview, geographic, 4.8, bar=True)
    image = axes.imshow(
        np.where(shown, values, np.nan), cmap="cividis", norm=norm, extent=overview.extent, interpolation="nearest"
    )
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    bar = figure.colorbar(image, ax=axes, label=label, format=plain)
    bar.ax.yaxis.set_minor_formatter(plain)
    return figure


def difference_map(overview: Overview, geographic: bool, label: str, scale: float = 1.0) -> Figure | None:
    """A difference in colour: red is more, blue is less, white is none."""
    if not overview.valid.any():
        return None
    values = np.asarray(overview.values[0], float) * scale
    most = float(np.percentile(np.abs(values[overview.valid]), 98)) or 1.0
    figure, axes = _map_axes(overview, geographic, 8.4, bar=True)
    axes.set_facecolor("#d9d9d9")
    image = axes.imshow(
        values, cmap="RdBu_r", norm=Normalize(-most, most), extent=overview.extent, interpolation="nearest"
    )
    figure.colorbar(image, ax=axes, label=label, extend="both")
    return figure


def source_map(overview: Overview, geographic: bool) -> Figure | None:
    """Where each cell comes from."""
    if not overview.valid.any():
        return None
    codes = sorted(rasters.SOURCE_NAMES)
    colours = ListedColormap([np.divide(rasters.SOURCE_COLOURS[code], 255) for code in codes])
    figure, axes = _map_axes(overview, geographic, 4.8, bar=True)
    image = axes.imshow(
        np.ma.masked_where(~overview.valid, overview.values[0]),
        cmap=colours,
        norm=BoundaryNorm([code - 0.5 for code in (*codes, codes[-1] + 1)], len(codes)),
        extent=overview.extent,
        interpolation="nearest",
    )
    bar = figure.colorbar(image, ax=axes, ticks=codes)
    bar.ax.set_yticklabels([rasters.SOURCE_NAMES[code].replace(" ", "\n") for code in codes])
    return figure


def track_map(rows: Sequence[Row], bathymetry: Overview | None, geographic: bool) -> Figure | None:
    """Where the images were taken, by status, over the relief."""
    posed = [(row.kind, row.pose.position) for row in rows if row.pose is not None]
    if not posed:
        return None
    places = np.array([place[:2] for _, place in posed])
    extent = _around(places, bathymetry)
    figure, axes = _axes_for(extent, geographic, 8.4)
    if bathymetry is not None and bathymetry.valid.any():
        shade = hillshade(np.asarray(bathymetry.values[0], float), bathymetry.cell_x_m, bathymetry.cell_y_m)
        axes.imshow(shade, cmap="gray", vmin=-1, vmax=1.2, extent=bathymetry.extent, interpolation="nearest")
    axes.plot(*places.T, color="0.35", linewidth=0.8, zorder=2)
    for kind, colour in _STATUS_COLOURS.items():
        chosen = np.array([found == kind for found, _ in posed])
        if chosen.any():
            label = f"{kind} ({chosen.sum()})"
            axes.scatter(*places[chosen].T, s=14, color=colour, label=label, zorder=3, linewidths=0)
    axes.plot(*places[0], marker="^", color="black", markersize=8, linestyle="none", label="first image", zorder=4)
    axes.set(xlim=extent[:2], ylim=extent[2:])
    axes.legend(loc="upper left", fontsize=8, framealpha=0.85)
    return figure


def _around(places: Array, bathymetry: Overview | None) -> tuple[float, float, float, float]:
    """Left, right, bottom, top of everything, with a margin."""
    low, high = places.min(0), places.max(0)
    if bathymetry is not None:
        left, right, bottom, top = bathymetry.extent
        low, high = np.minimum(low, [left, bottom]), np.maximum(high, [right, top])
    margin = max(0.03 * float((high - low).max()), 0.5)
    return low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin


def sigma_histogram(soundings: Path) -> Figure | None:
    """How many soundings have which sigma, read from soundings.laz in batches."""
    edges_mm = np.linspace(0, 20, 101)
    counts = np.zeros(len(edges_mm) - 1, np.int64)
    with laspy.open(soundings) as file:
        for points in file.chunk_iterator(_BATCH):
            # what lies beyond is counted in the last bar
            sigma_mm = np.clip(np.asarray(points["sigma"], float) * 1000, 0, edges_mm[-1])
            counts += np.histogram(sigma_mm, len(counts), (0, edges_mm[-1]))[0]
    if not counts.any():
        return None
    last = int(np.flatnonzero(counts)[-1]) + 2
    figure = Figure(figsize=(4.8, 3.0), layout="constrained")
    axes = figure.add_subplot()
    axes.stairs(counts[:last], edges_mm[: len(counts[:last]) + 1], fill=True, color="#009e73")
    axes.set(xlabel="1-sigma (mm)", ylabel="soundings")
    axes.set_xlim(left=0)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    return figure


def navigation_difference(rows: Sequence[Row], navigation: Array) -> Figure | None:
    """Navigation minus adjusted position of each adjusted image, (rows, 3) map coordinates, against time."""
    pairs = [
        (row.time, np.subtract(place, row.pose.position))
        for row, place in zip(rows, navigation, strict=True)
        if row.pose is not None and row.kind == "adjusted" and np.isfinite(place).all()
    ]
    if not pairs:
        return None
    times, differences = np.array([time for time, _ in pairs], "datetime64[us]"), np.array([d for _, d in pairs])
    figure = Figure(figsize=(8.4, 3.4), layout="constrained")
    axes = figure.add_subplot()
    for values, name, colour in zip(differences.T, ("x (east)", "y (north)", "z (up)"), _AXIS_COLOURS, strict=True):
        axes.plot(times.astype("O"), values, marker=".", markersize=4, linewidth=1, color=colour, label=name)
    axes.axhline(0, color="0.6", linewidth=0.8, zorder=0)
    locator = AutoDateLocator()
    axes.xaxis.set(major_locator=locator, major_formatter=ConciseDateFormatter(locator))
    axes.set(xlabel="time (UTC)", ylabel="navigation − adjusted (m)")
    axes.legend(fontsize=8)
    return figure


def residuals(quality: Quality) -> Figure | None:
    """What the adjustment left: of each image by its tie points, of each pair by tie points and by crossovers."""
    images = quality.trajectory.images if quality.trajectory else ()
    pairs = quality.pairs.residuals if quality.pairs else ()
    by_image = [np.nan if one.reprojection_px is None else one.reprojection_px for one in images]
    by_pair = [pair.reprojection_px for pair in pairs if pair.reprojection_px is not None]
    crossed = [1000 * pair.apart_m for pair in pairs if pair.apart_m is not None]
    if not pairs:
        return None
    figure = Figure(figsize=(8.4, 2.8), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    left.plot(by_image, marker=".", markersize=4, linestyle="none", color=_AXIS_COLOURS[0])
    left.set(xlabel="image", ylabel="reprojection rms (px)", ylim=(0, None))
    for axes, values, label in ((middle, by_pair, "reprojection rms (px)"), (right, crossed, "lines apart, rms (mm)")):
        if values:
            axes.hist(values, bins=30, color=_AXIS_COLOURS[2])
        axes.set(xlabel=label, ylabel="pairs")
    return figure


def _map_axes(overview: Overview, geographic: bool, width: float, bar: bool = False) -> tuple[Figure, Axes]:
    return _axes_for(overview.extent, geographic, width, bar)


def _axes_for(
    extent: tuple[float, float, float, float], geographic: bool, width: float, bar: bool = False
) -> tuple[Figure, Axes]:
    """Axes in map coordinates, one metre as long in x as in y, with a scale bar and a north arrow.

    The figure is `width` inches wide, with room for a colour bar or without, and as high as the map asks for.
    """
    left, right, bottom, top = extent
    map_width = width - _LABELS_IN - (_BAR_IN if bar else 0)
    map_height = float(np.clip(map_width * (top - bottom) / (right - left), 0.35 * width, width))
    figure = Figure(figsize=(width, map_height + _LABELS_IN), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.set_autoscale_on(False)
    names = ("easting (m)", "northing (m)") if geographic else ("x (m)", "y (m)")
    axes.set_xlabel(names[0], fontsize=9)
    axes.set_ylabel(names[1], fontsize=9)
    for axis, angle in ((axes.xaxis, 0), (axes.yaxis, 90)):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.10g}"))
        axis.set_tick_params(labelsize=7.5, labelrotation=angle)
    for label in axes.get_yticklabels():
        label.set_verticalalignment("center")
    _scale_bar(axes, right - left, map_height)
    _north_arrow(axes, "N" if geographic else "y", map_width, map_height)
    return figure, axes


def round_length(length_m: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not longer, metres."""
    power = 10.0 ** np.floor(np.log10(length_m))
    return float(max(step for step in (1, 2, 5) if step * power <= length_m * (1 + 1e-9)) * power)


def _scale_bar(axes: Axes, width_m: float, map_height_in: float) -> None:
    length = round_length(width_m / 4)
    ends, height = [0.04, 0.04 + length / width_m], 0.12 / map_height_in
    for colour, thickness in (("white", 6), ("black", 3)):
        axes.plot(ends, [height] * 2, transform=axes.transAxes, color=colour, linewidth=thickness, zorder=9)
    text = f"{length:g} m" if length >= 1 else f"{100 * length:g} cm"
    place = {"transform": axes.transAxes, "fontsize": 8, "va": "bottom", "zorder": 10}
    axes.text(ends[0], height + 0.08 / map_height_in, text, bbox=_LABEL_BOX, **place)


def _north_arrow(axes: Axes, text: str, map_width_in: float, map_height_in: float) -> None:
    x = 1 - 0.18 / map_width_in
    axes.annotate(
        text,
        xy=(x, 1 - 0.08 / map_height_in),
        xytext=(x, 1 - 0.52 / map_height_in),
        xycoords="axes fraction",
        ha="center",
        va="center",
        fontsize=9,
        zorder=10,
        arrowprops={
            "arrowstyle": "-|>",
            "color": "black",
            "linewidth": 1.5,
            "path_effects": [withStroke(linewidth=4, foreground="white")],
        },
        bbox=_LABEL_BOX,
    )
