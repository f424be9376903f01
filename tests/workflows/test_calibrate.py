"""`seamosaic calibrate` from the command line."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from seamosaic.schemas.calibration import LaserPlane
from seamosaic.schemas.problems import InvalidInput
from seamosaic.tasks.calibration_sheets import altitude_error, angle_deg, basis, sensitivity, step_jacobian
from seamosaic.workflows.calibrate_inputs import read_calibration
from seamosaic.workflows.cli import app
from typer.testing import CliRunner

from tests.board_photographs import write_photographs
from tests.simulated import small_mission
from tests.tasks.calibration_scenes import board_poses, calibration, wrong


def start_of(mission: Path, folder: Path) -> Path:
    """A starting calibration one degree and 20 mm wrong."""
    path = folder / "start.yaml"
    off = wrong(read_calibration(mission / "calibration.yaml"))
    path.write_text(yaml.safe_dump(off.model_dump(mode="json", exclude_none=True)))
    return path


def worst_percent(mission: Path, found: Path, altitude_m: float) -> float:
    true, other = (read_calibration(path).laser for path in (mission / "calibration.yaml", found))
    assert true is not None
    assert other is not None
    camera = read_calibration(mission / "calibration.yaml").camera
    pairs = zip(true.sheets, other.sheets, strict=True)
    errors = [
        altitude_error(camera, np.array([*a.normal, a.offset]), np.array([*b.normal, b.offset]), altitude_m)
        for a, b in pairs
    ]
    return 100 * max(abs(e) for e in errors) / altitude_m


def test_flat(tmp_path: Path):
    survey = {"lines": 3, "altitude_m": 1.8, "altitude_step_m": 0.6, "overlap": 0.4, "sidelap": 0.6}
    mission = small_mission(tmp_path / "floor", "floor", images=12, survey=survey)
    few = small_mission(tmp_path / "few", "floor", images=3)
    start, out = start_of(mission, tmp_path), tmp_path / "out"
    both = [str(mission), str(few)]
    done = CliRunner().invoke(app, ["calibrate", "flat", *both, "--start", str(start), "-o", str(out)])
    assert done.exit_code == 0, done.output
    assert worst_percent(mission, start, 2.4) > 0.3
    assert worst_percent(mission, out / "calibration.yaml", 2.4) < 0.25
    (block,) = read_calibration(out / "calibration.yaml").covariance
    assert "laser.planes.a.normal.x" in block.parameters
    assert "mount.rotation.roll" in block.parameters
    assert np.linalg.eigvalsh(np.array(block.matrix)).min() > -1e-12
    page = (out / "calibration-report.html").read_text()
    assert f"left out: {few}: images: found 3 images with both lines" in page
    assert "Leave-one-out" in page
    assert page.count("data:image/png") == 3
    assert "http" not in page.replace("http-equiv", "")
    with pytest.raises(InvalidInput, match="never overwritten"):
        CliRunner().invoke(app, ["calibrate", "flat", str(mission), "-o", str(out)], catch_exceptions=False)


def test_no_board_is_said(tmp_path: Path):
    arguments = ["calibrate", "board", str(tmp_path), "-o", str(tmp_path / "out"), "--lines", "1"]
    arguments += ["--columns", "9", "--rows", "6", "--square-mm", "30"]
    with pytest.raises(InvalidInput, match="no images"):
        CliRunner().invoke(app, arguments, catch_exceptions=False)


def test_a_cross_needs_a_start(tmp_path: Path):
    arguments = ["calibrate", "board", str(tmp_path), "-o", str(tmp_path / "out")]
    arguments += ["--columns", "9", "--rows", "6", "--square-mm", "30"]
    with pytest.raises(InvalidInput, match="--start"):
        CliRunner().invoke(app, arguments, catch_exceptions=False)


def test_a_mission_without_navigation_is_refused(tiny_mission: Path, tmp_path: Path):
    text = (tiny_mission / "mission.yaml").read_text()
    (tiny_mission / "mission.yaml").write_text(text[: text.index("navigation:")])
    with pytest.raises(InvalidInput, match="navigation"):
        CliRunner().invoke(
            app, ["calibrate", "field", str(tiny_mission), "-o", str(tmp_path / "o")], catch_exceptions=False
        )


BOARD = ["--columns", "9", "--rows", "6", "--square-mm", "30", "--lines", "1"]


def test_an_unknown_dictionary_is_refused(tmp_path: Path):
    arguments = ["calibrate", "board", str(tmp_path), "-o", str(tmp_path / "out"), *BOARD, "--dictionary", "DICT_9"]
    with pytest.raises(InvalidInput, match="dictionary of markers"):
        CliRunner().invoke(app, arguments, catch_exceptions=False)


def test_an_output_that_is_a_file_is_refused_before_any_work(tmp_path: Path):
    (tmp_path / "out").write_text("")
    arguments = ["calibrate", "board", str(tmp_path), "-o", str(tmp_path / "out"), *BOARD]
    with pytest.raises(InvalidInput, match="expected a folder"):
        CliRunner().invoke(app, arguments, catch_exceptions=False)


def test_an_output_elsewhere_is_refused_before_any_work(tmp_path: Path):
    for out, expected in (("s3://maps/new", "expected a local folder"), (tmp_path / "file" / "out", "can be written")):
        (tmp_path / "file").write_text("")
        with pytest.raises(InvalidInput, match=expected):
            CliRunner().invoke(
                app, ["calibrate", "board", str(tmp_path), "-o", str(out), *BOARD], catch_exceptions=False
            )


def test_boards_that_cannot_tell_what_is_asked_are_refused(tmp_path: Path):
    arguments = ["calibrate", "board", str(tmp_path), "-o", str(tmp_path / "out"), *BOARD]
    for more, expected in ((["--hold-camera"], "no --start"), (["--bent", "--rows", "7"], "the same upside down")):
        with pytest.raises(InvalidInput, match=expected):
            CliRunner().invoke(app, [*arguments, *more], catch_exceptions=False)


def test_a_start_of_another_image_size_is_refused(tiny_mission: Path, tmp_path: Path):
    content = yaml.safe_load((tiny_mission / "calibration.yaml").read_text())
    content["camera"]["width"] += 2
    (tmp_path / "start.yaml").write_text(yaml.safe_dump(content))
    arguments = ["calibrate", "flat", str(tiny_mission), "-o", str(tmp_path / "out")]
    with pytest.raises(InvalidInput, match="--start"):
        CliRunner().invoke(app, [*arguments, "--start", str(tmp_path / "start.yaml")], catch_exceptions=False)


def test_board(tmp_path: Path):
    """Six photographs of a chessboard in the light of a cross: camera and sheets within their sigmas."""
    true, (R, t) = calibration(), board_poses(6, 1)
    write_photographs(tmp_path / "photographs", true, (R, t))
    start, out = tmp_path / "start.yaml", tmp_path / "out"
    start.write_text(yaml.safe_dump(wrong(true).model_dump(mode="json", exclude_none=True)))
    arguments = ["calibrate", "board", str(tmp_path / "photographs"), "--start", str(start), "-o", str(out)]
    done = CliRunner().invoke(app, [*arguments, "--columns", "9", "--rows", "6", "--square-mm", "60"])
    assert done.exit_code == 0, done.output
    found = read_calibration(out / "calibration.yaml")
    assert found.laser is not None
    assert true.laser is not None
    (block,) = found.covariance
    sigma = dict(zip(block.parameters, np.sqrt(np.diag(np.array(block.matrix))), strict=True))
    for name in ("fx", "fy", "cx", "cy"):
        error = getattr(found.camera, name) - getattr(true.camera, name)
        assert abs(error) < 3 * sigma[f"camera.{name}"]
        assert 0.02 < sigma[f"camera.{name}"] < 5
    names = [k for k, name in enumerate(block.parameters) if name.startswith("laser.")]
    covariance = np.array(block.matrix)[np.ix_(names, names)]
    (stated,) = sensitivity(true.camera, true.laser.sheets, np.array([2.5])).sigma_m(covariance)
    begun = read_calibration(start).laser
    assert begun is not None
    off = {}
    for name, light in (("before", begun), ("after", found.laser)):
        pairs = zip(true.laser.sheets, light.sheets, strict=True)
        planes = [(np.array([*a.normal, a.offset]), np.array([*b.normal, b.offset])) for a, b in pairs]
        off[name] = np.array([altitude_error(true.camera, a, b, 2.5) for a, b in planes])
    assert 0.0001 < stated < 0.004
    assert abs(off["after"].mean()) < 3 * stated
    assert np.abs(off["before"]).max() > 2 * np.abs(off["after"]).max()
    assert not any(name.endswith("k3") for name in block.parameters)  # held, so nothing was learnt of it
    again = tmp_path / "again"
    held = [*arguments[:3], "--hold-camera", "--start", str(out / "calibration.yaml"), "-o", str(again)]
    assert CliRunner().invoke(app, [*held, "--columns", "9", "--rows", "6", "--square-mm", "60"]).exit_code == 0
    camera, sheets = read_calibration(again / "calibration.yaml").covariance
    count = len(block.parameters) - 8
    assert camera.parameters == block.parameters[:count]
    assert camera.matrix == tuple(row[:count] for row in block.matrix[:count])
    assert sheets.parameters == block.parameters[count:]
    page = (out / "calibration-report.html").read_text()
    assert "Left-out light" in page
    assert page.count("data:image/png") == 3


def test_lines_that_do_not_cross(tmp_path: Path):
    """Two lines and a new folder: the camera in calibration.yaml, the sheets beside it in planes.yaml."""
    true, lean, turn = calibration(), np.radians(5), np.radians(3)
    assert true.laser is not None
    normal = tuple(float(v) for v in (np.cos(lean) * np.cos(turn), np.sin(turn), np.sin(lean) * np.cos(turn)))
    planes = tuple(LaserPlane(name=name, normal=normal, offset=offset) for name, offset in (("a", 0.12), ("b", 0.21)))
    light = true.laser.model_copy(update={"planes": planes})
    write_photographs(tmp_path / "photographs", true.model_copy(update={"laser": light}), board_poses(4, 1))
    out = tmp_path / "new" / "out"
    arguments = ["calibrate", "board", str(tmp_path / "photographs"), "-o", str(out), "--lines", "2"]
    done = CliRunner().invoke(app, [*arguments, "--columns", "9", "--rows", "6", "--square-mm", "60"])
    assert done.exit_code == 0, done.output
    assert read_calibration(out / "calibration.yaml").laser is None
    found = yaml.safe_load((out / "planes.yaml").read_text())["planes"]
    assert len(found) == 2
    for one, plane in zip(found, planes, strict=True):
        assert 0.0001 < angle_deg(one["normal"], plane.normal) < 0.3
        assert abs(abs(one["offset"]) - plane.offset) < 0.005


def truth_in_sigmas(mission: Path, found: Path) -> np.ndarray:
    """Errors of the sheets' turns and shifts and of the mount's angles in their own sigmas."""
    true, other = (read_calibration(path) for path in (mission / "calibration.yaml", found))
    assert true.laser is not None
    assert other.laser is not None
    covariance, scores = np.array(other.covariance[-1].matrix), []
    for s, (plane, sheet) in enumerate(zip(true.laser.sheets, other.laser.sheets, strict=True)):
        to_steps = np.linalg.pinv(step_jacobian(basis(plane, true.laser.origin), np.zeros(3)))
        error = to_steps @ (np.array([*sheet.normal, sheet.offset]) - [*plane.normal, plane.offset])
        own = to_steps @ covariance[4 * s : 4 * s + 4, 4 * s : 4 * s + 4] @ to_steps.T
        scores.append(error / np.sqrt(np.diag(own)))
    turned = np.subtract(other.mount.rotation, true.mount.rotation)[: len(covariance) - 8]
    return np.concatenate([*scores, turned / np.sqrt(np.diag(covariance)[8:])])


def test_field(tmp_path: Path):
    """Nine small images: what they can tell, with sigmas to match."""
    mission = small_mission(tmp_path / "reef", "reef", images=9, survey={"lines": 3})
    start, out = start_of(mission, tmp_path), tmp_path / "out"
    done = CliRunner().invoke(app, ["calibrate", "field", str(mission), "--start", str(start), "-o", str(out)])
    assert done.exit_code == 0, done.output
    assert worst_percent(mission, start, 2.7) > 0.5
    assert worst_percent(mission, out / "calibration.yaml", 2.7) < 0.5
    assert 0.1 < np.abs(truth_in_sigmas(mission, out / "calibration.yaml")).max() < 3
    assert "time_offset" in (out / "calibration-report.html").read_text()


FLAT_SEEDS, FIELD_SEEDS = (31, 32, 33), (41, 42)


@pytest.mark.slow
def test_flat_over_several_seeds(tmp_path: Path):
    """One degree and 20 mm wrong at first: true within 2 sigma, altitudes within 0.1 % above the lowest line."""
    scores = []
    for seed in FLAT_SEEDS:
        mission = small_mission(tmp_path / f"floor{seed}", "floor", 32, 1216, seed, survey={"lines": 4})
        start, out = start_of(mission, tmp_path), tmp_path / f"out{seed}"
        done = CliRunner().invoke(app, ["calibrate", "flat", str(mission), "--start", str(start), "-o", str(out)])
        assert done.exit_code == 0, done.output
        scores.append(truth_in_sigmas(mission, out / "calibration.yaml"))
        assert worst_percent(mission, out / "calibration.yaml", 2.7) < 0.1
    honest(np.array(scores))


@pytest.mark.slow
def test_field_over_several_seeds(tmp_path: Path):
    scores = []
    for seed in FIELD_SEEDS:
        mission = small_mission(tmp_path / f"reef{seed}", "reef", 36, 1216, seed, survey={"lines": 4})
        start, out = start_of(mission, tmp_path), tmp_path / f"out{seed}"
        done = CliRunner().invoke(app, ["calibrate", "field", str(mission), "--start", str(start), "-o", str(out)])
        assert done.exit_code == 0, done.output
        scores.append(truth_in_sigmas(mission, out / "calibration.yaml"))
        assert worst_percent(mission, out / "calibration.yaml", 2.7) < 0.3
    honest(np.array(scores))


def honest(scores: np.ndarray) -> None:
    """Scores of seeds (S, P): neither larger nor much smaller than they claim."""
    assert 0.3 < np.sqrt(np.mean(scores**2)) < 1.6
    assert np.abs(scores).max() < 3.2
