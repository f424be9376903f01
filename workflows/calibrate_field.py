"""`seamosaic calibrate field`: from an ordinary mission's own crossovers."""

from typing import NamedTuple

import numpy as np

from ..schemas.calibration import Calibration, Laser, Mount
from ..schemas.parameters import Parameters
from ..schemas.problems import InvalidInput, Problem
from ..tasks import calibration_crossovers as crossovers
from ..tasks import calibration_field as field
from ..tasks.calibration_sheets import as_plane, cast_rays
from ..tasks.camera import normalised, rays
from . import calibrate_inputs as inputs
from .job import log

_ROUNDS = 3
_MATCHES_A_PAIR = 15
_MIN_CROSSINGS = 12


class Measured(NamedTuple):
    """What was measured once: matches and navigation."""

    survey: inputs.Survey
    track: field.Track
    matches: field.Matches
    feet: tuple[np.ndarray, np.ndarray]
    range_m: float


class FieldOutcome(NamedTuple):
    """The last round: its problem and result, and the median range in metres."""

    problem: field.FieldProblem
    result: field.FieldResult
    range_m: float


def calibrate_field(
    url: str, start: Calibration | None, priors: field.FieldPriors, parameters: Parameters, images: int
) -> FieldOutcome:
    """Estimate sheets, mount and clock: detect, adjust, tell arms apart again with what was found, in turns.

    Raises
    ------
    InvalidInput
        The mission cannot be used, or its images hardly overlap.
    """
    survey = inputs.open_survey(url, start, laser_only=False, level_floor=False)
    survey = survey._replace(rows=_together(survey, images))
    found = inputs.matches(survey, parameters)
    made = Measured(survey, inputs.track(survey, parameters), found, inputs.altimeter(survey), _range(survey))
    calibration = survey.opened.calibration
    starts = field.field_starts(calibration)
    x = np.zeros(field.layout(priors, made.track).scale.size)
    sigma, outcome, problem = np.ones(len(field.GROUPS)), None, None
    for turn in range(_ROUNDS):
        points = inputs.soundings(survey, _calibration(calibration, starts, x), parameters)
        problem = _problem(made, calibration, priors, points, x)._replace(sigma=sigma)
        if len(problem.crossings.f) < _MIN_CROSSINGS:
            remedy = "Use a mission with more overlap, or another way of calibrating."
            found_ = f"{len(problem.crossings.f)} crossovers of laser lines"
            raise InvalidInput([Problem(url, None, "images", found_, f"at least {_MIN_CROSSINGS}", remedy)])
        outcome = field.adjust_field(problem, x, rounds=2 if turn < _ROUNDS - 1 else 3)
        x, sigma = outcome.x, outcome.sigma
        rms = 1e3 * float(np.sqrt(np.mean(outcome.crossing_m[outcome.used] ** 2)))
        log.info("step=calibrate round=%d crossovers=%d rms_mm=%.2f", turn + 1, len(outcome.crossing_m), rms)
    assert outcome is not None
    assert problem is not None
    return FieldOutcome(problem, outcome, made.range_m)


def _together(survey: inputs.Survey, most: int) -> np.ndarray:
    """The images nearest to the middle of the mission, by time: they overlap with each other."""
    prior = survey.made.prior
    assert prior is not None
    C = prior.poses.C_local[survey.rows]
    known = survey.rows[np.isfinite(C).all(1)]
    C = prior.poses.C_local[known]
    apart = np.hypot(*(C - np.median(C, axis=0))[:, :2].T)
    return np.sort(known[np.argsort(apart, kind="stable")[:most]])


def _range(survey: inputs.Survey) -> float:
    return float(np.median(survey.made.range_m[survey.rows]))


def _calibration(start: Calibration, starts: tuple, x: np.ndarray) -> Calibration:
    """The starting calibration with the sheets found so far."""
    assert start.laser is not None
    sheets = field.sheets_of(x, starts)
    first, second = (as_plane(basis.name, sheet) for basis, sheet in zip(starts, sheets, strict=True))
    light = Laser(wavelength_nm=start.laser.wavelength_nm, origin=start.laser.origin, planes=(first, second))
    rotation = tuple(np.array(start.mount.rotation) + np.degrees(x[6:9]))
    mount = Mount(translation=start.mount.translation, rotation=rotation)
    return start.model_copy(update={"laser": light, "mount": mount})


def _problem(
    made: Measured, calibration: Calibration, priors: field.FieldPriors, points: field.Points, x: np.ndarray
) -> field.FieldProblem:
    """Observations by the poses and sheets found so far."""
    camera = calibration.camera
    at = field.posed(x, calibration, priors, made.track)
    sheets = field.sheets_of(x, field.field_starts(calibration))
    X = cast_rays(*rays(camera, points.uv), sheets[points.arm])
    X_local = np.einsum("pij,pj->pi", at.R[points.image], X) + at.C[points.image]
    crossing = crossovers.crossings(points, X_local)
    slopes = [normalised(camera, uv, made.range_m) for uv in (points.uv, made.matches.uv_i, made.matches.uv_j)]
    beside = crossovers.beside_lines(points, made.matches, *slopes)
    kept = crossovers.thinned(made.matches, beside, _MATCHES_A_PAIR)
    m = made.matches
    matches = field.Matches(m.i[kept], m.j[kept], m.uv_i[kept], m.uv_j[kept])
    beside = crossovers.beside_lines(points, matches, slopes[0], slopes[1][kept], slopes[2][kept])
    image, foot = made.feet
    feet = crossovers.feet(points, X_local, at.reference, image, foot)
    return _only_used(
        field.FieldProblem(
            calibration,
            field.field_starts(calibration),
            priors,
            made.track,
            points,
            matches,
            crossing,
            beside,
            feet,
            made.range_m,
            np.ones(len(field.GROUPS)),
        )
    )


def _only_used(p: field.FieldProblem) -> field.FieldProblem:
    """Without the laser points that no observation needs: there are ten times as many."""
    used = np.unique(np.concatenate([p.crossings.p.ravel(), p.crossings.q.ravel(), p.beside.point, p.feet.point]))
    number = np.full(len(p.points.uv), -1, np.intp)
    number[used] = np.arange(len(used))
    return p._replace(
        points=field.Points(p.points.uv[used], p.points.image[used], p.points.arm[used], p.points.sigma_px[used]),
        crossings=p.crossings._replace(p=number[p.crossings.p], q=number[p.crossings.q]),
        beside=p.beside._replace(point=number[p.beside.point]),
        feet=p.feet._replace(point=number[p.feet.point]),
    )
