"""soundings.laz, read back with laspy."""

import laspy
import numpy as np
import pyproj
import pytest
from seamosaic.catalog import pointclouds, rasters

UTM = pyproj.CRS("EPSG:32631+5714")
OFFSET = np.array([500_000.0, 4_700_000.0, 0.0])


def soundings(count, seed=0):
    rng = np.random.default_rng(seed)
    X = OFFSET + rng.uniform([-30, -40, -25], [30, 40, -20], (count, 3))
    return X, rng.integers(0, 900, count), rng.integers(0, 2, count), rng.uniform(0.001, 0.01, count)


def test_everything_comes_back_in_the_order_of_writing(tmp_path):
    batches = [soundings(n, n) for n in (1000, 1, 0, 60_000)]
    with pointclouds.SoundingsWriter(tmp_path / "soundings.laz", UTM.to_wkt(), OFFSET) as writer:
        for batch in batches:
            writer.write(*batch)
    X, frame, arm, sigma = (np.concatenate(parts) for parts in zip(*batches, strict=True))
    found = laspy.read(tmp_path / "soundings.laz")
    assert np.abs(found.xyz - X).max() <= 0.5e-4 + 1e-9
    np.testing.assert_array_equal(found["frame"], frame)
    np.testing.assert_array_equal(found["arm"], arm)
    np.testing.assert_array_equal(found["sigma"], sigma.astype(np.float32))
    header = found.header
    assert (str(header.version), header.point_format.id, header.point_count) == ("1.4", 6, len(X))
    assert [found[name].dtype for name in ("frame", "arm", "sigma")] == [np.int32, np.uint8, np.float32]
    np.testing.assert_allclose(header.mins, X.min(0), atol=1e-4)
    np.testing.assert_allclose(header.maxs, X.max(0), atol=1e-4)
    assert set(np.unique(found.classification)) == {40}
    assert [entry.name for entry in tmp_path.iterdir()] == ["soundings.laz"]


@pytest.mark.parametrize("wkt", [UTM.to_wkt(), rasters.local_crs_wkt()], ids=["compound", "local"])
def test_crs_is_in_the_file(tmp_path, wkt):
    with pointclouds.SoundingsWriter(tmp_path / "s.laz", wkt, OFFSET) as writer:
        writer.write(*soundings(3))
    with laspy.open(tmp_path / "s.laz") as file:
        assert file.header.global_encoding.wkt
        found = file.header.parse_crs()
    assert found is not None
    assert found.equals(pyproj.CRS.from_wkt(wkt), ignore_axis_order=True)


def test_no_soundings_make_an_empty_file(tmp_path):
    with pointclouds.SoundingsWriter(tmp_path / "s.laz", UTM.to_wkt(), OFFSET):
        pass
    assert len(laspy.read(tmp_path / "s.laz")) == 0


def test_an_exception_leaves_nothing(tmp_path):
    writer = pointclouds.SoundingsWriter(tmp_path / "s.laz", UTM.to_wkt(), OFFSET)

    def fail():
        with writer:
            writer.write(*soundings(10))
            raise RuntimeError("half-way")

    with pytest.raises(RuntimeError, match="half-way"):
        fail()
    assert not list(tmp_path.iterdir())
