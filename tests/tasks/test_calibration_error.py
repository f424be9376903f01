import numpy as np
import pytest
from seamosaic.schemas.calibration import Laser, LaserPlane
from seamosaic.tasks.calibration_error import common_error, common_sigma
from seamosaic.tasks.calibration_sheets import basis as sheet_basis
from seamosaic.tasks.calibration_sheets import block, sheet_names, step_jacobian
from seamosaic.tasks.triangulation import intersect

from tests.tasks.calibration_scenes import calibration

CAMERA = ("camera.fx", "camera.fy", "camera.cx", "camera.cy", "camera.distortion.k1")


def covariance(true, turn_deg=0.02, shift_m=0.001):
    """Of both sheets, as `calibrate` writes it: turns and a shift each."""
    J = np.zeros((8, 6))
    for s, sheet in enumerate(true.laser.sheets):
        J[4 * s : 4 * s + 4, 3 * s : 3 * s + 3] = step_jacobian(sheet_basis(sheet, true.laser.origin), np.zeros(3))
    steps = np.diag([np.radians(turn_deg), np.radians(turn_deg), shift_m] * 2) ** 2
    return block([*sheet_names("a"), *sheet_names("b")], J @ steps @ J.T)


def pixels(true, arm):
    """Pixels (30, 2) of a sheet on a level floor 3 m away, and their distances."""
    sheet = true.laser.sheets[arm]
    uv = np.column_stack([np.zeros(30), np.linspace(200, 700, 30)])
    u = np.linspace(0, 1215, 600)
    for k, v in enumerate(uv[:, 1]):
        depth = intersect(true.camera, sheet, np.column_stack([u, np.full(600, v)]))[0][:, 2]
        uv[k, 0] = u[np.nanargmin(np.abs(depth - 3))]
    return uv, intersect(true.camera, sheet, uv)[1]


@pytest.mark.parametrize("port", [False, True])
def test_sigma_is_that_of_many_calibrations(port: bool):
    true, rng = calibration(port), np.random.default_rng(0)
    assert true.laser is not None
    stated = covariance(true)
    error = common_error(true.camera, true.laser, [stated])
    assert error is not None
    root = np.linalg.cholesky(np.array(stated.matrix) + 1e-16 * np.eye(8))
    for arm in (0, 1):
        uv, distance = pixels(true, arm)
        moved = []
        for _ in range(400):
            d = (root @ rng.normal(size=8))[4 * arm : 4 * arm + 4]
            sheet = true.laser.sheets[arm]
            normal = np.array(sheet.normal) + d[:3]
            length = float(np.linalg.norm(normal))
            other = LaserPlane(name="x", normal=tuple(normal / length), offset=(sheet.offset + d[3]) / length)
            moved.append(intersect(true.camera, other, uv)[1] - distance)
        expected = np.std(moved, axis=0)
        found = common_sigma(error, uv, np.full(30, arm), distance)
        assert expected.min() > 0.001
        assert np.all((found / expected > 0.85) & (found / expected < 1.15))


def test_camera_parameters_count():
    true = calibration()
    sigma = np.array([2.0, 2.0, 1.0, 1.0, 0.002])
    error = common_error(true.camera, true.laser, [block(CAMERA, np.diag(sigma**2))])
    assert error is not None
    uv, distance = pixels(true, 0)
    found = common_sigma(error, uv, np.zeros(30, int), distance)
    parts = []
    for name, s in zip(CAMERA, sigma, strict=True):
        part = name.rpartition(".")[2]
        changed = {"distortion": (s, 0, 0, 0, 0)} if part == "k1" else {part: getattr(true.camera, part) + s}
        other = true.camera.model_copy(update=changed)
        parts.append(intersect(other, true.laser.sheets[0], uv)[1] - distance)
    expected = np.sqrt((np.array(parts) ** 2).sum(0))
    assert found == pytest.approx(expected, rel=0.05)


def test_nothing_stated_is_nothing_added():
    true = calibration()
    light = Laser(origin=true.laser.origin, planes=true.laser.planes)
    assert common_error(true.camera, light, []) is None
    assert common_error(true.camera, light, [block(["mount.rotation.roll"], np.eye(1))]) is None


def test_a_covariance_of_what_is_not_there_says_nothing():
    true = calibration()
    assert true.laser is not None
    other = block(["laser.planes.left.offset", "camera.k1"], np.eye(2))
    assert common_error(true.camera, true.laser, [other]) is None
    named = true.model_copy(update={"covariance": (other, block(["laser.planes.a.offset", *CAMERA], np.eye(6)))})
    assert named.unknown_parameters == ["laser.planes.left.offset", "camera.k1"]
