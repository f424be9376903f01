"""Makes whole missions in the public format, with their truth (`seamosaic simulate SCENE OUT`)."""

import csv
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
import yaml
from pydantic import ValidationError

from ..schemas.calibration import Calibration, Camera, CrossGeometry, Laser, Mount
from ..schemas.mission import Mission
from ..schemas.problems import InvalidInput, Problem
from ..schemas.scene import SCENES, LaserScene, Scene
from ..tasks.camera import camera_matrix, normalised, outline
from ..tasks.frames import MapFrame
from ..tasks.simulation_image import Optics, World, render
from ..tasks.simulation_laser import make_view
from ..tasks.simulation_navigation import (
    Cameras,
    Plan,
    cameras,
    measured,
    measured_altitude,
    plan,
    sample_times,
    trajectory,
)
from ..tasks.simulation_terrain import Terrain, height, make_terrain, normals
from ..tasks.simulation_texture import blurred, make_texture

START: Final = datetime(2026, 6, 3, 2, 14, 7, 136751, tzinfo=UTC)
_PATTERN: Final = "%Y%m%dT%H%M%S.%fZ"
# Independent random numbers for each subject: more noise does not change the seabed.
_TERRAIN, _TEXTURE, _MOTION, _NAVIGATION, _IMAGE = range(5)
_TEXTURE_QUALITY: Final = 90


class _Made(NamedTuple):
    """A mission before its images are rendered."""

    scene: Scene
    seed: int
    calibration: Calibration
    plan: Plan
    poses: Cameras
    terrain: Terrain
    texture: np.ndarray
    files: tuple[str, ...]


def simulate(scene: str | Scene, out: Path | str, seed: int = 0, **overrides: Any) -> Path:
    """Writes a mission folder and its truth/.

    Parameters
    ----------
    scene : a name in `schemas.scene.SCENES`, or a scene.
    out : the folder to make; it may exist but must hold nothing.
    seed : the same seed and scene give the same mission, byte for byte.
    **overrides : fields of the scene; sections as mappings of the fields to change (``sensor={"gamma": 1}``).
        None leaves a field as it is.

    Returns
    -------
    Path
        `out`.

    Raises
    ------
    InvalidInput
        For an unknown scene or field, a value out of bounds, or an output folder that is not empty.
    """
    chosen, out = _chosen(scene, overrides), Path(out)
    if seed < 0:
        raise InvalidInput([Problem("--seed", None, "", str(seed), "0 or more", "Give another seed.")])
    with _new_folder(out) as folder:
        made = _make(chosen, seed)
        _write_inputs(folder, made)
        _write_truth(folder / "truth", made)
        _write_images(folder / "images", made)
    return out


def _chosen(scene: str | Scene, overrides: Mapping[str, Any]) -> Scene:
    if isinstance(scene, str):
        if scene not in SCENES:
            names = ", ".join(SCENES)
            raise InvalidInput([Problem("SCENE", None, "", repr(scene), f"one of {names}", "Choose one of these.")])
        scene = SCENES[scene]
    try:
        return Scene.model_validate(_merged(scene.model_dump(), {k: v for k, v in overrides.items() if v is not None}))
    except ValidationError as error:
        raise InvalidInput(
            [
                Problem(
                    scene.name, None, ".".join(map(str, e["loc"])), repr(e.get("input")), e["msg"], "Change the scene."
                )
                for e in error.errors()
            ]
        ) from None


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    nested = {
        k: _merged(base[k], v)
        for k, v in changes.items()
        if isinstance(v, Mapping) and isinstance(base.get(k), Mapping)
    }
    return {**base, **changes, **nested}


@contextmanager
def _new_folder(out: Path) -> Iterator[Path]:
    """A temporary folder beside `out` that becomes `out` when all went well, and vanishes when not."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InvalidInput(
            [Problem(str(out), None, "", "files", "a folder that does not exist or is empty", "Choose another folder.")]
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        folder.chmod(0o755)
        yield folder
        os.replace(folder, out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _rng(seed: int, *stream: int) -> np.random.Generator:
    return np.random.default_rng([seed, *stream])


def calibration_of(scene: Scene) -> Calibration:
    """The calibration of a scene's camera, laser and mount."""
    focal = scene.camera.focal_share * scene.width
    camera = Camera(
        model=scene.camera.model,
        width=scene.width,
        height=scene.height,
        fx=round(focal, 6),
        fy=round(focal * 1.0005, 6),
        cx=round((scene.width - 1) / 2 + 0.00345 * scene.width, 4),
        cy=round((scene.height - 1) / 2 - 0.0052 * scene.height, 4),
        distortion=scene.camera.distortion,
        port=scene.camera.port,
    )
    mount = Mount(translation=scene.mount_translation, rotation=scene.mount_rotation)
    return Calibration(
        format=1, camera=camera, laser=_laser_of(scene.laser) if scene.laser.enabled else None, mount=mount
    )


