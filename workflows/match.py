"""Per pair: matches and the metric motion between two images (paper III.E)."""

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from ..catalog.store import Entry
from ..tasks import camera, features, guided, motion, pairs
from ..tasks.adjust import Link
from ..tasks.navigation import NavigationPrior, Poses, RelativePrior, relative, with_half_turn
from ..tasks.rotations import angle_between_deg
from . import extract
from .job import Done, Job, Made, code_version, load, once, rounded_digest, stage

STEP = "match"
VERSION = code_version(sys.modules[__name__])


NEAR_SHARE = 0.05  # of the range: so far off is every relative position held possible


class Lit(NamedTuple):
    """A laser image taken beside a texture image: its row and its camera's pose in the texture image's camera."""

    row: int
    step: RelativePrior


class Wanted(NamedTuple):
    """Two images to match, i < j, rows of the frames table.

    range_m : height above the seabed where the laser does not tell. lit_i, lit_j : rows of laser images that sound for
    either. next : whether j was taken right after i, so that they overlap whatever navigation says.
    free : whether the adjustment contradicts navigation here, and stands for it. turned : which of the two it has the
    other way round than navigation.
    """

    i: int
    j: int
    range_m: float
    lit_i: tuple[int, ...] = ()
    lit_j: tuple[int, ...] = ()
    next: bool = False
    free: bool = False
    turned: tuple[bool, bool] = (False, False)

    @property
    def rows(self) -> tuple[int, ...]:
        """Every image whose extraction the pair needs."""
        return (self.i, self.j, *self.lit_i, *self.lit_j)


class PairTask(NamedTuple):
    """Two images to match, with what navigation, or what stands for it, believes of them.

    poses : of these two images. prior : of their motion. margin_m : how far their relative position may be wrong.
    lit_i, lit_j : laser images that sound for either.
    """

    wanted: Wanted
    poses: Poses | None
    prior: RelativePrior | None
    margin_m: float
    lit_i: tuple[Lit, ...] = ()
    lit_j: tuple[Lit, ...] = ()


def believed(wanted: Wanted, prior: NavigationPrior | None) -> PairTask:
    """What navigation believes of a pair; without navigation nothing."""
    if prior is None:
        return PairTask(wanted, None, None, 0.0)
    step = relative(prior, wanted.i, wanted.j)
    both = [wanted.i, wanted.j]
    poses = Poses(prior.poses.R_local_camera[both], prior.poses.C_local[both])
    lit_i, lit_j = (
        tuple(Lit(row, relative(prior, k, row)) for row in rows)
        for k, rows in zip(both, (wanted.lit_i, wanted.lit_j), strict=True)
    )
    return PairTask(wanted, poses, step, margin_m(step, wanted.range_m), lit_i, lit_j)


def margin_m(step: RelativePrior, range_m: float) -> float:
    """How far the relative position of two images may be wrong, metres."""
    return 2 * float(np.sqrt(step.covariance[3:, 3:].trace())) + NEAR_SHARE * range_m


Carried = tuple[tuple[Entry, RelativePrior], ...]
PairSoundings = tuple[tuple[np.ndarray, float], tuple[np.ndarray, float]]
_HALF_TURNS = (True, True), (False, True), (True, False)
_READ = "feature_uv", "feature_descriptors", "laser_X"  # of an extraction
_ALIKE_DEG = 20.0
_ALIKE_COSINE = 0.7
# strongest features that are asked whether navigation is wrong, of images taken one after the other and of others
_OF_NEXT, _OF_OTHERS = 1500, 700


