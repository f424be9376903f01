"""Navigation at the times of the images."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.mission import NavigationSigma
from ..schemas.navigation import Navigation, Tide

Array = NDArray[np.float64]
Times = NDArray[np.int64]

# A gap is longer than ten usual intervals, and than this: slow navigation has long intervals, not gaps.
GAP_S = 10.0
_GAP_INTERVALS = 10

_PERIODIC = {"longitude", "roll", "heading"}
SIGMAS = ("horizontal", "depth", "roll", "pitch", "heading")
_COLUMNS = {"horizontal": ("latitude", "longitude")}  # of a sigma, where it is not the one of its name


# What a vehicle may do in a gap of its navigation: sigma a second from the nearest sample, and at most (m, degrees)
_UNSEEN = {
    "horizontal": (0.3, 50.0),
    "depth": (0.05, 2.0),
    "roll": (1.0, 3.0),
    "pitch": (1.0, 3.0),
    "heading": (15.0, 90.0),
}


class Poses(NamedTuple):
    """Navigation of (N,) images; NaN outside the navigation.

    Attributes
    ----------
    values : longitude, latitude, elevation, altitude, roll, pitch, heading (degrees, metres) and sigma_*, (N,).
    span : first and last time (ns) with a full pose.
    in_gap : (N,) the image was taken in a gap of the navigation.
    """

    values: dict[str, Array]
    span: tuple[int, int]
    in_gap: NDArray[np.bool_]


def at_times(navigation: Navigation, ns: Times, offset_s: float, sigma: NavigationSigma, tide: Tide | None) -> Poses:
    """Interpolate navigation linearly; angles along the shorter way round.

    Parameters
    ----------
    navigation : samples; each column is interpolated over the samples that have a value in it.
    ns : (N,) int64 times of the images, nanoseconds since 1970 UTC.
    offset_s : seconds added to navigation times (not to the tide's).
    sigma : 1-sigma where navigation has no value for it.
    tide : height of the sea surface to add to -depth, or None.

    Returns
    -------
    Poses; altitude is NaN also where the altimeter had no return for longer than a gap, as an altitude
    interpolated over that would be invented.
    """
    times = navigation.ns + round(offset_s * 1e9)
    first, last = span(navigation, offset_s)
    inside = (ns >= first) & (ns <= last)
    named = {name: getattr(navigation, name) for name in ("longitude", "latitude", "roll", "pitch", "heading")}
    values = {name: _interpolate(times, column, ns, name in _PERIODIC) for name, column in named.items()}
    values["heading"] %= 360
    values["elevation"] = -_interpolate(times, navigation.depth, ns, False)
    if tide is not None:
        values["elevation"] += _interpolate(tide.ns, tide.height, ns, False)
    values["altitude"] = _altitude(times, navigation.altitude, ns)
    for name in SIGMAS:
        usual = getattr(sigma, name)
        column = navigation.sigma.get(name, np.full(len(times), usual))
        values[f"sigma_{name}"] = _interpolate(times, np.where(np.isfinite(column), column, usual), ns, False)
    values = {name: np.where(inside, column, np.nan) for name, column in values.items()}
    in_gap = np.zeros(len(ns), bool)
    for name, (rate, most) in _UNSEEN.items():
        columns = [getattr(navigation, column) for column in _COLUMNS.get(name, (name,))]
        measured = times[np.isfinite(columns).all(0)]
        gap = inside & _in_gap(measured, ns)
        unseen = np.minimum(rate * _to_nearest_s(measured, ns), most) * gap
        values[f"sigma_{name}"] = np.hypot(values[f"sigma_{name}"], unseen)
        in_gap |= gap
    return Poses(values, (first, last), in_gap)


def _to_nearest_s(times: Times, at: Times) -> Array:
    """Seconds from each of the times `at` to the nearest sample."""
    if not len(times):
        return np.zeros(len(at))
    after = np.clip(np.searchsorted(times, at), 1, max(1, len(times) - 1))
    nearest = np.minimum(np.abs(at - times[after - 1]), np.abs(times[np.minimum(after, len(times) - 1)] - at))
    return nearest * 1e-9


def span(navigation: Navigation, offset_s: float) -> tuple[int, int]:
    """First and last time (ns, offset applied) between which every part of a pose has samples on both sides."""
    first, last = -(2**62), 2**62
    for name in ("latitude", "longitude", "depth", "roll", "pitch", "heading"):
        valid = navigation.ns[np.isfinite(getattr(navigation, name))]
        if not len(valid):
            return 0, -1
        first, last = max(first, int(valid[0])), min(last, int(valid[-1]))
    shift = round(offset_s * 1e9)
    return first + shift, last + shift


def _seconds(times: Times, origin: int) -> Array:
    """Float seconds from an origin near by: nanoseconds since 1970 have too many digits for a float."""
    return np.asarray((times - origin) * 1e-9, np.float64)


def _interpolate(times: Times, values: Array, at: Times, periodic: bool) -> Array:
    """Linear over the valid samples, held constant beyond them; angles of a period of 360 degrees unwrapped."""
    valid = np.isfinite(values)
    if not valid.any():
        return np.full(len(at), np.nan)
    known = np.unwrap(values[valid], period=360) if periodic else values[valid]
    found = np.interp(_seconds(at, times[0]), _seconds(times[valid], times[0]), known)
    return (found + 180) % 360 - 180 if periodic else found


def _altitude(times: Times, altitude: Array, at: Times) -> Array:
    valid = np.isfinite(altitude)
    found = _interpolate(times, altitude, at, False)
    if valid.any():
        beyond = (at < times[valid][0]) | (at > times[valid][-1])
        found[beyond | _in_gap(times[valid], at)] = np.nan
    return found


def _in_gap(times: Times, at: Times) -> NDArray[np.bool_]:
    """Which of the times `at` fall between two samples that are too far apart."""
    if len(times) < 2:
        return np.zeros(len(at), bool)
    intervals = np.diff(times) * 1e-9
    longest = max(GAP_S, _GAP_INTERVALS * float(np.median(intervals)))
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(intervals) - 1)
    return (intervals[before] > longest) & (at > times[before]) & (at < times[before + 1])


def smoothed(navigation: Navigation, window_s: float, level_floor: bool = False) -> Navigation:
    """Navigation whose depth, altitude, roll and pitch are replaced by local parabolas over +-window_s.

    Noise from sample to sample averages out; the slow motion of a vehicle stays. Where a window has fewer than six
    samples they are left as they are.

    Parameters
    ----------
    window_s : half of the window, seconds; a third of the shortest period of the vehicle's motion does no harm.
    level_floor : the sum of depth and altitude hardly changes, and its local mean is better than a parabola.
    """
    time = _seconds(navigation.ns, int(navigation.ns[0]) if len(navigation.ns) else 0)
    columns = {name: _local(time, getattr(navigation, name), window_s, 2) for name in ("depth", "roll", "pitch")}
    if level_floor:
        floor = _local(time, navigation.depth + navigation.altitude, window_s, 0)
        columns["altitude"] = np.maximum(floor - columns["depth"], 0)
    else:
        columns["altitude"] = _local(time, navigation.altitude, window_s, 2)
    return navigation._replace(**columns)


def _local(time: Array, values: Array, window_s: float, degree: int) -> Array:
    """The middle of a polynomial fitted to the samples around each one."""
    known = np.isfinite(values)
    found, t, y = values.copy(), time[known], values[known]
    first, last = np.searchsorted(t, t - window_s), np.searchsorted(t, t + window_s, side="right")
    result = y.copy()
    for k in np.flatnonzero(last - first >= 6):
        own = slice(first[k], last[k])
        powers = ((t[own] - t[k]) / window_s)[:, None] ** np.arange(degree + 1)
        result[k] = np.linalg.lstsq(powers, y[own], rcond=None)[0][0]
    found[known] = result
    return found
