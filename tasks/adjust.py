"""All poses from pair motions and navigation in one estimate (paper IV and its outlook), solved by GTSAM.

Navigation's errors are modelled as they are: roll and pitch as independent noise, heading as a bias of the whole
track, depth as a bias and noise, horizontal position as one offset (sigma_horizontal) plus a random walk from image to
image. Pair motions enter as relative poses with their covariance under a robust kernel. Without navigation the first
image is the datum and the motions are chained from it (paper IV). `tasks.bundle` takes it from here.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from ..schemas.parameters import AdjustParameters
from . import tree_covariances
from .factors import (
    camera_pose,
    datum,
    elimination_order,
    first_values,
    gaussian,
    navigation_factors,
    optimise,
    pose,
    read_poses,
    robust,
)
from .motion import Motion
from .navigation import NavigationPrior, Poses, relative, with_half_turns
from .residuals import Residuals
from .rotations import angle_between_deg

Array = NDArray[Any]
Status = Literal["adjusted", "navigation", "rejected: no link to the placed images"]

_TURN = np.radians(2.0)
_FAR_DEG = 5.0
_FEW = 1 / 500  # of all images: for so few that pairs found later would join, not all are adjusted again
# what calibration and the pinhole leave in a pair motion, whatever its matches say: 0.01 degree and 1 mm
_LINK_FLOOR = np.diag([np.radians(0.01)] * 3 + [1e-3] * 3) ** 2


class Link(NamedTuple):
    """The motion between images i < j.

    turned : whether either lies the other way round than navigation has it.
    free : whether the images, taken one after the other, contradict navigation with many matches.
    """

    i: int
    j: int
    motion: Motion
    turned: tuple[bool, bool] = (False, False)
    free: bool = False


class Adjusted(NamedTuple):
    """Poses of all images.

    Attributes
    ----------
    poses : cameras in the local frame, NaN where `status` is rejected.
    sigma_m : (n, 3) 1-sigma of the camera centres along the local axes.
    covariance_xy_m2 : (n,) covariance of their x and y, m^2.
    sigma_tilt_rad : (n,) 1-sigma of the angle by which the optical axis may lean, about either image axis.
    status : per image.
    used : (links,) bool, False for links that contradict navigation or each other.
    reprojection_px : rms distance of the tie points from where they are seen; None where none were adjusted.
    turned : (n,) bool, images whose pixels lie the other way round than navigation has them.
    residuals : what tie points and crossovers left; None where none were adjusted.
    """

    poses: Poses
    sigma_m: Array
    covariance_xy_m2: Array
    sigma_tilt_rad: Array
    status: list[Status]
    used: NDArray[np.bool_]
    turned: NDArray[np.bool_]
    reprojection_px: float | None = None
    residuals: Residuals | None = None


def adjust(
    count: int,
    links: list[Link],
    navigation: NavigationPrior | None,
    R_first: Array,
    p: AdjustParameters,
    first: int = 0,
) -> Adjusted:
    """Estimate the poses of `count` images in order of time.

    links must be metric where there is no navigation; with navigation those that are not are scaled by it.
    R_first : R_local_camera (3, 3) of the first image, and first its number where nothing is linked; used without
        navigation only.
    """
    turned = _half_turns(count, links)
    if navigation is not None:
        navigation = with_half_turns(navigation, turned)
        links = [_scaled_by_navigation(link, navigation) for link in links]
    plausible = np.array([_plausible(link, navigation) for link in links], bool)
    usable = [link for link, ok in zip(links, plausible, strict=True) if ok]
    # once with all, then without the links that contradict the rest
    start, graph = _start(count, usable, navigation, R_first, first)
    values = _solve(graph, _within(usable, start), start, p.robust_threshold)
    usable = [link for link in _within(usable, start) if _agrees(link, values)]
    start, graph = _start(count, usable, navigation, R_first, first)
    usable = _within(usable, start)
    values = _solve(graph, usable, start, p.robust_threshold)
    kept = {(link.i, link.j) for link in usable}
    poses = read_poses(values, start)
    covariances = _covariances(_total(graph, usable, p.robust_threshold), values, poses)
    sigma_m, covariance_xy, sigma_tilt = sigmas(covariances, poses, navigation)
    return Adjusted(
        poses=poses,
        sigma_m=sigma_m,
        covariance_xy_m2=covariance_xy,
        sigma_tilt_rad=sigma_tilt,
        status=_status(usable, poses, navigation),
        used=np.array([(link.i, link.j) in kept for link in links], bool),
        turned=turned,
    )


def would_change(
    links: list[Link], poses: Poses, status: Sequence[str], navigation: NavigationPrior, far_m: float
) -> bool:
    """Whether links that came after the adjustment would change it.

    They would where they join images that only navigation places, more than a few of them, or where most of an image's,
    and two at least, contradict its pose: one alone is rather a wrong match, for what lies elsewhere overlaps several
    images there. A contradiction is more than what a few matches across a narrow strip are off by.

    poses, status : of the adjustment. far_m : so far off, or turned by so much, is an image that lies elsewhere.
    """
    adjusted = navigation._replace(poses=poses)
    joined = {k for link in links for k in (link.i, link.j) if status[k] == "navigation"}
    if len(joined) > _FEW * len(status):
        return True
    told, contradicting = np.zeros((2, len(status)), int)
    for link in links:
        between = camera_pose(poses, link.i).between(camera_pose(poses, link.j))
        motion = _scaled_by_navigation(link, adjusted).motion
        off = float(np.linalg.norm(motion.t_i_j - between.translation()))
        elsewhere = off > far_m or angle_between_deg(motion.R_i_j, between.rotation().matrix()) > _FAR_DEG
        told[[link.i, link.j]] += 1
        contradicting[[link.i, link.j]] += elsewhere and not _consistent(motion, between)
    return bool(((contradicting > 1) & (2 * contradicting > told)).any())


def _half_turns(count: int, links: list[Link]) -> NDArray[np.bool_]:
    """Images (n,) of which most matches say that they lie the other way round than navigation has them."""
    votes = np.zeros(count)
    for link in links:
        weight = len(link.motion.inliers)
        votes[[link.i, link.j]] += [weight if turned else -weight for turned in link.turned]
    return votes > 0


def _plausible(link: Link, navigation: NavigationPrior | None) -> bool:
    return link.free or (link.motion.metric if navigation is None else _agrees_with_navigation(link, navigation))


def _start(
    count: int, links: list[Link], navigation: NavigationPrior | None, R_first: Array, first: int
) -> tuple[Poses, Any]:
    """First values of all poses that can have one, and the factors that tie them to the ground."""
    if navigation is not None:
        return navigation.poses, navigation_factors(navigation)
    start = _chain(count, links, R_first, first)
    return start, datum(start, int(np.flatnonzero(start.known)[0]))


def _within(links: list[Link], start: Poses) -> list[Link]:
    known = start.known
    return [link for link in links if known[link.i] and known[link.j]]


def _chain(count: int, links: list[Link], R_first: Array, first: int) -> Poses:
    """Motions chained outwards from the first linked image along the links with most matches (paper IV)."""
    R, C = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    if not links:
        R[first], C[first] = R_first, 0.0
        return Poses(R, C)
    i, j = np.array([[link.i, link.j] for link in links]).T
    weight = np.array([1.0 / len(link.motion.inliers) for link in links])
    by_pair = {(link.i, link.j): link.motion for link in links}
    graph = coo_array((weight, (i, j)), shape=(count, count)).tocsr()
    _, label = connected_components(graph, directed=False)
    root = int(np.flatnonzero(label == np.bincount(label).argmax())[0])
    R[root], C[root] = R_first, 0.0
    order, parent = breadth_first_order(minimum_spanning_tree(graph), root, directed=False)
    for node in order[1:]:
        base = int(parent[node])
        if base < node:
            motion = by_pair[base, int(node)]
            R[node], C[node] = R[base] @ motion.R_i_j, C[base] + R[base] @ motion.t_i_j
        else:
            motion = by_pair[int(node), base]
            R[node] = R[base] @ motion.R_i_j.T
            C[node] = C[base] - R[node] @ motion.t_i_j
    return Poses(R, C)


def _scaled_by_navigation(link: Link, navigation: NavigationPrior) -> Link:
    """A link without laser scale takes the length of navigation's step, and its uncertainty."""
    motion = link.motion
    if motion.metric:
        return link
    prior = relative(navigation, link.i, link.j)
    length = float(np.linalg.norm(prior.t_i_j))
    along = motion.R_i_j.T @ motion.t_i_j
    sigma = float(np.sqrt(along @ prior.covariance[3:, 3:] @ along))
    covariance = motion.covariance.copy()
    covariance[3:] *= length
    covariance[:, 3:] *= length
    covariance[3:, 3:] += np.outer(along, along) * sigma**2
    scaled = motion._replace(t_i_j=motion.t_i_j * length, covariance=covariance, scale_sigma=sigma / max(length, 1e-6))
    return link._replace(motion=scaled)


