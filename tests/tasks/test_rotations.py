import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from seamosaic.tasks import rotations

ANGLE = st.floats(-180, 180)


@given(ANGLE, st.floats(-89, 89), ANGLE)
def test_attitude_is_a_rotation(roll, pitch, heading):
    R = rotations.R_level_vehicle(roll, pitch, heading)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0


def test_signs_of_the_attitude():
    """FORMATS: heading from north over east, pitch bow up, roll starboard down; level is north, east, down."""
    bow, starboard = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    np.testing.assert_allclose(rotations.R_level_vehicle(0, 0, 90) @ bow, [0, 1, 0], atol=1e-12)
    assert (rotations.R_level_vehicle(0, 10, 0) @ bow)[2] < -0.1
    assert (rotations.R_level_vehicle(10, 0, 0) @ starboard)[2] > 0.1


def test_zero_mount_looks_down_with_the_image_top_to_the_bow():
    R = rotations.R_vehicle_camera(0, 0, 0)
    np.testing.assert_allclose(R @ [0, 0, 1], [0, 0, 1], atol=1e-12)  # optical axis down
    np.testing.assert_allclose(R @ [1, 0, 0], [0, 1, 0], atol=1e-12)  # image right is starboard
    np.testing.assert_allclose(R @ [0, -1, 0], [1, 0, 0], atol=1e-12)  # image top is the bow


def test_level_vehicle_heading_north_maps_image_axes_to_east_and_south():
    R = rotations.R_LOCAL_LEVEL @ rotations.R_level_vehicle(0, 0, 0) @ rotations.R_vehicle_camera(0, 0, 0)
    np.testing.assert_allclose(R, np.diag([1.0, -1.0, -1.0]), atol=1e-12)


@given(ANGLE, st.floats(-89, 89), ANGLE)
def test_quaternions_round_trip(roll, pitch, heading):
    R = rotations.R_level_vehicle(roll, pitch, heading)
    q = rotations.quaternion_wxyz(R)
    assert q[0] >= 0
    np.testing.assert_allclose(Rotation.from_quat(q, scalar_first=True).as_matrix(), R, atol=1e-12)


def test_angle_between_and_nearest_rotation():
    a, b = rotations.R_level_vehicle(0, 0, 10), rotations.R_level_vehicle(0, 0, 25)
    assert abs(rotations.angle_between_deg(a, b) - 15) < 1e-9
    np.testing.assert_allclose(rotations.nearest_rotation(a * 1.01), a, atol=1e-12)
