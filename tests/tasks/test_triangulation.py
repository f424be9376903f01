"""Triangulation (paper III.D) and the whole way from an image to soundings."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from seamosaic.schemas.calibration import Camera, CrossGeometry, Laser, LaserPlane, Port
from seamosaic.schemas.parameters import LaserParameters
from seamosaic.tasks import laser
from seamosaic.tasks import triangulation as tri
from seamosaic.tasks.camera import project

SIZE = {"width": 1200, "height": 900, "fx": 1560.0, "fy": 1561.0, "cx": 602.0, "cy": 447.0}
CAMERAS = {
    "brown": Camera(model="brown", distortion=(-0.05, 0.02, 0.0004, -0.0003, 0.0), **SIZE),
    "fisheye": Camera(model="fisheye", distortion=(0.02, -0.01, 0.003, 0.0), **SIZE),
    "flat-port": Camera(model="flat-port", port=Port(distance=0.035, thickness=0.012), **SIZE),
}
LIGHT = Laser(origin=(1.2, 0, 0), planes=CrossGeometry(baseline=1.2, angle=25))
PARAMETERS = LaserParameters()


def on_sheet(sheet: LaserPlane, y: float, z: float) -> np.ndarray:
    nx, ny, nz = sheet.normal
    return np.array([[(sheet.offset - ny * y - nz * z) / nx, y, z]])


@pytest.mark.parametrize("model", CAMERAS)
@settings(deadline=None, max_examples=40)
@given(arm=st.integers(0, 1), y=st.floats(-0.8, 0.8), z=st.floats(0.6, 6.0))
def test_a_point_on_a_sheet_comes_back(model: str, arm: int, y: float, z: float):
    camera, X = CAMERAS[model], on_sheet(LIGHT.sheets[arm], y, z)
    if np.abs(X[0, :2] / z).max() > 0.5:
        return
    found = tri.triangulate(camera, LIGHT, project(camera, X), np.array([arm]), np.array([0.3]))
    np.testing.assert_allclose(found.X_camera, X, atol=2e-6)
    assert found.arm.tolist() == [arm]


@pytest.mark.parametrize("model", CAMERAS)
def test_sigma_is_the_scatter_that_column_noise_makes(model: str):
    camera, rng = CAMERAS[model], np.random.default_rng(0)
    X = on_sheet(LIGHT.sheets[0], 0.2, 3.0)
    uv = np.repeat(project(camera, X), 4000, axis=0)
    uv[:, 0] += rng.normal(0, 0.4, len(uv))
    found = tri.triangulate(camera, LIGHT, uv, np.zeros(len(uv)), np.full(len(uv), 0.4))
    scatter = np.linalg.norm(found.X_camera, axis=1).std()
    assert 0.95 < scatter / found.sigma_m.mean() < 1.05
    # dZ/du = Z^2 / (f d): 4.8 mm a pixel at 3 m here; less along the ray only by the geometry of the port
    assert 1.2e-3 < scatter < 2.6e-3


def test_rays_that_meet_no_sheet_are_not_in_front():
    X, distance = tri.intersect(CAMERAS["brown"], LIGHT.sheets[0], np.array([[602.0, 447.0], [-9e3, 447.0]]))
    assert X[0, 2] == pytest.approx(1.2 / np.tan(np.radians(25)))
    assert distance[1] < 0
    parallel = LaserPlane(name="p", normal=(0.6, 0.8, 0.0), offset=1.0)
    assert np.isinf(tri.intersect(CAMERAS["brown"], parallel, np.array([[602.0, 447.0]]))[1]).all()


def soundings_at(Z: np.ndarray) -> tri.Soundings:
    n = len(Z)
    X = np.column_stack([np.zeros((n, 2)), Z])
    return tri.Soundings(np.zeros((n, 2)), np.zeros(n, np.uint8), X, np.full(n, 1e-3))


def test_histogram_rejects_strays_and_keeps_a_box_and_a_steep_face():
    ground, top, face = np.full(700, 2.93), np.full(150, 2.71), np.linspace(2.71, 2.93, 12)
    stray, window = np.array([2.05, 3.61, 3.62]), np.array([0.2, 9.0, np.nan, -3.0])
    Z = np.concatenate([ground, top, face, stray, window])
    keep = tri.reject_outliers(soundings_at(Z), PARAMETERS)
    assert keep[: 700 + 150 + 12].all()
    assert not keep[700 + 150 + 12 :].any()
    lenient = PARAMETERS.model_copy(update={"histogram_min_share": 0.0, "range_max_m": 10.0})
    assert tri.reject_outliers(soundings_at(Z), lenient).sum() == len(Z) - 3
    wide = PARAMETERS.model_copy(update={"histogram_bin_m": 1.0})
    assert tri.reject_outliers(soundings_at(Z), wide)[-7:-4].all()
    assert len(tri.reject_outliers(tri.no_soundings(), PARAMETERS)) == 0


def cross_image(camera: Camera, depth: float, ground: float, noise: float = 3.0, seed: int = 0) -> np.ndarray:
    """The cross on a level bottom, as lines between projected points; a strobe-lit bottom of a given grey level."""
    rng, y = np.random.default_rng(seed), np.linspace(-1.2, 1.2, 400)
    fine = 8
    light = np.zeros((camera.height, camera.width), np.float32)
    for sheet in LIGHT.sheets:
        X = np.concatenate([on_sheet(sheet, value, depth) for value in y])
        uv = project(camera, X)
        for v in range(camera.height):
            u = np.interp(v, *uv[np.argsort(uv[:, 1])].T[::-1])
            reach = np.arange(max(0, int(u) - 14), min(camera.width, int(u) + 16))
            light[v, reach] += np.exp(-0.5 * ((reach - u) / 2.7) ** 2)
    image = ground * np.array([0.95, 1.0, 0.6]) + 110 * light[..., None] * np.array([0.25, 1.0, 0.2])
    patches = cv2.resize(rng.normal(0, 0.12 * ground, (900 // fine, 1200 // fine)), (1200, 900))
    image = image + patches[..., None] * np.array([0.95, 1.0, 0.6]) + rng.normal(0, noise, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("model", "ground"), [("brown", 110.0), ("brown", 5.0), ("flat-port", 90.0)])
def test_depth_of_a_level_bottom(model: str, ground: float):
    camera = CAMERAS[model]
    image = cross_image(camera, 2.9, ground)
    found = tri.sound(image, camera, LIGHT, PARAMETERS)
    error = found.soundings.X_camera[:, 2] - 2.9
    assert found.reason == ""
    assert len(error) > 1500
    assert abs(np.mean(error)) < 0.3e-3
    assert 0.1e-3 < np.std(error) < 2e-3
    assert np.abs(error).max() < 0.02
    assert 0.6 < np.std(error / found.soundings.sigma_m) < 1.6
    erased = laser.mask(image.shape[:2], found.line_uv, found.halfwidth_px)
    clean = cross_image(camera, 2.9, ground, noise=0.0)
    dark = np.abs(clean[..., 1] - ground) > 0
    assert erased.mean() < 0.09
    excess = clean[..., 1].astype(float) - clean[..., 2] / 0.6
    assert np.percentile(excess[~erased & dark], 99.9) < 6


def test_reasons_are_given_where_there_are_no_soundings():
    camera = CAMERAS["brown"]
    black = tri.sound(np.zeros((900, 1200, 3), np.uint8), camera, LIGHT, PARAMETERS)
    assert black.reason == "no laser found"
    assert len(black.soundings.uv) == 0
    image = cross_image(camera, 2.9, 60.0)
    elsewhere = PARAMETERS.model_copy(update={"range_min_m": 5.0, "range_max_m": 6.0})
    outside = tri.sound(image, camera, LIGHT, elsewhere)
    assert outside.reason == "no laser found"
    paper = tri.sound(image, camera, LIGHT, elsewhere.model_copy(update={"method": "paper"}))
    assert paper.reason.startswith("no laser cross found")
    assert len(paper.soundings.uv) == len(outside.soundings.uv) == 0
    demanding = PARAMETERS.model_copy(update={"min_soundings": 5000})
    assert tri.sound(image, camera, LIGHT, demanding).reason == "no laser found"


@pytest.mark.parametrize(
    ("method", "change"),
    [
        ("sheets", {"min_soundings": 5000}),
        ("paper", {"min_soundings": 5000}),
        ("paper", {"range_min_m": 5.0, "range_max_m": 6.0}),
    ],
)
def test_light_that_gives_no_soundings_is_erased_all_the_same(method: str, change: dict):
    camera, parameters = CAMERAS["brown"], PARAMETERS.model_copy(update={"method": method})
    image = cross_image(camera, 2.9, 60.0)
    usual = tri.sound(image, camera, LIGHT, parameters)
    none = tri.sound(image, camera, LIGHT, parameters.model_copy(update=change))
    assert none.reason != ""
    assert none.agreement is None
    assert len(none.soundings.uv) == 0
    erased, as_usual = (laser.mask(image.shape[:2], found.line_uv, found.halfwidth_px) for found in (none, usual))
    assert (erased & as_usual).sum() > 0.9 * as_usual.sum()


@pytest.mark.parametrize("turned_mm", [-15.0, 0.0, 15.0])
def test_arms_agree_unless_the_calibration_is_wrong(turned_mm: float):
    camera = CAMERAS["brown"]
    image = cross_image(camera, 2.9, 60.0)
    first, second = LIGHT.sheets
    wrong = second.model_copy(update={"offset": second.offset + turned_mm / 1000})
    found = tri.sound(image, camera, LIGHT.model_copy(update={"planes": (first, wrong)}), PARAMETERS)
    assert found.agreement is not None
    gap, sigma = found.agreement
    # rays meet a sheet that is farther away so much farther out
    expected = 2.9 * turned_mm / 1000 / second.offset
    assert 0 < sigma < 0.5e-3
    assert abs(gap - expected) < 5 * sigma + 0.5e-3
    one = found.soundings.take(found.soundings.arm == 0)
    assert tri.agreement(one) is None
    assert tri.agreement(tri.no_soundings()) is None


def test_parameters_of_the_sheets_method_matter():
    camera = CAMERAS["brown"]
    image = cross_image(camera, 2.9, 110.0, noise=25.0)

    def sounded(**change) -> tri.ImageSoundings:
        return tri.sound(image, camera, LIGHT, PARAMETERS.model_copy(update=change))

    usual = sounded().soundings
    assert len(usual.uv) > 1000
    assert len(sounded(peak_sigmas=20.0).soundings.uv) < 0.5 * len(usual.uv)
    assert not np.array_equal(sounded(gamma=1.0).soundings.uv, usual.uv)
    assert not np.array_equal(sounded(method="paper").soundings.uv, usual.uv)
    assert len(sounded(chain_min_points=1000).soundings.uv) == 0
