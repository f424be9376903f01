"""Simulated missions: the public format, and images that show what the truth says, where it says."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pyproj
import pytest
import yaml
from seamosaic.schemas.calibration import Calibration
from seamosaic.schemas.mission import Mission
from seamosaic.schemas.problems import InvalidInput
from seamosaic.schemas.scene import SCENES, Scene
from seamosaic.tasks.camera import project
from seamosaic.tasks.frames import MapFrame
from seamosaic.tasks.rotations import R_LOCAL_LEVEL, R_level_vehicle, R_vehicle_camera
from seamosaic.tasks.simulation_texture import blurred, sample
from seamosaic.workflows import simulate as module
from seamosaic.workflows.simulate import simulate

from tests.simulated import Truth, height_of, laser_truth_of, read_truth, small_mission

PERFECT = {"read_noise": 0.0, "full_well": 0.0, "jpeg_quality": 100, "gamma": 1.0}
FLAT_LIGHT = {"falloff": False, "attenuation_per_m": (0, 0, 0), "backscatter": (0, 0, 0), "strobe": 0.4}


@pytest.fixture(scope="module")
def reef(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two images without noise or water, with perfect navigation."""
    folder = tmp_path_factory.mktemp("missions") / "reef"
    quiet = {"laser": {"speckle": 0.0}, "sensor": PERFECT, "light": FLAT_LIGHT, "navigation": {"error_scale": 0.0}}
    return small_mission(folder, images=2, width=400, **quiet)


@pytest.fixture(scope="module")
def truth(reef: Path) -> Truth:
    return read_truth(reef)


def picture(mission: Path, name: str) -> np.ndarray:
    return cv2.imread(str(mission / "images" / name))[..., ::-1].astype(float) / 255


def test_the_folder_is_a_mission(reef: Path, truth: Truth):
    mission = Mission.model_validate(yaml.safe_load((reef / "mission.yaml").read_text()))
    calibration = Calibration.model_validate(yaml.safe_load((reef / "calibration.yaml").read_text()))
    assert mission.navigation is not None
    assert mission.navigation.sigma == SCENES["reef"].navigation.sigma
    assert calibration.laser is not None
    assert calibration.mount.rotation == (0.4, -0.6, 0.5)
    assert sorted(p.name for p in (reef / "images").iterdir()) == list(truth.images)
    assert sorted(p.name for p in reef.iterdir()) == [
        "calibration.yaml",
        "images",
        "mission.yaml",
        "navigation.csv",
        "truth",
    ]
    assert picture(reef, truth.images[0]).shape == (300, 400, 3)
    assert list(reef.parent.iterdir()) == [reef]


def test_every_scene_is_valid_and_has_its_calibration():
    for name, scene in SCENES.items():
        calibration = module.calibration_of(scene)
        assert scene.name == name
        assert calibration.camera.width == scene.width
        assert calibration.laser is not None
        # the cross meets the optical axis where the paper's geometry says, within its mounting errors
        slope = [s.offset / s.normal[2] for s in calibration.laser.sheets]
        assert np.mean(slope) == pytest.approx(scene.laser.baseline_m / np.tan(np.radians(25)), rel=0.05)
    assert SCENES["demo"].images == 24
    assert SCENES["sea"].survey.overlap == 0.3


