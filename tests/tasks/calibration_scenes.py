"""A camera, a cross and a vehicle over a flat floor or before a board, as exact geometry without pictures."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from seamosaic.schemas.calibration import Calibration, Camera, CrossGeometry, Laser, Mount, Port
from seamosaic.tasks.calibration_flat import FlatData
from seamosaic.tasks.calibration_sheets import as_plane, basis, moved
from seamosaic.tasks.camera import project
from seamosaic.tasks.rotations import R_LOCAL_LEVEL, R_level_vehicle, R_vehicle_camera

Array = NDArray[np.float64]


def calibration(port: bool = False) -> Calibration:
    """A cross 1.2 m beside a camera of 1216 x 912 pixels."""
    model = {"model": "flat-port", "port": Port(distance=0.035, thickness=0.012)} if port else {"model": "brown"}
    focal = 1190.0 if port else 1584.0
    camera = Camera.model_validate(
        {**model, "width": 1216, "height": 912, "fx": focal, "fy": focal, "cx": 611.0, "cy": 451.0}
    )
    laser = Laser(origin=(1.2, 0.0, 0.0), planes=CrossGeometry(baseline=1.2, angle=25, roll=45))
    mount = Mount(translation=(0.35, 0.12, 0.25), rotation=(0.4, -0.6, 0.5))
    explicit = laser.model_copy(update={"planes": laser.sheets})
    return Calibration(format=1, camera=camera, laser=explicit, mount=mount)


def wrong(true: Calibration, degrees: float = 1.0, metres: float = 0.02, seed: int = 0) -> Calibration:
    """Each sheet turned about its emitter in some direction, and shifted."""
    assert true.laser is not None
    rng, planes = np.random.default_rng(seed), []
    for sheet in true.laser.sheets:
        direction, side = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0])
        turn = np.radians(degrees) * np.array([np.cos(direction), np.sin(direction)])
        start = basis(sheet, true.laser.origin)
        planes.append(as_plane(sheet.name, moved(start, np.append(turn, side * metres))))
    return true.model_copy(update={"laser": true.laser.model_copy(update={"planes": tuple(planes)})})


def floor(true: Calibration, altitudes: Array, seed: int = 0, noise: float = 1.0) -> FlatData:
    """Lines of light on a level floor at elevation -5 m, with navigation that errs as stated, times `noise`."""
    assert true.laser is not None
    rng, n = np.random.default_rng(seed), len(altitudes)
    heading = np.where(np.arange(n) % 2, 200.0, 20.0)
    tilt = rng.normal(0, 1.0, (n, 2))
    R = R_LOCAL_LEVEL @ R_level_vehicle(tilt[:, 0], tilt[:, 1], heading)
    R_camera = R @ R_vehicle_camera(*true.mount.rotation)
    X = np.column_stack([rng.uniform(-3, 3, (n, 2)), altitudes - 5])
    C = X + R @ np.asarray(true.mount.translation)
    parts = []
    for k in range(n):
        for arm, sheet in enumerate(true.laser.sheets):
            line = _on_floor(R_camera[k], C[k], np.array([*sheet.normal, sheet.offset]), -5.0)
            uv = project(true.camera, line)
            seen = ((uv > 0) & (uv < [1215, 911])).all(1)
            parts.append((uv[seen], np.full(seen.sum(), k), np.full(seen.sum(), arm, np.int8)))
    uv, image, arm = (np.concatenate(field) for field in zip(*parts, strict=True))
    uv = uv + noise * np.column_stack([rng.normal(0, 0.2, len(uv)), np.zeros(len(uv))])
    bias, white = noise * np.radians(0.05) * rng.normal(size=2), noise * np.radians(0.015) * rng.normal(size=(n, 2))
    error = np.degrees(bias + white)
    said = R @ R_level_vehicle(error[:, 0], error[:, 1], np.zeros(n))
    depth = X + noise * np.column_stack([np.zeros((n, 2)), 0.01 * rng.normal() + 0.003 * rng.normal(size=n)])
    altitude = altitudes + noise * 0.005 * rng.normal(size=n)
    sigma = np.full(n, 0.01), np.full(n, np.radians(0.052))
    return FlatData(uv, image, arm, np.full(len(uv), 0.2), said, depth, altitude, np.zeros(n, int), *sigma)


def _on_floor(R: Array, C: Array, sheet: Array, elevation: float) -> Array:
    """Points (40, 3), camera frame, where a sheet meets a level floor."""
    floor_normal = R[2]
    floor_offset = elevation - C[2]
    direction = np.cross(sheet[:3], floor_normal)
    direction /= np.linalg.norm(direction)
    A = np.stack([sheet[:3], floor_normal, direction])
    point = np.linalg.solve(A, [sheet[3], floor_offset, 0.0])
    point = point - direction * point[1] / direction[1]
    return point + np.linspace(-2, 2, 40)[:, None] * direction


def board_poses(count: int, seed: int = 0) -> tuple[Array, Array]:
    """R_camera_board (n, 3, 3) and t (n, 3): a board 1.4 to 3 m away, tilted by up to 30 degrees."""
    rng = np.random.default_rng(seed)
    R = Rotation.from_euler("xyz", rng.uniform(-30, 30, (count, 3)), degrees=True).as_matrix()
    range_m = np.linspace(1.4, 3.0, count)
    shift = rng.uniform(-0.12, 0.12, (count, 2)) * range_m[:, None]
    return R, np.column_stack([shift, range_m])
