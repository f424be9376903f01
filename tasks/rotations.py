"""Rotations between the frames of FORMATS ("Frames of reference"); names are target first: R_map_camera."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# Zero mount: camera x = starboard, camera y = aft, camera z = down.
B_VEHICLE_CAMERA: Final[Array] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
# level is north, east, down; local is east, north, up
R_LOCAL_LEVEL: Final[Array] = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def R_level_vehicle(roll_deg: ArrayLike, pitch_deg: ArrayLike, heading_deg: ArrayLike) -> Array:
    """Attitude of the vehicle: Rz(heading) Ry(pitch) Rx(roll), (..., 3, 3).

    Roll is positive starboard down, pitch positive bow up, heading from TRUE north; degrees.
    """
    angles = np.stack(np.broadcast_arrays(heading_deg, pitch_deg, roll_deg), -1).astype(float)
    return Rotation.from_euler("ZYX", angles.reshape(-1, 3), degrees=True).as_matrix().reshape(*angles.shape[:-1], 3, 3)


def R_vehicle_camera(roll_deg: float, pitch_deg: float, yaw_deg: float) -> Array:
    """Mount of the camera: Rz(yaw) Ry(pitch) Rx(roll) B, (3, 3), degrees."""
    return R_level_vehicle(roll_deg, pitch_deg, yaw_deg) @ B_VEHICLE_CAMERA


def quaternion_wxyz(R: Array) -> Array:
    """Unit quaternions (..., 4) as w x y z, w >= 0, of rotation matrices (..., 3, 3)."""
    return (
        Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(canonical=True, scalar_first=True).reshape(*R.shape[:-2], 4)
    )


def angle_between_deg(R_a: Array, R_b: Array) -> float:
    """Angle in degrees of the rotation that takes one (3, 3) attitude to the other."""
    return float(np.degrees(Rotation.from_matrix(R_a.T @ R_b).magnitude()))


def nearest_rotation(M: Array) -> Array:
    """The rotations closest to matrices (..., 3, 3) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(M)
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    return U @ Vt


def quaternion_angle_deg(a_wxyz: Array, b_wxyz: Array) -> float:
    """Angle between the rotations of two unit quaternions, w x y z."""
    a, b = np.asarray(a_wxyz, float), np.asarray(b_wxyz, float)
    near = b if a @ b >= 0 else -b
    return float(np.degrees(4 * np.arctan2(np.linalg.norm(a - near), np.linalg.norm(a + near))))
