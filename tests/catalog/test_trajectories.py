"""trajectory.csv, read back with the csv module and with our own reader."""

import csv

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from seamosaic.catalog import trajectories
from seamosaic.catalog.trajectories import Pose, Row

TIME = np.datetime64("2026-06-03T10:11:12.345678", "ns")
POSE = Pose((500_123.45678, 4_712_345.67891, -17.98764), (0.1234567891, 0.9, -0.3, 0.2), (0.0123, 0.0234, 0.005))


def test_cells_are_to_the_letter(tmp_path):
    path = tmp_path / "trajectory.csv"
    rows = [
        Row("images/V_1.jpg", TIME, POSE, "adjusted"),
        Row("images/V_2.jpg", TIME + np.timedelta64(4, "s"), None, 'rejected: truncated, "no end" marker'),
        Row("images/V_3.jpg", TIME, POSE._replace(sigma=(np.nan,) * 3), "navigation"),
    ]
    trajectories.write(path, rows)
    lines = path.read_text(encoding="utf-8").split("\n")
    assert lines[0] == "image,time,x,y,z,qw,qx,qy,qz,sigma_x,sigma_y,sigma_z,status"
    assert lines[1] == (
        "images/V_1.jpg,2026-06-03T10:11:12.345678Z,500123.4568,4712345.6789,-17.9876,"
        "0.123456789,0.900000000,-0.300000000,0.200000000,0.0123,0.0234,0.0050,adjusted"
    )
    with path.open(newline="", encoding="utf-8") as file:
        _, rejected, unknown = csv.DictReader(file)
    assert rejected["status"] == 'rejected: truncated, "no end" marker'
    assert {rejected[name] for name in ("x", "y", "z", "qw", "sigma_z")} == {""}
    assert rejected["time"] == "2026-06-03T10:11:16.345678Z"
    assert unknown["sigma_x"] == ""
    assert float(unknown["x"]) == pytest.approx(500_123.4568)


coordinates = st.floats(-1e7, 1e7, allow_nan=False)
units = st.floats(-1, 1)
poses = st.builds(
    Pose,
    st.tuples(coordinates, coordinates, coordinates),
    st.tuples(units, units, units, units),
    st.tuples(*[st.floats(0, 100)] * 3),
)
texts = st.text("aé/.,;: '\"\\\n-", min_size=1, max_size=20)
statuses = st.one_of(st.sampled_from(["adjusted", "navigation"]), texts.map("rejected: {}".format))
times = st.integers(0, 4 * 10**15).map(lambda us: np.datetime64(us, "us"))
rows = st.builds(Row, texts, times, st.none() | poses, statuses)


@settings(deadline=None, max_examples=30)
@given(st.lists(rows, max_size=4))
def test_what_is_written_comes_back(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("trajectory") / "trajectory.csv"
    trajectories.write(path, rows)
    found = trajectories.read(path)
    assert [(row.image, row.time, row.status) for row in found] == [(row.image, row.time, row.status) for row in rows]
    for expected, row in zip(rows, found, strict=True):
        assert (row.pose is None) == (expected.pose is None)
        if row.pose is not None and expected.pose is not None:
            assert row.pose.position == pytest.approx(expected.pose.position, abs=0.51e-4)
            assert row.pose.quaternion == pytest.approx(expected.pose.quaternion, abs=0.51e-9)
            assert row.pose.sigma == pytest.approx(expected.pose.sigma, abs=0.51e-4)


@pytest.mark.parametrize("status", ["", "lost", "rejected", "rejected: ", "adjusted: why"])
def test_other_statuses_are_refused(tmp_path, status):
    with pytest.raises(ValueError, match="is not adjusted"):
        trajectories.write(tmp_path / "trajectory.csv", [Row("a.jpg", TIME, None, status)])
    assert not list(tmp_path.iterdir())


def test_an_image_without_time(tmp_path):
    row = Row("a.jpg", np.datetime64("NaT", "us"), None, "rejected: no timestamp")
    trajectories.write(tmp_path / "t.csv", [row])
    (found,) = trajectories.read(tmp_path / "t.csv")
    assert np.isnat(found.time)
    assert found.kind == "rejected"