def test_navigation_leads_to_the_true_cameras(reef: Path, truth: Truth):
    """Position, depth, attitude, lever arm and mount, with the conventions of FORMATS, give the truth's poses."""
    table = pd.read_csv(reef / "navigation.csv", parse_dates=["time"])
    nav_t = table["time"].to_numpy("datetime64[ns]").astype(np.int64) / 1e9
    assert np.diff(nav_t) == pytest.approx(np.full(len(nav_t) - 1, 0.2), abs=1e-5)
    frame, mount = MapFrame(None, 43.0421, 6.0127), truth.calibration.mount
    local = frame.local_from_geographic(*table[["longitude", "latitude"]].to_numpy().T, -table["depth"].to_numpy())
    for k, name in enumerate(truth.images):
        t = np.datetime64(pd.to_datetime(name[2:-4], format="%Y%m%dT%H%M%S.%fZ"), "ns").astype(np.int64) / 1e9
        at = [np.interp(t, nav_t, c) for c in (*local.T, *table[["roll", "pitch", "heading"]].to_numpy().T)]
        R_local_vehicle = R_LOCAL_LEVEL @ R_level_vehicle(*at[3:])
        assert R_local_vehicle @ R_vehicle_camera(*mount.rotation) == pytest.approx(
            truth.poses.R_local_camera[k], abs=2e-4
        )
        assert at[:3] + R_local_vehicle @ mount.translation == pytest.approx(truth.poses.C_local[k], abs=1e-3)
    altitude = table["altitude"].iloc[0]
    assert altitude == pytest.approx(local[0, 2] - height_of(truth, local[:1, 0], local[:1, 1])[0], abs=1e-3)


def test_true_north_is_not_grid_north(reef: Path):
    """At 6 degrees east zone 32's grid is turned by about 2 degrees: headings are true, not grid."""
    frame = MapFrame(pyproj.CRS("EPSG:32632").to_wkt(), 43.0421, 6.0127)
    table = pd.read_csv(reef / "navigation.csv")
    local = frame.local_from_geographic(*table[["longitude", "latitude"]].to_numpy().T, -table["depth"].to_numpy())
    mapped = frame.map_from_local(local)
    courses = []
    for way in (mapped, local):
        east, north = way[-1, :2] - way[0, :2]
        courses.append(np.degrees(np.arctan2(east, north)))
    assert courses[1] == pytest.approx(table["heading"].mean(), abs=2.5)
    assert courses[0] - courses[1] == pytest.approx(2.04, abs=0.05)


def test_the_seabed_is_where_the_truth_says(reef: Path, truth: Truth):
    """Terrain points, projected into an image, show the truth's texture there; and nowhere else."""
    texture = blurred(cv2.imread(str(reef / "truth/texture.jpg"))[..., ::-1].copy(), 1.5 / 400, 2.7 / 521)
    # blue, in which the laser is faint
    rng, image = np.random.default_rng(0), picture(reef, truth.images[0])[..., 2]
    R, C = truth.poses.R_local_camera[0], truth.poses.C_local[0]
    x, y = C[:2, None] + rng.uniform(-0.5, 0.5, (2, 4000))
    X = np.column_stack([x, y, height_of(truth, x, y)])
    uv = project(truth.calibration.camera, (X - C) @ R)
    albedo = sample(texture, truth.terrain.half_m, x[None], y[None])[0, :, 2]
    scores = {}
    for move in (0.0, 2.0, -2.0):
        seen = cv2.remap(image, *(uv.astype(np.float32) + np.float32([move, 0])).T[:, None], cv2.INTER_LINEAR)[0]
        scores[move] = np.corrcoef(seen, albedo)[0, 1]
    assert scores[0.0] > 0.6
    assert max(scores[2.0], scores[-2.0]) < scores[0.0] - 0.1


@pytest.mark.parametrize(
    ("scene", "bias_px", "median_px", "p95_px"), [("plane", 0.005, 0.02, 0.1), ("reef", 0.03, 0.12, 0.4)]
)
def test_the_laser_line_is_where_laser_truth_says(
    tmp_path: Path, scene: str, bias_px: float, median_px: float, p95_px: float
):
    """With noise, colour and water off, the centroid of the line's light is at the truth's middle.

    Over relief as fine as the line is wide (7 mm here) the light's centroid is not quite the sheet's middle.
    """
    quiet = {
        "light": FLAT_LIGHT | {"strobe": 0.0, "ambient": 0.0},
        "laser": {"speckle": 0.0},
        "texture": {"contrast": 0.0, "spots_per_m2": 0.0},
        "sensor": PERFECT,
    }
    mission = small_mission(tmp_path / "m", scene, images=1, width=480, **quiet)
    image = next((mission / "images").iterdir()).name
    green, line = picture(mission, image)[..., 1], laser_truth_of(mission, image)
    errors = []
    for row, u, arm in zip(line.row, line.u, line.arm, strict=True):
        other = line.u[(line.row == row) & (line.arm != arm)]
        if 10 <= u < 470 and abs(other - u).min(initial=99) > 20:
            columns = np.arange(round(u) - 7, round(u) + 8)
            errors.append((green[row, columns] @ columns) / green[row, columns].sum() - u)
    assert len(errors) > 500
    assert abs(np.mean(errors)) < bias_px
    assert np.median(np.abs(errors)) < median_px
    assert np.percentile(np.abs(errors), 95) < p95_px


