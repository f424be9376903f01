import json
import signal
import subprocess
import sys
import time

import pytest
from seamosaic.workflows import cli
from typer.testing import CliRunner

RUNNER = CliRunner()


def _main(monkeypatch, *arguments):
    """Exit code of the command as a shell sees it."""
    monkeypatch.setattr("sys.argv", ["seamosaic", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return ended.value.code or 0


def test_help_names_every_command():
    text = RUNNER.invoke(cli.app, ["--help"]).output
    for command in ("run", "check", "simulate", "evaluate", "demo"):
        assert command in text


def test_check_of_a_good_mission(tiny_mission, monkeypatch):
    assert _main(monkeypatch, "check", tiny_mission) == 0


def test_wrong_input_is_exit_code_2_with_every_problem(tiny_mission, monkeypatch, capfd):
    text = (tiny_mission / "calibration.yaml").read_text().replace("fx: 80.0", "fx: -80.0").replace("cx", "cxx")
    (tiny_mission / "calibration.yaml").write_text(text)
    for arguments in (["check", tiny_mission], ["run", tiny_mission, "-o", tiny_mission.parent / "out"]):
        assert _main(monkeypatch, *arguments) == 2
        captured = capfd.readouterr()
        said = captured.out + captured.err
        assert "fx" in said
        assert "cxx" in said
        assert "Traceback" not in said


def test_wrong_parameters_are_exit_code_2(tiny_mission, monkeypatch, capfd):
    out = tiny_mission.parent / "out"
    assert _main(monkeypatch, "run", tiny_mission, "-o", out, "--set", "grid.cell=1") == 2
    assert _main(monkeypatch, "run", tiny_mission, "-o", out, "--params", tiny_mission / "none.yaml") == 2
    assert "Traceback" not in capfd.readouterr().err


def test_nothing_to_map_is_exit_code_1(tiny_mission, monkeypatch, capfd):
    arguments = ["run", tiny_mission, "-o", tiny_mission.parent / "out", "--scheduler", "sync"]
    assert _main(monkeypatch, *arguments) == 1
    assert "nothing to map" in " ".join(capfd.readouterr().err.split())


def test_run_and_evaluate_print_figures(reef, monkeypatch, capfd):
    assert _main(monkeypatch, "run", reef.mission, "-o", reef.out, "--scheduler", "sync") == 0
    assert "nothing changed" in " ".join(capfd.readouterr().out.split())
    assert _main(monkeypatch, "evaluate", reef.out, "--truth", reef.mission) == 0
    assert "trajectory" in json.loads(capfd.readouterr().out)


def test_a_json_log_is_one_object_a_line(reef, tiny_mission, monkeypatch, capfd):
    options = ["--scheduler", "sync", "--log-json"]
    assert _main(monkeypatch, "run", reef.mission, "-o", reef.out, *options) == 0
    captured = capfd.readouterr()
    assert captured.out == ""
    lines = [json.loads(line) for line in captured.err.splitlines()]
    assert all({"time", "level", "mission", "step"} <= set(line) for line in lines)
    assert (lines[-1]["step"], lines[-1]["new"], lines[-1]["path"]) == ("done", False, str(reef.result.path))
    sorted((tiny_mission / "images").iterdir())[2].write_bytes(b"no image")
    assert _main(monkeypatch, "run", tiny_mission, "-o", tiny_mission.parent / "out", *options) == 1
    lines = [json.loads(line) for line in capfd.readouterr().err.splitlines()]
    assert "nothing to map" in lines[-1]["message"]
    (rejected,) = (line for line in lines if line["step"] == "open" and "image" in line)
    assert rejected["message"].startswith("rejected")
    (extract,) = (line for line in lines if line["step"] == "poses")
    assert extract["done"] == extract["total"] > 1
    assert _main(monkeypatch, "run", tiny_mission / "nowhere", "-o", tiny_mission.parent / "out", *options) == 2
    (line,) = (json.loads(line) for line in capfd.readouterr().err.splitlines())
    assert (line["level"], line["step"]) == ("error", "invalid")


def test_a_cluster_file_and_a_scheduler_are_one_too_many(tiny_mission, monkeypatch, capfd):
    file = tiny_mission.parent / "cluster.yaml"
    file.write_text("kind: slurm\n")
    arguments = ["run", tiny_mission, "-o", tiny_mission.parent / "out", "--cluster", file]
    assert _main(monkeypatch, *arguments, "--scheduler", "sync") == 2
    assert "one of them" in " ".join(capfd.readouterr().err.split())
    assert _main(monkeypatch, *arguments) == 2
    assert "cluster.yaml:1" in capfd.readouterr().err.replace("\n", "")  # the path may be longer than a line


@pytest.mark.slow
@pytest.mark.parametrize(("how", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_run_that_is_stopped_says_so(reef, tmp_path, how, code):
    command = [sys.executable, "-m", "seamosaic.workflows.cli", "run", str(reef.mission), "-o", str(tmp_path)]
    process = subprocess.Popen(
        [*command, "--workers", "1"],
        stderr=subprocess.PIPE,
        text=True,
        # a shell's background jobs ignore SIGINT, and so does what they start
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    while not list(tmp_path.rglob("*.npz")):
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(how)
    _, said = process.communicate(timeout=180)
    assert process.returncode == code
    assert "run the same command again" in " ".join(said.split())
    assert not list(tmp_path.rglob(".tmp/*"))


def test_simulate_makes_a_mission(tmp_path, monkeypatch):
    out = tmp_path / "made"
    assert _main(monkeypatch, "simulate", "plane", out, "--images", 2, "--width", 320) == 0
    assert len(list((out / "images").iterdir())) == 2
    assert _main(monkeypatch, "check", out) == 0
