"""Camera poses from the vehicle's navigation: lever arms, mount angles, true north (FORMATS, "Frames of reference")."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Mount
from .frames import MapFrame
from .rotations import R_LOCAL_LEVEL, R_level_vehicle, R_vehicle_camera

Array = NDArray[Any]

_JITTER = 0.1
_STATED_S = 100.0  # the soonest in which dead reckoning goes wrong by its stated sigma


class Poses(NamedTuple):
    """Cameras in the local frame.

    Attributes
    ----------
    R_local_camera : (n, 3, 3) camera axes to local axes.
    C_local : (n, 3) centres of projection, metres. NaN where a camera has no pose.
    """

    R_local_camera: Array
    C_local: Array

    @property
    def known(self) -> NDArray[np.bool_]:
        """(n,) which cameras have a pose."""
        return np.asarray(np.isfinite(self.C_local).all(1))


class VehicleState(NamedTuple):
    """Navigation at the images' times: (n,) each; degrees, elevation of the reference point in metres."""

    longitude: Array
    latitude: Array
    elevation: Array
    roll: Array
    pitch: Array
    heading: Array


def camera_poses(state: VehicleState, mount: Mount, frame: MapFrame) -> Poses:
    """Poses of the camera by navigation alone; level is at the vehicle, not at the mission's origin."""
    vehicle = frame.local_from_geographic(state.longitude, state.latitude, state.elevation)
    R_local_level = frame.R_local_enu(state.longitude, state.latitude) @ R_LOCAL_LEVEL
    R_local_vehicle = R_local_level @ R_level_vehicle(state.roll, state.pitch, state.heading)
    lever_arm = R_local_vehicle @ np.asarray(mount.translation)
    return Poses(R_local_vehicle @ R_vehicle_camera(*mount.rotation), vehicle + lever_arm)


def first_camera_without_navigation(mount: Mount) -> Array:
    """R_local_camera (3, 3) of the first image of a mission without navigation: a level vehicle heading north."""
    return R_LOCAL_LEVEL @ R_vehicle_camera(*mount.rotation)


class NavigationPrior(NamedTuple):
    """What navigation says of each image.

    Attributes
    ----------
    poses : cameras in the local frame. time_s : (n,) increasing.
    sigma_horizontal, sigma_depth : (n,) metres. sigma_attitude : (n, 3) roll, pitch, heading, radians.
    drift_m_per_sqrt_s : random walk of the horizontal position between images.
    R_camera_vehicle : (3, 3) the mount, to turn attitude errors into the camera's axes.
    """

    poses: Poses
    time_s: Array
    sigma_horizontal: Array
    sigma_depth: Array
    sigma_attitude: Array
    drift_m_per_sqrt_s: float
    R_camera_vehicle: Array


def north_rad(poses: Poses) -> Array:
    """Direction (n,) of north in each image, from u towards v, radians."""
    return np.arctan2(poses.R_local_camera[:, 1, 1], poses.R_local_camera[:, 1, 0])


class RelativePrior(NamedTuple):
    """Navigation's motion between two images, as `motion.Motion` states it.

    covariance (6, 6) is of (rotation, translation) perturbing on the right: R exp(w), t + R v.
    """

    R_i_j: Array
    t_i_j: Array
    covariance: Array


def relative(navigation: NavigationPrior, i: int, j: int) -> RelativePrior:
    """Motion from image i to image j by navigation.

    Attitudes err independently; positions by a random walk that never exceeds their stated sigma; the attitude of
    the first image also turns and tilts the step that is measured in its frame.
    """
    poses = navigation.poses
    R_i, R_j = poses.R_local_camera[i], poses.R_local_camera[j]
    step = poses.C_local[j] - poses.C_local[i]
    attitude = (navigation.sigma_attitude[i] ** 2 + navigation.sigma_attitude[j] ** 2) / 2
    turned = np.sqrt(attitude.max()) * float(np.linalg.norm(step))
    horizontal = walk_m(navigation, i, j) ** 2 + turned**2 + 1e-6
    vertical = navigation.sigma_depth[i] ** 2 + navigation.sigma_depth[j] ** 2 + attitude[:2].max() * (step @ step)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = navigation.R_camera_vehicle @ np.diag(2 * attitude) @ navigation.R_camera_vehicle.T
    covariance[3:, 3:] = R_j.T @ np.diag([horizontal, horizontal, vertical]) @ R_j
    return RelativePrior(R_i.T @ R_j, R_i.T @ step, covariance)


_HALF_TURN = np.diag([-1.0, -1.0, 1.0])


def with_half_turns(navigation: NavigationPrior, turned: NDArray[np.bool_]) -> NavigationPrior:
    """Navigation with the cameras of the images `turned` (n,) turned by half a circle about their optical axes.

    Picture viewers turn photographs, and some vehicles fly a line with the camera looking backwards: then pixels lie
    the other way round than mount and heading say.
    """
    R = navigation.poses.R_local_camera.copy()
    R[turned] = R[turned] @ _HALF_TURN
    return navigation._replace(poses=navigation.poses._replace(R_local_camera=R))


def with_half_turn(prior: RelativePrior, i: bool, j: bool) -> RelativePrior:
    """A motion with the camera of image i, of image j or of both turned by half a circle about its optical axis."""
    D_i, D_j = (_HALF_TURN if turned else np.eye(3) for turned in (i, j))
    both = np.kron(np.eye(2), D_j)
    return RelativePrior(D_i @ prior.R_i_j @ D_j, D_i @ prior.t_i_j, both @ prior.covariance @ both)


def walk_m(navigation: NavigationPrior, i: int, j: int) -> float:
    """1-sigma along either horizontal axis of navigation's step between two images, metres.

    Dead reckoning walks; each position jitters besides, by a share of its stated sigma, which is what a satellite or
    acoustic fix does most. Never more than the stated sigmas say, nor so fast that the walk has passed them within
    a minute or two: a good navigation drifts less.
    """
    elapsed = abs(float(navigation.time_s[j] - navigation.time_s[i]))
    sigmas = navigation.sigma_horizontal[[i, j]]
    stated, drift = np.hypot(*sigmas), min(navigation.drift_m_per_sqrt_s, sigmas.max() / np.sqrt(_STATED_S))
    return float(min(np.hypot(drift * np.sqrt(elapsed), _JITTER * stated), stated))
