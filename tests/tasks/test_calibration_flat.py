import numpy as np
import pytest
from seamosaic.tasks.calibration_flat import Priors, calibrate_flat
from seamosaic.tasks.calibration_sheets import altitude_error, step_jacobian

from tests.tasks.calibration_scenes import calibration, floor, wrong

ALTITUDES = np.repeat([2.0, 2.6, 3.2, 3.8], 4)


def normals(c):
    return [np.array([*sheet.normal, sheet.offset]) for sheet in c.laser.sheets]


def z_scores(found, true):
    """Errors of the sheets' steps in their own sigmas (6,)."""
    z = []
    for s, sheet in enumerate(normals(true)):
        own = slice(3 * s, 3 * s + 3)
        J = step_jacobian(found.starts[s], found.steps[own])
        step = np.linalg.lstsq(J, found.sheets[s] - sheet, rcond=None)[0]
        z.append(step / np.sqrt(np.diag(found.covariance))[own])
    return np.concatenate(z)


@pytest.mark.parametrize("port", [False, True])
def test_recovers_sheets_one_degree_and_20_mm_wrong(port: bool):
    true = calibration(port)
    start = wrong(true)
    found = calibrate_flat(floor(true, ALTITUDES), start, Priors())
    z = z_scores(found, true)
    assert 0.05 < np.abs(z).max() < 2.5
    for s in (0, 1):
        before = abs(altitude_error(true.camera, normals(true)[s], normals(start)[s], 3.5)) / 3.5
        after = abs(altitude_error(true.camera, normals(true)[s], found.sheets[s], 3.5)) / 3.5
        assert before > 0.005
        assert after < 0.001


def test_stated_sigmas_are_those_of_many_surveys():
    true = calibration()
    z = np.array(
        [z_scores(calibrate_flat(floor(true, ALTITUDES, seed), wrong(true), Priors()), true) for seed in range(4)]
    )
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.4


def test_one_altitude_leaves_tilt_and_shift_open_and_says_so():
    true = calibration()
    several = calibrate_flat(floor(true, ALTITUDES), wrong(true), Priors())
    one = calibrate_flat(floor(true, np.full(16, 2.6)), wrong(true), Priors())
    sigma = [np.sqrt(np.diag(found.covariance))[2] for found in (several, one)]
    assert sigma[1] > 3 * sigma[0]


def test_boresight_can_be_held():
    true = calibration()
    data = floor(true, ALTITUDES)
    held = calibrate_flat(data, wrong(true), Priors(), boresight=False)
    assert held.boresight_deg == pytest.approx(true.mount.rotation[:2], abs=1e-3)
    turned = true.model_copy(update={"mount": true.mount.model_copy(update={"rotation": (0.9, -0.6, 0.5)})})
    freed = calibrate_flat(data, turned, Priors())
    assert abs(freed.boresight_deg[0] - 0.4) < 2.5 * np.degrees(np.sqrt(freed.covariance[6, 6]))
    assert np.degrees(np.sqrt(freed.covariance[6, 6])) > 0.03  # what navigation's own bias leaves open


def test_outliers_do_not_move_the_sheets():
    true = calibration()
    data = floor(true, ALTITUDES)
    uv = data.uv.copy()
    uv[::25, 0] += 15
    found = calibrate_flat(data._replace(uv=uv), wrong(true), Priors())
    assert not found.used[::25].any()
    assert found.used.mean() > 0.94
    assert np.abs(z_scores(found, true)).max() < 2.5