def _laser_of(scene: LaserScene) -> Laser:
    origin = (scene.baseline_m, *scene.offset_m)
    ideal = Laser(
        origin=origin, planes=CrossGeometry(baseline=scene.baseline_m, angle=scene.angle_deg, roll=scene.roll_deg)
    )
    planes = []
    for sheet in ideal.sheets:
        normal = np.round(sheet.normal, 8)
        planes.append({"name": sheet.name, "normal": normal.tolist(), "offset": round(float(normal @ origin), 8)})
    return Laser.model_validate({"origin": origin, "planes": planes})


def _make(scene: Scene, seed: int) -> _Made:
    calibration = calibration_of(scene)
    camera, altitude = calibration.camera, scene.survey.altitude_m
    slopes = altitude * normalised(
        camera,
        np.array([[0, camera.cy], [camera.width, camera.cy], [camera.cx, 0], [camera.cx, camera.height]]),
        altitude,
    )
    footprint = (float(slopes[1, 0] - slopes[0, 0]), float(slopes[3, 1] - slopes[2, 1]))
    ahead, aside, down = calibration.mount.translation
    z = altitude - scene.terrain.depth_m + down
    made = plan(scene.survey, scene.images, footprint, z, (ahead, aside), _rng(seed, _MOTION), scene.period_m)
    poses = cameras(trajectory(made, made.image_time_s), calibration.mount)
    half_m = _half_m(scene, camera, _folded(scene, poses.C_local))
    terrain = make_terrain(scene.terrain, half_m, _rng(seed, _TERRAIN), scene.period_m)
    texture = make_texture(scene.texture, terrain.half_m, _rng(seed, _TEXTURE), scene.period_m)
    files = tuple(
        f"{'L' if role == 'laser' else 'V'}_{_time(t).strftime(_PATTERN)}.jpg"
        for t, role in zip(made.image_time_s, made.image_role, strict=True)
    )
    return _Made(scene, seed, calibration, made, poses, terrain, texture, files)


def _folded(scene: Scene, X_local: np.ndarray) -> np.ndarray:
    """Points (N, 3), moved by whole periods to around the origin, where the seabed is made."""
    if not scene.period_m:
        return X_local
    xy = X_local[:, :2]
    return np.column_stack([xy - scene.period_m * np.round(xy / scene.period_m), X_local[:, 2]])


def _half_m(scene: Scene, camera: Camera, C_local: np.ndarray) -> float:
    """Half the side of a square that holds all that the cameras at C_local (n, 3) see."""
    drop = scene.terrain.slope_drop_m if scene.terrain.kind == "pool" else 3 * scene.terrain.relief_m
    farthest = scene.survey.highest_m + drop + 0.2
    # a few degrees more than the corner's, for the vehicle's roll and pitch
    corner = np.arctan(np.hypot(*normalised(camera, outline(camera, 5), farthest).T)).max() + np.radians(4)
    return float(abs(C_local[:, :2]).max() + farthest * np.tan(corner) + 0.2)


def _time(seconds: float) -> datetime:
    return START + timedelta(seconds=float(seconds))


def _write_inputs(folder: Path, made: _Made) -> None:
    scene = made.scene
    roles = sorted(set(made.plan.image_role), reverse=True)
    mission = {
        "format": 1,
        "id": f"{scene.name}-{made.seed}",
        "title": f"Simulated mission: {scene.name}",
        "platform": "simulated",
        "images": [{"path": f"images/{'L' if role == 'laser' else 'V'}_*.jpg", "role": role} for role in roles],
        "timestamps": {"from": "filename", "pattern": _PATTERN},
        "calibration": "calibration.yaml",
    }
    if scene.navigation.enabled:
        mission["navigation"] = {"path": "navigation.csv", "sigma": scene.navigation.sigma.model_dump()}
        _write_navigation(folder / "navigation.csv", made)
    Mission.model_validate(mission)
    calibration = json.loads(made.calibration.model_dump_json(exclude_none=True, exclude={"covariance"}))
    for name, content in (("mission.yaml", mission), ("calibration.yaml", calibration)):
        (folder / name).write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120))