def match_batch(
    job: Job, batch: Sequence[Wanted], extracted: Mapping[int, Done], prior: NavigationPrior | None
) -> list[tuple[int, int, Done]]:
    """Match some pairs.

    extracted : maps rows to their extraction. prior : navigation, or the poses that stand for it.
    """
    cv2.setNumThreads(1)
    prior = prior and _copied(prior)
    loaded: dict[int, Entry] = {}

    def entry(row: int) -> Entry:
        if row not in loaded:
            loaded[row] = load(job, extract.STEP, extracted[row].key, _READ)
        return loaded[row]

    found = []
    for wanted in batch:
        if any(extracted[row].info["status"] for row in (wanted.i, wanted.j)):
            done = Done(STEP, "", False, 0.0, {"model": "", "matches": 0, "inliers": 0})
        else:
            wanted = _readable(wanted, extracted)
            keys = [extracted[row].key for row in wanted.rows]
            done = _match(job, believed(wanted, prior), keys, entry)
        found.append((wanted.i, wanted.j, done))
        for row in [row for row in loaded if row < min(wanted.rows)]:
            del loaded[row]
    return found


def _copied(prior: NavigationPrior) -> NavigationPrior:
    """In plain order and aligned: the last bits of a product depend on that, and a transfer may change it."""
    poses = Poses(*(np.array(values, order="C") for values in prior.poses))
    fields = {name: np.array(v, order="C") for name, v in prior._asdict().items() if isinstance(v, np.ndarray)}
    return prior._replace(**fields, poses=poses)


def _readable(wanted: Wanted, extracted: Mapping[int, Done]) -> Wanted:
    """The pair without laser images that could not be read."""
    lit_i, lit_j = (
        tuple(row for row in side if row in extracted and not extracted[row].info["status"])
        for side in (wanted.lit_i, wanted.lit_j)
    )
    return wanted._replace(lit_i=lit_i, lit_j=lit_j)


def _match(job: Job, pair: PairTask, keys: Sequence[str], entry: Callable[[int], Entry]) -> Done:
    steps = [pair.poses, pair.prior, *(lit.step for lit in (*pair.lit_i, *pair.lit_j))]
    known = [rounded_digest(*step) for step in steps if step]
    wanted = pair.wanted
    parameters = [
        *stage(job.calibration.camera, job.parameters.match),
        round(wanted.range_m, 6),
        round(pair.margin_m, 6),
        len(pair.lit_i),
        wanted.next,
        wanted.free,
        wanted.turned,
    ]

    def make() -> Made:
        lit_i, lit_j = (tuple((entry(lit.row), lit.step) for lit in side) for side in (pair.lit_i, pair.lit_j))
        return between(job, pair, entry(wanted.i), entry(wanted.j), (lit_i, lit_j))

    return once(job, STEP, VERSION, [*keys, *known], parameters, make)


def between(job: Job, pair: PairTask, a: Entry, b: Entry, carried: tuple[Carried, Carried] = ((), ())) -> Made:
    """Motion between two extracted images; their laser may be left out, which leaves its length open.

    carried : entries of the laser images that sound for either, with navigation's step to them.
    """
    if "feature_uv" not in a.arrays or "feature_uv" not in b.arrays:
        return Made({}, {"model": "", "matches": 0, "inliers": 0})
    if pair.wanted.turned[0] != pair.wanted.turned[1]:
        b = _half_turned(b)
    lit = [entry.info["range_m"] for entry, _ in (*carried[0], *carried[1])]
    ranges = [range_m for range_m in (a.info["range_m"], b.info["range_m"]) if range_m] or [r for r in lit if r]
    at = float(np.mean(ranges)) if ranges else pair.wanted.range_m
    matched = _matches(job, a, b) if pair.poses is None else _expected(job, pair, pair.poses, a, b, at)
    soundings = _soundings(a, carried[0]), _soundings(b, carried[1])
    found, turned, free = _estimate(job, pair.prior, matched, soundings, at), (False, False), False
    if pair.prior is not None and _weak(found, matched):
        every = _either_way(job, *(_strongest(each, _OF_NEXT if pair.wanted.next else _OF_OTHERS) for each in (a, b)))
        needed = 2 * max(len(found.inliers) if found else 0, job.parameters.match.min_inliers)
        if len(every.features) > 3 * needed:  # fewer are chance
            best, turned, free = _against_navigation(job, pair, every, needed, soundings, at)
            found, matched = (found, matched) if best is None else (best, every)
    count = len(matched.features)
    if found is None:
        return Made({}, {"model": "", "matches": count, "inliers": 0})
    alike = _half_turned(b) if turned[0] != turned[1] else b
    agreed = _guided(job, found, matched.features[found.inliers], a, alike, at)
    return Made(
        {
            "R": found.R_i_j,
            "t": found.t_i_j,
            "covariance": found.covariance,
            "uv_i": a.arrays["feature_uv"][agreed[:, 0]],
            "uv_j": b.arrays["feature_uv"][agreed[:, 1]],
            "features": agreed.astype(np.int32),
        },
        {
            "model": found.model,
            "metric": found.metric,
            "scale_sigma": found.scale_sigma if found.metric else None,
            "matches": count,
            "inliers": len(agreed),
            "turned": [now != before for now, before in zip(turned, pair.wanted.turned, strict=True)],
            "free": free or (pair.wanted.free and found.metric),
        },
    )


