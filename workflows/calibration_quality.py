"""What a run can say of the calibration that it was given."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from ..schemas.products import CalibrationQuality
from ..tasks.calibration_error import CommonError, common_error, common_sigma
from ..tasks.calibration_refraction import pinhole_error
from . import extract
from .job import Job, load
from .results import Results

_SAMPLED: Final = 60  # images
_LEAST_IMAGES: Final = 5
_ALARM_SIGMAS: Final = 3.0
_ALARM_SHARE: Final = 5e-4  # of the range: what a tenth of a pixel of bias in one arm makes, with some to spare
_LEAST_PORT_SHARE: Final = 0.75  # altitudes shown for a flat port, about the median range


def of_calibration(job: Job) -> CommonError | None:
    """The error that all soundings of a mission have in common, or None if the calibration does not state it."""
    calibration = job.calibration
    return calibration.laser and common_error(calibration.camera, calibration.laser, calibration.covariance)


def soundings_sigma(error: CommonError | None, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """1-sigma (N,) along the ray, metres, that an image's soundings have in common."""
    X = arrays["laser_X"]
    if error is None:
        return np.zeros(len(X))
    return common_sigma(error, arrays["laser_uv"], arrays["laser_arm"], np.linalg.norm(X, axis=1))


def median_sigma(results: Results) -> float | None:
    """Median of what the soundings have in common, metres: the uncertainty that no averaging takes from the maps."""
    error = of_calibration(results.job)
    lit = [done for done in results.posed.extracted.values() if done.info["soundings"]]
    if error is None or not lit:
        return None
    chosen = lit[:: -(-len(lit) // _SAMPLED)]
    names = ("laser_X", "laser_uv", "laser_arm")
    parts = [soundings_sigma(error, dict(load(results.job, extract.STEP, done.key, names).arrays)) for done in chosen]
    return float(np.median(np.concatenate(parts)))


def measured(results: Results) -> CalibrationQuality | None:
    """The calibration's part of quality.json; None without a laser."""
    laser, camera = results.opened.calibration.laser, results.opened.calibration.camera
    if laser is None:
        return None
    gap, sigma, count = _gap(results)
    percent = None
    ranges = _ranges(results)
    if camera.port is not None and len(ranges):
        shown = float(np.median(ranges)) * np.linspace(_LEAST_PORT_SHARE, 1 / _LEAST_PORT_SHARE, 5)
        error = pinhole_error(camera, laser, shown).fitted_percent
        percent = float(error[np.nanargmax(np.abs(error))]) if np.isfinite(error).any() else None
    return CalibrationQuality(
        sigma_m=median_sigma(results),
        laser_gap_m=gap,
        laser_gap_sigma_m=sigma,
        laser_gap_images=count,
        pinhole_percent=percent,
    )


def doubts(found: CalibrationQuality | None, range_m: float | None) -> Iterator[str]:
    """What the figures give reason to doubt."""
    if found is None or found.laser_gap_m is None or found.laser_gap_sigma_m is None or range_m is None:
        return
    gap, sigma = found.laser_gap_m, found.laser_gap_sigma_m
    if abs(gap) > max(_ALARM_SIGMAS * sigma, _ALARM_SHARE * range_m):
        yield (
            f"the two laser sheets disagree where they meet: arm b has the seabed {1e3 * abs(gap):.1f} mm "
            f"{'deeper' if gap > 0 else 'higher'} than arm a (1-sigma {1e3 * sigma:.1f} mm, "
            f"{found.laser_gap_images} images): calibrate the sheets anew"
        )


def typical_range(results: Results) -> float | None:
    """Median range of the images with soundings, metres."""
    ranges = _ranges(results)
    return float(np.median(ranges)) if len(ranges) else None


def _ranges(results: Results) -> np.ndarray:
    known = [done.info.get("range_m") for done in results.posed.extracted.values()]
    return np.array([value for value in known if value], float)


def _gap(results: Results) -> tuple[float | None, float | None, int]:
    """Median gap of the sheets, its 1-sigma, metres, and from how many images.

    The sigma is what the images scatter, not what each believes: seabed under the crossing is seldom a plane.
    """
    infos = [done.info for done in results.posed.extracted.values()]
    gaps = np.array([info["laser_gap_m"] for info in infos if info.get("laser_gap_m") is not None], float)
    stated = np.array([info["laser_gap_sigma_m"] for info in infos if info.get("laser_gap_m") is not None], float)
    count = len(gaps)
    if count < _LEAST_IMAGES:
        return None, None, count
    middle = float(np.median(gaps))
    scatter = 1.4826 * float(np.median(np.abs(gaps - middle)))
    # 1.25: a median's sigma over a mean's
    return middle, 1.25 * max(scatter, float(np.median(stated))) / float(np.sqrt(count)), count
