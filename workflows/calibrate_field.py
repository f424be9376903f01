"""`seamosaic calibrate field`: from an ordinary mission's own crossovers, and its report."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..schemas.calibration import Calibration, Mount
from ..schemas.parameters import Parameters
from ..schemas.problems import InvalidInput, Problem
from ..tasks import calibration_crossovers as crossovers
from ..tasks import calibration_field as field
from ..tasks.calibration_sheets import altitude_error, as_plane, cast_rays
from ..tasks.camera import normalised, rays
from . import calibrate
from . import calibrate_inputs as inputs
from . import calibration_report as report
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
    return start.model_copy(update={"laser": start.laser.model_copy(update={"planes": (first, second)})})


def _problem(
    made: Measured, calibration: Calibration, priors: field.FieldPriors, points: field.Points, x: np.ndarray
) -> field.FieldProblem:
    """Observations by the poses and sheets found so far."""
    camera = calibration.camera
    at = field.posed(x, calibration, priors, made.track)
    sheets = field.sheets_of(x, field.field_starts(calibration))
    X = cast_rays(*rays(camera, points.uv), sheets[points.arm])
    X_local = np.einsum("pij,pj->pi", at.R[points.image], X) + at.C[points.image]
    m, (image, foot) = made.matches, made.feet
    slopes, x_i, x_j = (normalised(camera, uv, made.range_m) for uv in (points.uv, m.uv_i, m.uv_j))
    beside = crossovers.beside_lines(points, m, slopes, x_i, x_j)
    X_matched, both = field.intersect_matches(m, x_i, x_j, at), np.column_stack([m.i, m.j])
    under = crossovers.feet(X_matched, both, at.reference, image, foot)
    kept = crossovers.thinned(m, beside, under, _MATCHES_A_PAIR)
    matches = field.Matches(m.i[kept], m.j[kept], m.uv_i[kept], m.uv_j[kept])
    return _only_used(
        field.FieldProblem(
            calibration=calibration,
            starts=field.field_starts(calibration),
            priors=priors,
            track=made.track,
            points=points,
            matches=matches,
            crossings=crossovers.crossings(points, X_local),
            beside=crossovers.beside_lines(points, matches, slopes, x_i[kept], x_j[kept]),
            feet=crossovers.feet(X_local, None, at.reference, image, foot),
            feet_matched=under._replace(spot=np.searchsorted(kept, under.spot)),
            range_m=made.range_m,
            sigma=np.ones(len(field.GROUPS)),
        )
    )


def _only_used(p: field.FieldProblem) -> field.FieldProblem:
    """Without the laser points that no observation needs: there are ten times as many."""
    used = np.unique(np.concatenate([p.crossings.p.ravel(), p.crossings.q.ravel(), p.beside.point, p.feet.spot]))
    number = np.full(len(p.points.uv), -1, np.intp)
    number[used] = np.arange(len(used))
    return p._replace(
        points=field.Points(p.points.uv[used], p.points.image[used], p.points.arm[used], p.points.sigma_px[used]),
        crossings=p.crossings._replace(p=number[p.crossings.p], q=number[p.crossings.q]),
        beside=p.beside._replace(point=number[p.beside.point]),
        feet=p.feet._replace(spot=number[p.feet.spot]),
    )


def run_field(
    mission: str,
    out: Path,
    start: Calibration | None,
    priors: field.FieldPriors,
    parameters: Parameters,
    images: int = 60,
) -> calibrate.Written:
    """Calibrate from the crossovers of an ordinary mission.

    Raises
    ------
    InvalidInput
        The mission cannot be used, or its images hardly overlap.
    """
    calibrate.prepare(out)
    outcome = calibrate_field(mission, start, priors, parameters, images)
    found, begun = outcome.result, outcome.problem.calibration
    own = outcome.problem.starts
    sheets = calibrate.Sheets(own, found.sheets, found.shared[:6], found.covariance[:6, :6], found.prior_sigma[:6])
    mount = Mount(translation=begun.mount.translation, rotation=tuple(found.mount_deg.tolist()))
    result = begun.model_copy(
        update={
            "laser": calibrate.with_sheets(begun, sheets),
            "mount": mount,
            "covariance": calibrate.sheets_and_mount(begun, sheets, found.covariance, calibrate.MOUNT),
        }
    )
    page = _field_page(mission, outcome.problem, found, sheets, result, priors, outcome.range_m)
    return calibrate.write(out, result, page)


def _field_rows(begun: Calibration, found: field.FieldResult, sheets: calibrate.Sheets) -> list[report.Row]:
    sigma, prior = np.sqrt(np.diag(found.covariance)), found.prior_sigma
    rows = calibrate.sheet_rows(sheets)
    for k, name in enumerate(calibrate.MOUNT):
        s, p = (float(np.degrees(v[6 + k])) for v in (sigma, prior))
        rows.append(report.Row(f"mount {name}", "deg", float(found.mount_deg[k]), s, begun.mount.rotation[k], p))
    rows.append(report.Row("time offset to add", "s", found.clock_s, float(sigma[9]), 0.0, float(prior[9])))
    return rows


def _field_page(
    mission: str,
    problem: field.FieldProblem,
    found: field.FieldResult,
    sheets: calibrate.Sheets,
    result: Calibration,
    priors: field.FieldPriors,
    range_m: float,
) -> report.Page:
    camera = result.camera
    rows = _field_rows(problem.calibration, found, sheets)
    shown = calibrate.altitudes(0.8 * range_m, 1.2 * range_m)
    said, figures = calibrate.port_parts(result, shown)
    first = problem.points.arm[problem.crossings.p[:, 0]]
    names = [f"sheet {s.name}" for s in problem.starts]
    lit = found.used
    heights = 1e3 * found.crossing_m
    residuals = report.residual_map(
        found.crossing_uv[lit], heights[lit], (camera.width, camera.height), first[lit], names, "mm"
    )
    facts = (
        ("Mission", mission),
        ("Images", f"{len(problem.track.time_s)}"),
        ("Crossovers of laser lines", f"{found.counts['crossover']}"),
        ("Their height differences, rms", f"{np.sqrt(np.mean(heights[lit] ** 2)):.2f} mm"),
        ("Matches beside a line, matches in all", f"{found.counts['beside']}, {found.counts['match']}"),
        ("Altimeter readings over a line or a match", f"{found.counts['altimeter']}"),
    )
    said_clock = (
        f"The navigation's clock: {found.clock_s:+.3f} s is to be added to navigation.time_offset in mission.yaml "
        f"(± {np.sqrt(found.covariance[9, 9]):.3f} s); it is no part of calibration.yaml."
    )
    return report.Page(
        title="Calibration from crossovers",
        way="Where lines of light of different images cross, they have to be at one height.",
        facts=facts,
        rows=tuple(rows),
        statements=(
            calibrate.accuracy_statement(result, sheets, shown),
            *calibrate.verdicts(rows),
            said_clock,
            "Crossovers alone say nothing of the scale: it comes from the altimeter, whose constant error, with the "
            f"lever arm's, was taken as {1e3 * priors.altimeter_m:.2g} mm (1-sigma) and goes into every altitude, and "
            "from the lengths of the track.",
            "Mount angles cannot be told from constant errors of the navigation's roll, pitch and heading; their sigma "
            "includes those as the mission states them.",
            *said,
        ),
        left_out_header=(
            "Left out",
            "crossovers",
            "rms of those left out",
            *(f"change of altitude by {n}" for n in names),
        ),
        left_out=tuple(_field_left_out(problem, found, range_m)),
        pictures=(
            report.picture("Crossovers in the image", residuals, "Height differences, at the first image's line."),
            calibrate.sensitivity_picture(result, sheets, shown),
            *figures,
        ),
    )


def _field_left_out(problem: field.FieldProblem, full: field.FieldResult, range_m: float) -> list[report.LeftOut]:
    """Every second crossover left out, in turn."""
    lines, count = [], len(problem.crossings.f)
    for turn, name in enumerate(("odd", "even")):
        out = np.arange(count) % 2 == turn
        c = problem.crossings
        kept = field.Crossings(c.p[~out], c.q[~out], c.f[~out], c.g[~out])
        found = field.adjust_field(problem._replace(crossings=kept, sigma=full.sigma), full.x, rounds=1)
        off = field.heights_with(problem, found.x)[out & full.used]
        change = [altitude_error(problem.calibration.camera, full.sheets[s], found.sheets[s], range_m) for s in (0, 1)]
        rms = f"{1e3 * np.sqrt(np.mean(off**2)):.2f} mm"
        lines.append(report.LeftOut(name, (f"{out.sum()}", rms, *(f"{1e3 * c:+.2f} mm" for c in change))))
    return lines
