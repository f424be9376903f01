import numpy as np
from seamosaic.tasks.calibration_refraction import brown_in_water, pinhole_error
from seamosaic.tasks.camera import project

from tests.tasks.calibration_scenes import calibration


def test_brown_camera_fits_a_port_at_its_distance_only():
    camera = calibration(port=True).camera
    fitted = brown_in_water(camera, 2.5)
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 9), np.linspace(-0.5, 0.5, 7))
    off = []
    for range_m in (2.5, 1.2):
        X = np.column_stack([x.ravel() * range_m / 2.5, y.ravel() * range_m / 2.5, np.full(x.size, range_m)])
        off.append(np.abs(project(fitted, X) - project(camera, X)).max())
    assert off[0] < 0.2
    assert off[1] > 5 * off[0]


def test_a_pinhole_is_wrong_by_altitude_and_a_thin_port_hardly():
    true = calibration(port=True)
    assert true.laser is not None
    altitudes = np.linspace(1.2, 4.0, 6)
    error = pinhole_error(true.camera, true.laser, altitudes)
    assert np.ptp(error.camera_only_percent) > 0.2
    assert 0.005 < np.abs(error.fitted_percent).max() < 5
    port = true.camera.port.model_copy(update={"distance": 0.0, "thickness": 0.0})
    thin = true.camera.model_copy(update={"port": port})
    assert np.abs(pinhole_error(thin, true.laser, altitudes).camera_only_percent).max() < 0.1