def _write_navigation(path: Path, made: _Made) -> None:
    survey, navigation = made.scene.survey, made.scene.navigation
    rng = _rng(made.seed, _NAVIGATION)
    true = trajectory(made.plan, sample_times(made.plan, navigation.rate_hz))
    said = measured(true, navigation, rng)
    seabed = height(made.terrain, *_folded(made.scene, true.X_local)[:, :2].T)
    altitude = measured_altitude(true, seabed, navigation, rng)
    place = MapFrame(None, survey.latitude, survey.longitude).geographic_from_local(said.X_local)
    with path.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["time", "latitude", "longitude", "depth", "altitude", "roll", "pitch", "heading"])
        for t, (longitude, latitude, z), above, (roll, pitch, heading) in zip(
            true.time_s, place, altitude, said.attitude_deg, strict=True
        ):
            numbers = f"{latitude:.9f} {longitude:.9f} {-z:.4f} {above:.3f} {roll:.4f} {pitch:.4f} {heading:.4f}"
            rows.writerow([_time(t).strftime("%Y-%m-%dT%H:%M:%S.%fZ"), *numbers.split()])


def _write_truth(folder: Path, made: _Made) -> None:
    """The truth as `evaluate` reads it: poses in the local frame, heights, texture with row 0 north."""
    folder.mkdir()
    survey, camera, laser = made.scene.survey, made.calibration.camera, made.calibration.laser
    frames = [
        {"image": name, "t": float(t), "role": role, "R": R.tolist(), "C": C.tolist()}
        for name, t, role, R, C in zip(
            made.files, made.plan.image_time_s, made.plan.image_role, *made.poses, strict=True
        )
    ]
    truth = {
        "lat0": survey.latitude,
        "lon0": survey.longitude,
        "frames": frames,
        "K": camera_matrix(camera).tolist(),
        "dist": list(camera.distortion),
        "seed": made.seed,
        "scene": made.scene.model_dump(mode="json"),
    }
    if laser is not None:
        truth |= {"L0": laser.origin, "planes": [[*s.normal, s.offset] for s in laser.sheets]}
    (folder / "truth.json").write_text(json.dumps(truth))
    t = made.terrain
    grid = {"h": t.h, "half": t.half_m, "cell": t.cell_m, "depth": t.depth_m}
    if made.scene.period_m:
        grid["period"] = made.scene.period_m
    with (folder / "terrain.npz").open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **{name: np.asarray(value) for name, value in grid.items()})
    _write_jpeg(folder / "texture.jpg", made.texture, _TEXTURE_QUALITY)


def _write_images(folder: Path, made: _Made) -> None:
    folder.mkdir()
    scene, view = made.scene, make_view(made.calibration.camera)
    pixel = view.pixel_share * scene.survey.altitude_m
    texture = blurred(made.texture, scene.texture.cell_m, pixel)
    world = World(made.terrain, normals(made.terrain), texture, made.calibration.laser, scene.survey.altitude_m)
    optics = Optics(scene.laser, scene.light, scene.sensor)
    C = _folded(scene, made.poses.C_local)

    def one(alike: list[int]) -> None:
        k = alike[0]
        pose = Cameras(made.poses.R_local_camera[k : k + 1], C[k : k + 1])
        image = render(world, view, pose, optics, made.plan.image_role[k], _rng(made.seed, _IMAGE, k))
        _write_jpeg(folder / made.files[k], image, scene.sensor.jpeg_quality)
        for other in alike[1:]:
            os.link(folder / made.files[k], folder / made.files[other])

    # numpy and OpenCV release the interpreter lock; each thread holds one image
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        list(pool.map(one, _alike(made, C)))


def _alike(made: _Made, C_folded: np.ndarray) -> list[list[int]]:
    """Images that show the same: each on its own, unless seabed and motion repeat themselves."""
    if not made.scene.period_m:
        return [[k] for k in range(len(made.files))]
    poses = np.column_stack([C_folded, made.poses.R_local_camera.reshape(-1, 9)])
    # what lies at the fold's edge may land on either side of it
    poses[:, :2] = np.mod(poses[:, :2] + 1e-5, made.scene.period_m)
    groups: dict[tuple[float, ...], list[int]] = {}
    for k, pose in enumerate(np.round(poses, 4).tolist()):
        groups.setdefault(tuple(abs(value) for value in pose[:2]) + tuple(pose[2:]), []).append(k)
    return list(groups.values())


def _write_jpeg(path: Path, rgb: np.ndarray, quality: int) -> None:
    done, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    path.write_bytes(data.tobytes())
