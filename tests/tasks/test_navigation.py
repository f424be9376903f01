import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation
from seamosaic.schemas.calibration import Mount
from seamosaic.tasks import navigation, rotations
from seamosaic.tasks.frames import MapFrame
from seamosaic.tasks.navigation import NavigationPrior, Poses, VehicleState

FRAME = MapFrame(pyproj.CRS("EPSG:32632").to_wkt(), 43.0, 6.5)


def _state(heading, roll=0.0, pitch=0.0):
    ones = np.ones(1)
    return VehicleState(6.5 * ones, 43.0 * ones, -12.0 * ones, roll * ones, pitch * ones, heading * ones)


def test_lever_arm_turns_with_the_heading():
    mount = Mount(translation=(0.35, 0.12, 0.25))
    north = navigation.camera_poses(_state(0), mount, FRAME)
    east = navigation.camera_poses(_state(90), mount, FRAME)
    np.testing.assert_allclose(north.C_local[0], [0.12, 0.35, -12.25], atol=1e-6)
    np.testing.assert_allclose(east.C_local[0], [0.35, -0.12, -12.25], atol=1e-6)


def test_camera_looks_down_and_its_top_to_the_bow():
    poses = navigation.camera_poses(_state(90), Mount(), FRAME)
    np.testing.assert_allclose(poses.R_local_camera[0] @ [0, 0, 1], [0, 0, -1], atol=1e-9)
    np.testing.assert_allclose(poses.R_local_camera[0] @ [0, -1, 0], [1, 0, 0], atol=1e-9)  # heading east


@pytest.mark.parametrize("place", [(6.5, 43.0), (6.6, 43.05), (179.99, -77.0), (8.0, 89.0)])
def test_level_is_at_the_vehicle(place):
    """A vehicle that says it is level and heads north does so where it is."""
    frame = MapFrame(FRAME.crs, 89.0 if place[1] > 80 else 43.0, 6.5)
    state = _state(0)._replace(longitude=np.array([place[0]]), latitude=np.array([place[1]]))
    R = navigation.camera_poses(state, Mount(), frame).R_local_camera[0]
    ends = [np.array([place]) + step for step in ([0.0, 0.0], [0.0, 1e-5])]
    south, north, above = (
        frame.local_from_geographic(*at.T, np.array([height]))[0]
        for at, height in ((ends[0], 0.0), (ends[1], 0.0), (ends[0], 1.0))
    )
    np.testing.assert_allclose(R @ [0, 0, -1], above - south, atol=1e-6)
    np.testing.assert_allclose(R @ [0, -1, 0], (north - south) / np.linalg.norm(north - south), atol=1e-6)


def test_first_camera_without_navigation_is_level():
    np.testing.assert_allclose(navigation.first_camera_without_navigation(Mount()), np.diag([1.0, -1, -1]), atol=1e-12)


def _prior(seconds, drift=0.02):
    count, R = len(seconds), rotations.R_LOCAL_LEVEL @ rotations.R_vehicle_camera(0, 0, 0)
    C = np.column_stack([np.arange(count), np.zeros(count), np.zeros(count)])
    return NavigationPrior(
        poses=Poses(np.repeat(R[None], count, 0), C),
        time_s=np.array(seconds, float),
        sigma_horizontal=np.full(count, 0.4),
        sigma_depth=np.full(count, 0.03),
        sigma_attitude=np.radians(np.tile([0.27, 0.27, 0.84], (count, 1))),
        drift_m_per_sqrt_s=drift,
        R_camera_vehicle=rotations.R_vehicle_camera(0, 0, 0).T,
    )


def test_relative_uncertainty_walks_and_is_bounded_by_the_absolute():
    near, far = (navigation.relative(_prior([0, seconds]), 0, 1) for seconds in (4, 1e6))
    sigma_near, sigma_far = (np.sqrt(motion.covariance[3, 3]) for motion in (near, far))
    turned = np.radians(0.84)
    assert abs(sigma_near**2 - (0.04**2 + 2 * 0.04**2 + turned**2 + 1e-6)) < 1e-9
    assert abs(sigma_far**2 - (2 * 0.4**2 + turned**2 + 1e-6)) < 1e-6
    np.testing.assert_allclose(near.t_i_j, [1, 0, 0], atol=1e-12)
    # heading is the rotation about the optical axis
    assert abs(near.covariance[2, 2] - 2 * turned**2) < 1e-9


@pytest.mark.parametrize("turned", [(True, False), (False, True), (True, True)])
def test_a_half_turned_motion_is_that_of_half_turned_cameras(turned):
    prior = _prior([0, 4])
    tilted = Rotation.from_rotvec([[0.02, -0.01, 0.3], [-0.03, 0.02, 0.1]]).as_matrix()
    prior = prior._replace(poses=prior.poses._replace(R_local_camera=prior.poses.R_local_camera @ tilted))
    expected = navigation.relative(navigation.with_half_turns(prior, np.array(turned)), 0, 1)
    found = navigation.with_half_turn(navigation.relative(prior, 0, 1), *turned)
    np.testing.assert_allclose(found.R_i_j, expected.R_i_j, atol=1e-12)
    np.testing.assert_allclose(found.t_i_j, expected.t_i_j, atol=1e-12)
    np.testing.assert_allclose(found.covariance[3:, 3:], expected.covariance[3:, 3:], atol=1e-12)