def test_seed_and_scene_decide_every_byte(tmp_path: Path):
    def content(folder: Path) -> dict[str, bytes]:
        return {
            str(p.relative_to(folder)): p.read_bytes()
            for p in folder.rglob("*")
            if p.suffix in (".jpg", ".yaml", ".csv")
        }

    a, b, c = (
        content(small_mission(tmp_path / name, images=2, width=96, seed=seed))
        for name, seed in zip("abc", (1, 1, 2), strict=True)
    )
    assert a == b
    picture = next(name for name in a if name.startswith("images"))
    assert all(a[name] != c[name] for name in (picture, "navigation.csv", "truth/texture.jpg"))


def test_noise_changes_neither_seabed_nor_way(tmp_path: Path):
    a, b = (
        read_truth(small_mission(tmp_path / str(q), images=1, width=96, sensor={"read_noise": q})) for q in (0.0, 0.1)
    )
    assert np.array_equal(a.terrain.h, b.terrain.h)
    assert np.array_equal(a.poses.C_local, b.poses.C_local)


def test_pool_has_no_navigation_and_pairs_have_two_kinds(tmp_path: Path):
    pool = small_mission(tmp_path / "pool", "pool", images=1, width=96, navigation={"enabled": False})
    assert not (pool / "navigation.csv").exists()
    assert Mission.model_validate(yaml.safe_load((pool / "mission.yaml").read_text())).navigation is None
    pairs = small_mission(tmp_path / "pairs", "pairs", images=4, width=96)
    images = Mission.model_validate(yaml.safe_load((pairs / "mission.yaml").read_text())).images
    assert {(s.path, s.role) for s in images} == {("images/V_*.jpg", "texture"), ("images/L_*.jpg", "laser")}
    frames = json.loads((pairs / "truth/truth.json").read_text())["frames"]
    assert all(f["image"].startswith("L" if f["role"] == "laser" else "V") for f in frames)
    means = {f["role"]: picture(pairs, f["image"]).mean() for f in frames}
    assert means["laser"] < 0.3 * means["texture"]


def test_no_laser_when_switched_off(tmp_path: Path):
    mission = small_mission(
        tmp_path / "m", images=1, width=96, laser={"enabled": False}, survey={"roles": "texture", "lines": 1}
    )
    assert "laser" not in yaml.safe_load((mission / "calibration.yaml").read_text())
    assert "planes" not in json.loads((mission / "truth/truth.json").read_text())


def test_a_flat_port_and_a_fisheye_are_simulated(tmp_path: Path):
    port = small_mission(tmp_path / "port", "port", images=1, width=96)
    assert read_truth(port).calibration.camera.port is not None
    fisheye = {"model": "fisheye", "distortion": (0.02, 0.0, 0.0, 0.0)}
    assert (
        read_truth(small_mission(tmp_path / "fish", images=1, width=96, camera=fisheye)).calibration.camera.model
        == "fisheye"
    )


@pytest.mark.skipif("SEAMOSAIC_SHARED" not in os.environ, reason="needs the shared missions")
def test_the_truth_has_the_form_of_the_shared_missions(reef: Path):
    shared = Path(os.environ["SEAMOSAIC_SHARED"]) / "missions" / "reef"
    ours, theirs = (json.loads((m / "truth/truth.json").read_text()) for m in (reef, shared))
    assert theirs.keys() <= ours.keys()
    assert ours["frames"][0].keys() == theirs["frames"][0].keys()
    with np.load(reef / "truth/terrain.npz") as a, np.load(shared / "truth/terrain.npz") as b:
        assert {k: (v.dtype, v.ndim) for k, v in a.items()} == {k: (v.dtype, v.ndim) for k, v in b.items()}
    assert (reef / "navigation.csv").read_text().split()[0] == (shared / "navigation.csv").read_text().split()[0]


