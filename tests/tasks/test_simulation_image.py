"""The physics of simulated photographs: each effect alone, against its law."""

import numpy as np
import pytest
from seamosaic.schemas.calibration import Camera, CrossGeometry, Laser
from seamosaic.schemas.scene import LaserScene, LightScene, SensorScene, TerrainScene
from seamosaic.tasks import simulation_terrain as st
from seamosaic.tasks.simulation_image import Optics, World, render
from seamosaic.tasks.simulation_laser import make_view
from seamosaic.tasks.simulation_navigation import Cameras

DOWN = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]) @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
CAMERA = Camera(model="brown", width=160, height=120, fx=208, fy=208, cx=79.5, cy=59.5)
LASER = Laser(origin=(1.2, 0.0, 0.0), planes=CrossGeometry(baseline=1.2, angle=25.0))
DARK = {"strobe": 0.0, "ambient": 0.0, "falloff": False, "attenuation_per_m": (0, 0, 0), "backscatter": (0, 0, 0)}
CLEAN = {"read_noise": 0.0, "full_well": 0.0, "gamma": 1.0}
NOMINAL_M = 2.0


def photograph(
    role: str = "combined", range_m: float = NOMINAL_M, light=None, sensor=None, laser=None, seed: int = 0
) -> np.ndarray:
    """An image (H, W, 3), 0..1, of a grey plane straight below."""
    terrain = st.make_terrain(TerrainScene(kind="plane", depth_m=10), 3.0, np.random.default_rng(0))
    world = World(terrain, st.normals(terrain), np.full((60, 60, 3), 102, np.uint8), LASER, NOMINAL_M)
    optics = Optics(
        LaserScene.model_validate({"speckle": 0.0, "brightness": 0.0} | (laser or {})),
        LightScene.model_validate(DARK | (light or {})),
        SensorScene.model_validate(CLEAN | (sensor or {})),
    )
    pose = Cameras(DOWN[None], np.array([[0, 0, range_m - 10.0]]))
    return render(world, make_view(CAMERA), pose, optics, role, np.random.default_rng(seed)).astype(float) / 255  # type: ignore[arg-type]


def middle(image: np.ndarray) -> np.ndarray:
    return image[58:62, 78:82].mean(axis=(0, 1))


def test_everything_off_is_black():
    assert photograph().max() == 0


def test_the_strobe_gives_its_level_at_nominal_altitude():
    assert middle(photograph(light={"strobe": 0.4})) == pytest.approx([0.4] * 3, abs=0.005)
    assert photograph("laser", light={"strobe": 0.4}).max() == 0
    assert middle(photograph("laser", light={"ambient": 0.2})) == pytest.approx([0.2] * 3, abs=0.005)


def test_strobe_light_falls_with_the_square_of_range():
    light = {"strobe": 0.3, "falloff": True, "strobe_position_m": (0, 0, 0)}
    near, far = (middle(photograph(range_m=r, light=light))[1] for r in (1.5, 3.0))
    assert near / far == pytest.approx(4.0, rel=0.03)
    image = photograph(light=light)[..., 1]
    # a corner is farther by 1 / cos, and lit aslant: cos cubed
    cosine = 1 / np.hypot(1, np.hypot(79.5, 59.5) / 208)
    assert image[0, 0] / image[60, 80] == pytest.approx(cosine**3, rel=0.04)


def test_water_takes_each_colour_by_its_own_law():
    light = {"strobe": 0.4, "attenuation_per_m": (0.3, 0.05, 0.1), "strobe_position_m": (0, 0, 0)}
    red, green, blue = middle(photograph(light=light))
    assert green == pytest.approx(0.4, abs=0.005)
    assert red / green == pytest.approx(np.exp(-0.25 * 2 * NOMINAL_M), rel=0.04)
    assert blue / green == pytest.approx(np.exp(-0.05 * 2 * NOMINAL_M), rel=0.03)


def test_backscatter_builds_up_with_range():
    light = {"strobe": 0.4, "backscatter": (0.0, 0.5, 1.0), "backscatter_per_m": 0.3}
    red, green, blue = middle(photograph(range_m=3.0, light=light))
    veil = 0.4 * (1 - np.exp(-0.3 * 3.0))
    assert red == pytest.approx(0.4, abs=0.005)
    assert green - red == pytest.approx(0.5 * veil, abs=0.006)
    assert blue - red == pytest.approx(veil, abs=0.006)


def test_the_laser_is_green_and_in_images_with_laser_only():
    assert photograph("texture", laser={"brightness": 0.8}).max() == 0
    image = photograph("laser", laser={"brightness": 0.8})
    assert 0.7 < image[..., 1].max() <= 1
    assert image[..., 0].sum() < 0.2 * image[..., 1].sum()
    assert 0.01 < (image[..., 1] > 0.2).mean() < 0.12


def test_speckle_has_its_contrast():
    smooth, grainy = (photograph("laser", laser={"brightness": 0.5, "speckle": s})[..., 1] for s in (0.0, 0.2))
    line = smooth > 0.3
    ratio = grainy[line] / smooth[line]
    assert ratio.mean() == pytest.approx(1.0, abs=0.04)
    assert 0.16 < ratio.std() < 0.24


def test_noise_has_its_size():
    light = {"strobe": 0.4}
    read = photograph(light=light, sensor={"read_noise": 0.02})[..., 0]
    shot = photograph(light=light, sensor={"full_well": 1000.0})[..., 0]
    assert read.std() == pytest.approx(0.02, rel=0.05)
    assert shot.std() == pytest.approx(np.sqrt(0.4 / 1000), rel=0.05)
    assert shot.mean() == pytest.approx(0.4, abs=0.003)


def test_gamma_and_saturation():
    assert middle(photograph(light={"strobe": 0.2}, sensor={"gamma": 2.2})) == pytest.approx(
        [0.2 ** (1 / 2.2)] * 3, abs=0.005
    )
    assert photograph(range_m=0.5, light={"strobe": 1.0, "falloff": True}).max() == 1


def test_seed_decides_noise():
    a, b, c = (photograph(light={"strobe": 0.4}, sensor={"read_noise": 0.02}, seed=s) for s in (1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)