class Matched(NamedTuple):
    """Matched features: pixels uv_i, uv_j (M, 2) and the features' numbers (M, 2) in either image."""

    uv_i: np.ndarray
    uv_j: np.ndarray
    features: np.ndarray


def _either_way(job: Job, a: Entry, b: Entry) -> Matched:
    """Matches as navigation has the headings, or with one of the two images the other way round: what gives more."""
    return max((_matches(job, a, each) for each in (b, _half_turned(b))), key=lambda m: len(m.features))


def _strongest(entry: Entry, count: int) -> Entry:
    """The image with its strongest features only."""
    names = "feature_uv", "feature_descriptors"
    return entry._replace(arrays={**entry.arrays, **{name: entry.arrays[name][:count] for name in names}})


def _half_turned(entry: Entry) -> Entry:
    """The image with the descriptors that it has if it lies the other way round than navigation says."""
    turned = features.half_turned(entry.arrays["feature_descriptors"])
    return entry._replace(arrays={**entry.arrays, "feature_descriptors": turned})


def _features(entry: Entry) -> features.Features:
    return features.Features(entry.arrays["feature_uv"], entry.arrays["feature_descriptors"])


def _matches(job: Job, a: Entry, b: Entry) -> Matched:
    """Matches wherever in the two images they are."""
    return _named(a, b, features.match(_features(a), _features(b), job.parameters.match.ratio))


def _named(a: Entry, b: Entry, numbers: np.ndarray) -> Matched:
    uv_a, uv_b = (entry.arrays["feature_uv"][n].astype(float) for entry, n in zip((a, b), numbers.T, strict=True))
    return Matched(uv_a, uv_b, numbers)


def _expected(job: Job, pair: PairTask, poses: Poses, a: Entry, b: Entry, range_m: float) -> Matched:
    """Matches that lie where navigation expects them."""
    lens = job.calibration.camera
    margin_px = pair.margin_m / range_m * camera.focal_px(lens, range_m)
    of_a, of_b = _features(a), _features(b)
    uv = [pairs.expected(lens, of.uv.astype(float), poses, k, 1 - k, range_m) for k, of in enumerate((of_a, of_b))]
    seen = [np.flatnonzero(pairs.inside(lens, each, margin_px)) for each in uv]
    part_a, part_b = (features.Features(of.uv[n], of.descriptors[n]) for of, n in zip((of_a, of_b), seen, strict=True))
    expected = features.Expected(uv[0][seen[0]], margin_px)
    found = features.match(part_a, part_b, job.parameters.match.ratio, expected)
    return _named(a, b, np.column_stack([seen[0][found[:, 0]], seen[1][found[:, 1]]]))