def test_wrong_use_is_refused(tmp_path: Path):
    with pytest.raises(InvalidInput, match="plane, box, pool, reef"):
        simulate("moon", tmp_path / "a")
    with pytest.raises(InvalidInput, match=r"light\.strobe"):
        simulate("reef", tmp_path / "a", light={"strobe": -1})
    with pytest.raises(InvalidInput, match="colour"):
        simulate("reef", tmp_path / "a", colour="blue")
    with pytest.raises(InvalidInput, match="--seed"):
        simulate("reef", tmp_path / "a", seed=-1)
    with pytest.raises(InvalidInput, match="in the air"):
        simulate("reef", tmp_path / "a", survey={"altitude_m": 20.0})
    with pytest.raises(InvalidInput, match=r"laser\.enabled"):
        simulate("night", tmp_path / "a", laser={"enabled": False})
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InvalidInput, match="empty"):
        simulate("reef", tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_an_interrupted_simulation_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "_write_images", fail)
    with pytest.raises(KeyboardInterrupt):
        small_mission(tmp_path / "m", images=1, width=96)
    assert list(tmp_path.iterdir()) == []


def test_an_empty_folder_may_be_there_and_none_means_unchanged(tmp_path: Path):
    scene = Scene(name="small", images=1, width=96, survey=SCENES["reef"].survey.model_copy(update={"lines": 1}))
    (tmp_path / "m").mkdir()
    assert len(read_truth(simulate(scene, tmp_path / "m", images=None, width=80)).images) == 1
    assert read_truth(tmp_path / "m").calibration.camera.width == 80


def test_a_full_mission_repeats_its_images_but_neither_its_track_nor_its_navigation(tmp_path: Path):
    """Four lines and a bit: what looks the same is one file; all true poses differ by whole periods."""
    changes = {"terrain": {"cell_m": 0.04}, "texture": {"cell_m": 0.02}, "survey": {"lines": 5}}
    mission = simulate("full", tmp_path / "full", seed=3, images=60, width=128, **changes)
    truth, period = read_truth(mission), SCENES["full"].period_m
    files = {}
    for k, name in enumerate(truth.images):
        files.setdefault(os.stat(mission / "images" / name).st_ino, []).append(k)
    assert len(truth.images) == 60
    assert len(files) == 32  # eight stations of four lines
    C, R = truth.poses.C_local, truth.poses.R_local_camera
    assert len(np.unique(np.round(C, 3), axis=0)) == 60
    for alike in files.values():
        apart = C[alike] - C[alike[0]]
        assert apart[:, :2] / period == pytest.approx(np.round(apart[:, :2] / period), abs=1e-6)
        assert apart[:, 2] == pytest.approx(0, abs=1e-6)
        assert R[alike] == pytest.approx(np.broadcast_to(R[alike[0]], R[alike].shape), abs=1e-6)
    table = pd.read_csv(mission / "navigation.csv")
    assert table[["latitude", "longitude"]].drop_duplicates().shape[0] == len(table)


def test_a_repeated_seabed_has_no_step_where_it_begins_anew(tmp_path: Path):
    mission = simulate("full", tmp_path / "full", images=40, width=128, texture={"cell_m": 0.02}, survey={"lines": 5})
    with np.load(mission / "truth/terrain.npz") as t:
        h, period = t["h"], round(float(t["period"]) / float(t["cell"]))
    assert (h[period:] == h[:-period]).all()
    inside = np.abs(np.diff(h[:period], axis=0)).max(1)
    across = np.abs(h[period] - h[period - 1]).max()
    assert across < 1.5 * inside.max()
