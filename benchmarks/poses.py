"""Poses beside pycolmap on the same images: `python benchmarks/poses.py MISSION ...` (simulated, with their truth).

Needs pycolmap, which is no dependency of seamosaic: `pip install pycolmap` into the same environment. Either program
runs in a process of its own on one thread, with the environment of a run's workers; its processor time is counted from
the first image to the last pose, without imports. pycolmap has the camera of calibration.yaml, held, and the positions
of navigation as priors of their stated sigma, all else is its default. Accuracy: camera centres after a rigid alignment
with the truth, of the images that are placed.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from seamosaic.catalog.missions import OpenedMission, open_mission
from seamosaic.catalog.store import Store
from seamosaic.schemas.calibration import Camera
from seamosaic.schemas.parameters import Parameters
from seamosaic.tasks.evaluation import trajectory_errors
from seamosaic.workflows import heap, plan, run
from seamosaic.workflows.executor import open_executor
from seamosaic.workflows.job import Job
from seamosaic.workflows.session import Ledger, Session

_ENVIRONMENT = {**heap.WORKER_ENVIRONMENT, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def ours(opened: OpenedMission, mission: Path, folder: Path) -> dict[str, list[float]]:
    job = Job(str(mission), opened.mission.id, Store(str(folder / "steps")), opened.calibration, Parameters())
    with open_executor("sync", 1) as executor:
        found = run.poses(Session(job, opened, plan.plan(opened, job.parameters), executor, Ledger()))
    status, C = found.solution.status, found.solution.poses.C_local
    return {str(opened.frames["image"].values[k]): C[k].tolist() for k in range(len(C)) if status[k] == "adjusted"}


def pycolmap_camera(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP counts the centre of the first pixel as (0.5, 0.5)."""
    if camera.port is not None:
        raise SystemExit("pycolmap has no camera behind a flat port")
    pinhole = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    k1, k2, p1, p2, k3 = [*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0][:5]
    return "FULL_OPENCV", [*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]


def theirs(opened: OpenedMission, mission: Path, folder: Path) -> dict[str, list[float]]:
    import pycolmap

    made = plan.plan(opened, Parameters())
    names = [image.path for image in made.images]
    database, out = folder / "database.db", folder / "out"
    out.mkdir()
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, values = pycolmap_camera(opened.calibration.camera)
    reader.camera_params = ",".join(map(str, values))
    pycolmap.extract_features(
        database,
        mission,
        names,
        pycolmap.CameraMode.SINGLE,
        reader,
        pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False),
    )
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1, ba_refine_focal_length=False, ba_refine_extra_params=False
    )
    if made.prior is None:
        pycolmap.match_exhaustive(database, matching)
    else:
        db = pycolmap.Database.open(database)
        for image in db.read_all_images():
            row = names.index(image.name)
            k = made.images[row].row
            sigma = [made.prior.sigma_horizontal[k]] * 2 + [made.prior.sigma_depth[k]]
            prior = pycolmap.PosePrior(
                position=made.prior.poses.C_local[k],
                position_covariance=np.diag(np.square(sigma)),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
                corr_data_id=image.data_id,
            )
            db.write_pose_prior(prior)
        db.close()
        pycolmap.match_spatial(database, matching, pycolmap.SpatialPairingOptions(num_threads=1))
        options.use_prior_position = True
    models = pycolmap.incremental_mapping(database, mission, out, options)
    largest = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if largest is None:
        return {}
    return {i.name: i.projection_center().tolist() for i in largest.images.values() if i.has_pose}


def child(which: str, mission: Path) -> None:
    opened = open_mission(str(mission))
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        placed = {"ours": ours, "theirs": theirs}[which](opened, mission, Path(folder))
        seconds = time.process_time() - began
    print(json.dumps({"seconds": seconds, "images": opened.frames.sizes["image"], "placed": placed}))


def measure(which: str, mission: Path) -> float:
    command = [sys.executable, __file__, "--only", which, str(mission)]
    done = subprocess.run(command, env={**os.environ, **_ENVIRONMENT}, capture_output=True, text=True, check=False)
    if done.returncode:
        print(f"{mission.name} {which}: {done.stderr.strip().splitlines()[-1]}")
        return float("nan")
    found = json.loads(done.stdout.splitlines()[-1])
    each = found["seconds"] / found["images"]
    print(f"{mission.name} {which}: {each:.2f} core-s an image, {accuracy(found['placed'], found['images'], mission)}")
    return each


def accuracy(placed: dict[str, list[float]], count: int, mission: Path) -> str:
    frames = json.loads((mission / "truth/truth.json").read_text())["frames"]
    truth = {frame["image"]: frame["C"] for frame in frames}
    if len(placed) < 3:
        return f"{len(placed)} of {count} placed"
    found = np.array(list(placed.values()))
    true = np.array([truth[Path(name).name] for name in placed])
    errors = trajectory_errors(found, true)
    return (
        f"{len(placed)} of {count} placed, {1e3 * errors.rigid_rms_m:.1f} mm rms, scale {errors.scale_error_pct:+.3f} %"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=["ours", "theirs"])
    parser.add_argument("missions", nargs="+", type=Path)
    given = parser.parse_args()
    for folder in given.missions:
        if given.only:
            child(given.only, folder)
        else:
            own, other = (measure(which, folder) for which in ("ours", "theirs"))
            print(f"{folder.name}: {own / other:.2f} of pycolmap's processor time", flush=True)