def _agrees_with_navigation(link: Link, navigation: NavigationPrior) -> bool:
    """Within five sigma of navigation's own motion between the two images: repeated texture makes false links.

    On a turn attitude changes faster than navigation reports it, so some degrees more are let pass.
    """
    prior = relative(navigation, link.i, link.j)
    turn = np.repeat([_TURN, _TURN * float(np.linalg.norm(prior.t_i_j))], 3) ** 2
    covariance = prior.covariance + link.motion.covariance + np.diag(turn)
    return _distance(link.motion, pose(prior.R_i_j, prior.t_i_j), covariance) < 5


def _distance(motion: Motion, other: Any, covariance: Array) -> float:
    """Mahalanobis distance of a motion from another pose of j in i, divided by the root of the six dimensions."""
    off = pose(motion.R_i_j, motion.t_i_j).localCoordinates(other)
    return float(np.sqrt(off @ np.linalg.solve(covariance, off) / 6))


def _total(graph: Any, links: list[Link], threshold: float) -> Any:
    """The factors of graph and those of the links under a robust kernel."""
    total = gtsam.NonlinearFactorGraph(graph)
    for link in links:
        noise = robust(gaussian(link.motion.covariance + _LINK_FLOOR), threshold)
        total.add(gtsam.BetweenFactorPose3(link.i, link.j, pose(link.motion.R_i_j, link.motion.t_i_j), noise))
    return total


