"""The simulated laser cross and its exact line."""

import numpy as np
import pytest
from seamosaic.schemas.calibration import Camera, CrossGeometry, Laser
from seamosaic.schemas.scene import SCENES, TerrainScene
from seamosaic.tasks import simulation_terrain as st
from seamosaic.tasks.camera import project
from seamosaic.tasks.rotations import R_LOCAL_LEVEL, R_level_vehicle, R_vehicle_camera
from seamosaic.tasks.simulation_laser import laser_truth, make_view, sheet_light
from seamosaic.tasks.simulation_navigation import Cameras

LASER = Laser(origin=(1.2, 0.0, 0.0), planes=CrossGeometry(baseline=1.2, angle=25.0))
ALTITUDE_M = 2.5
PORT = {"distance": 0.035, "thickness": 0.012}


def camera(model: str = "brown") -> Camera:
    measures = {"width": 320, "height": 240, "fx": 417.0, "fy": 417.5, "cx": 161.0, "cy": 118.0}
    more = {"port": PORT} if model == "flat-port" else {"distortion": (-0.05, 0.02, 0, 0)}
    return Camera.model_validate({"model": model, **measures, **more})


def pose(roll: float = 2.0, pitch: float = -1.5, heading: float = 30.0, east_m: float = 0.1) -> Cameras:
    R = R_LOCAL_LEVEL @ R_level_vehicle(roll, pitch, heading) @ R_vehicle_camera(0, 0, 0)
    return Cameras(R[None], np.array([[east_m, 0.2, ALTITUDE_M - 15.0]]))


def seabed(kind: str, seed: int = 1) -> st.Terrain:
    scene = SCENES["reef"].terrain if kind == "rough" else TerrainScene.model_validate({"kind": kind, "depth_m": 15.0})
    return st.make_terrain(scene, 2.5, np.random.default_rng(seed))


@pytest.mark.parametrize("model", ["brown", "fisheye", "flat-port"])
def test_the_line_is_on_sheet_seabed_and_row(model: str):
    terrain, at, rows = seabed("rough"), pose(), np.arange(5, 240, 17)
    line = laser_truth(terrain, camera(model), LASER.sheets, LASER.origin, at, rows)
    assert {0, 1} == set(line.arm)
    assert len(line.row) > 1.5 * len(rows)
    for arm, sheet in enumerate(LASER.sheets):
        X = line.X_camera[line.arm == arm]
        assert abs(X @ sheet.normal - sheet.offset).max() < 5e-4
        assert np.median(abs(X @ sheet.normal - sheet.offset)) < 1e-5
    X = line.X_camera @ at.R_local_camera[0].T + at.C_local[0]
    assert np.percentile(abs(X[:, 2] - st.height(terrain, X[:, 0], X[:, 1])), 95) < 1e-4
    assert project(camera(model), line.X_camera) == pytest.approx(np.column_stack([line.u, line.row]), abs=2e-3)
    assert np.ptp(X[:, 2]) > 0.05


def test_on_level_ground_arms_image_at_42_degrees():
    """DESIGN, "What the geometry says": Z = d / (x ± y / cos alpha + tan alpha)."""
    flat = Camera(model="brown", width=320, height=240, fx=417, fy=417, cx=159.5, cy=119.5)
    level = pose(0, 0, 0)
    line = laser_truth(seabed("plane"), flat, LASER.sheets, LASER.origin, level)
    x, y = (line.u - 159.5) / 417, (line.row - 119.5) / 417
    alpha = np.radians(25)
    sign = np.where(line.arm == 0, 1, -1) * np.sign(LASER.sheets[0].normal[0] * LASER.sheets[0].normal[1])
    assert 1.2 / (x + sign * y / np.cos(alpha) + np.tan(alpha)) == pytest.approx(np.full(len(x), ALTITUDE_M), abs=1e-4)
    for arm in (0, 1):
        slope = np.polyfit(line.u[line.arm == arm], line.row[line.arm == arm], 1)[0]
        assert abs(np.degrees(np.arctan(slope))) == pytest.approx(42.2, abs=0.1)


def test_a_box_breaks_and_shades_the_line():
    """Paper III.C: relief moves the line along image rows; the lit wall is hidden from the camera."""
    at, rows = pose(0, 0, 0, east_m=-0.1), np.arange(0, 240, 3)
    flat, box = (laser_truth(seabed(kind), camera(), LASER.sheets, LASER.origin, at, rows) for kind in ("plane", "box"))
    assert 0.85 * len(flat.row) < len(box.row) < 0.98 * len(flat.row)
    common = [(r, a) for r, a in zip(box.row, box.arm, strict=True) if r in flat.row[flat.arm == a]]
    moved = [
        box.u[(box.row == r) & (box.arm == a)].max() - flat.u[(flat.row == r) & (flat.arm == a)][0] for r, a in common
    ]
    # a rise of 225 mm moves the line by f d / Z² dZ = 417 * 1.2 * (1 / 2.275 - 1 / 2.5) pixels
    assert np.max(moved) == pytest.approx(417 * 1.2 * (1 / 2.275 - 1 / 2.5), rel=0.1)
    assert np.median(moved) == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("width_px", [1.2, 2.5])
def test_the_line_is_as_wide_as_asked(width_px: float):
    view, at = make_view(camera()), pose()
    R, C = at.R_local_camera[0], at.C_local[0]
    s = st.cast_image(seabed("plane"), view.origin @ R.T + C, view.direction @ R.T)
    pixels, light = sheet_light(view, s, LASER.sheets[0], R[2], width_px)
    image = np.zeros(240 * 320)
    image[pixels] = light
    row = image.reshape(240, 320)[60]
    u = np.arange(320)
    centre = (row * u).sum() / row.sum()
    along_row = np.sqrt((row * (u - centre) ** 2).sum() / row.sum())
    # at some 42 degrees to the rows
    assert along_row == pytest.approx(width_px / np.sin(np.radians(42.2)), rel=0.08)
    # the sampled peak: at most half a pixel off the middle
    assert np.exp(-0.5 * (0.5 * np.sin(np.radians(42.2)) / width_px) ** 2) - 0.01 < row.max() <= 1