def _guided(job: Job, found: motion.Motion, known: np.ndarray, a: Entry, b: Entry, range_m: float) -> np.ndarray:
    """The matches (M, 2) that a motion leads to."""
    lens = job.calibration.camera
    of_a, of_b = _features(a), _features(b)
    x_a, x_b = (camera.normalised(lens, side.uv.astype(float), range_m) for side in (of_a, of_b))
    focal_px = camera.focal_px(lens, range_m)
    return guided.match(of_a, of_b, x_a, x_b, known, found, focal_px)


def _estimate(
    job: Job, prior: RelativePrior | None, matched: Matched, soundings: PairSoundings, range_m: float
) -> motion.Motion | None:
    lens = job.calibration.camera
    focal_px = camera.focal_px(lens, range_m)
    slopes = camera.normalised(lens, matched.uv_i, range_m), camera.normalised(lens, matched.uv_j, range_m)
    (X_a, sigma_a), (X_b, sigma_b) = soundings
    shared = max(sigma_a, sigma_b) / range_m
    return motion.estimate(*slopes, X_a, X_b, focal_px, job.parameters.match, prior, shared)


def _weak(found: motion.Motion | None, matched: Matched) -> bool:
    """Whether most matches disagree with what navigation lets them say."""
    return found is None or len(found.inliers) < 0.5 * len(matched.features)


def _against_navigation(
    job: Job, pair: PairTask, every: Matched, needed: int, soundings: PairSoundings, range_m: float
) -> tuple[motion.Motion | None, tuple[bool, bool], bool]:
    """What matches say if navigation is wrong: believed only if more of them than `needed` agree.

    Either image, or both, may lie the other way round than navigation has it. Two images taken one after the other
    may be anywhere, for navigation jumps and has gaps; then the laser has to tell the length of their motion.

    Returns
    -------
    The motion or None, which images lie the other way round, and whether navigation has no say in it.
    """
    assert pair.prior is not None
    found = _estimate(job, None, every, soundings, range_m)
    if found is not None and len(found.inliers) > needed:
        for turned in ((False, False), *_HALF_TURNS):
            if _alike(found, with_half_turn(pair.prior, *turned)):
                return found, turned, False
        if pair.wanted.next and found.metric:
            return found, (False, False), True
    return None, (False, False), False


def _alike(found: motion.Motion, prior: RelativePrior) -> bool:
    """Whether a motion is roughly one that navigation believes: the same turn, and the same direction."""
    turn = angle_between_deg(found.R_i_j, prior.R_i_j)
    lengths = float(np.linalg.norm(found.t_i_j) * np.linalg.norm(prior.t_i_j))
    return turn < _ALIKE_DEG and float(found.t_i_j @ prior.t_i_j) > _ALIKE_COSINE * lengths


def _soundings(entry: Entry, carried: Carried) -> tuple[np.ndarray, float]:
    """Soundings (L, 3) in the frame of an image, and the sigma, metres, that they share.

    An image without a laser has those of the laser images taken just before and after, carried over by navigation.
    """
    own = entry.arrays.get("laser_X", np.zeros((0, 3)))
    if len(own) or not carried:
        return own, 0.0
    parts = [lit.arrays.get("laser_X", np.zeros((0, 3))) @ step.R_i_j.T + step.t_i_j for lit, step in carried]
    variance = [float(step.covariance[3:, 3:].trace()) / 3 for _, step in carried]
    return np.concatenate(parts), float(np.sqrt(np.mean(variance)))


def link(i: int, j: int, entry: Entry) -> Link:
    """A stored motion as the adjustment takes it."""
    found = motion.Motion(
        R_i_j=entry.arrays["R"],
        t_i_j=entry.arrays["t"],
        covariance=entry.arrays["covariance"],
        inliers=np.arange(entry.info["inliers"]),
        model=entry.info["model"],
        metric=entry.info["metric"],
        scale_sigma=entry.info["scale_sigma"] if entry.info["metric"] else float("nan"),
    )
    turned_i, turned_j = entry.info["turned"]
    return Link(i, j, found, (turned_i, turned_j), entry.info["free"])