def _solve(graph: Any, links: list[Link], start: Poses, threshold: float) -> Any:
    return optimise(_total(graph, links, threshold), first_values(graph, start))


def _agrees(link: Link, values: Any) -> bool:
    """Whether the solution is within six sigma of a link's motion."""
    return _consistent(link.motion, values.atPose3(link.i).between(values.atPose3(link.j)))


def _consistent(motion: Motion, between: Any) -> bool:
    return _distance(motion, between, motion.covariance + _LINK_FLOOR) < 6


def sigmas(covariances: Array, poses: Poses, navigation: NavigationPrior | None) -> tuple[Array, Array, Array]:
    """Sigmas (n, 3) of the camera centres along the local axes, covariance (n,) of x and y, sigma (n,) of the lean.

    covariances : (n, 6, 6) of GTSAM's increments R exp(w), C + R v.
    """
    R = poses.R_local_camera
    local = R @ covariances[:, 3:, 3:] @ R.swapaxes(1, 2)
    position, tilt = np.sqrt(np.einsum("nii->ni", local)), np.sqrt((covariances[:, 0, 0] + covariances[:, 1, 1]) / 2)
    if navigation is not None:  # roll and pitch err by a bias too, which no number of images averages down
        tilt = np.hypot(tilt, navigation.sigma_attitude[:, :2].mean(1))
    return position, local[:, 0, 1], tilt


def _covariances(graph: Any, values: Any, poses: Poses) -> Array:
    """Covariances (n, 6, 6) of the poses, NaN where there is none.

    That a map may move as a whole by decimetres, but its parts by tenths of millimetres, can be too much for Cholesky
    factors; QR bears it, for several times the memory.
    """
    count, linear = len(poses.C_local), graph.linearize(values)
    order = elimination_order(linear)
    try:
        return tree_covariances.covariances(linear.eliminateMultifrontal(order), count, order.at(order.size() - 1)).own
    except RuntimeError:
        p = gtsam.ISAM2Params()
        p.setFactorization("QR")
        marginals = gtsam.ISAM2(p)
        marginals.update(graph, values)
    found = np.full((count, 6, 6), np.nan)
    for k in np.flatnonzero(poses.known).tolist():
        found[k] = marginals.marginalCovariance(k)
    return found


def _status(links: list[Link], poses: Poses, navigation: NavigationPrior | None) -> list[Status]:
    if navigation is None:
        return ["adjusted" if ok else "rejected: no link to the placed images" for ok in poses.known]
    linked = np.zeros(len(poses.C_local), bool)
    for link in links:
        linked[[link.i, link.j]] = True
    return ["adjusted" if ok else "navigation" for ok in linked]
