import numpy as np
from seamosaic.tasks.calibration_refraction import pinhole_error
from seamosaic.tasks.calibration_sheets import altitude_error, sensitivity

from tests.tasks.calibration_scenes import calibration


def test_altitudes_at_which_no_arm_is_in_view_are_not_known_to_nothing():
    true = calibration()
    assert true.laser is not None
    heights = np.linspace(0.2, 2.5, 24)
    lit = np.array(
        [
            [
                np.isfinite(altitude_error(true.camera, np.array([*s.normal, s.offset]), np.zeros(4) + 1e-3, h))
                for h in heights
            ]
            for s in true.laser.sheets
        ]
    )
    sigma = sensitivity(true.camera, true.laser.sheets, heights).sigma_m(1e-6 * np.eye(8))
    assert (np.isfinite(sigma) == lit.any(0)).all()
    assert 0 < lit.any(0).sum() < len(heights)
    assert (sigma[lit.any(0)] > 1e-4).all()


def test_a_port_at_altitudes_at_which_no_arm_is_in_view():
    true = calibration(port=True)
    assert true.laser is not None
    assert np.isnan(pinhole_error(true.camera, true.laser, np.array([0.2, 0.25])).fitted_percent).all()
