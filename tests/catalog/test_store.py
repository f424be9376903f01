import fsspec
import numpy as np
import pytest
from seamosaic.catalog.store import Store, digest

ARRAYS = {"points": np.arange(12.0).reshape(4, 3), "arm": np.array([0, 1, 1, 0], np.uint8)}


def test_results_come_back(tmp_path):
    for store in (Store(str(tmp_path)), Store("memory://steps")):
        for compress in (False, True):
            store.put("extract", "ab12", ARRAYS, {"count": 4}, compress)
            entry = store.get("extract", "ab12")
            assert entry is not None
            assert entry.info == {"count": 4}
            for name, values in ARRAYS.items():
                np.testing.assert_array_equal(entry.arrays[name], values)
                assert entry.arrays[name].dtype == values.dtype
    fsspec.filesystem("memory").rm("/steps", recursive=True)


def test_an_absent_result_is_none(tmp_path):
    assert Store(str(tmp_path)).get("extract", "00") is None


def test_a_damaged_result_counts_as_absent(tmp_path):
    store = Store(str(tmp_path))
    store.put("extract", "ab12", ARRAYS, {})
    path = tmp_path / "extract" / "ab" / "ab12.npz"
    content = path.read_bytes()
    for damaged in (content[: len(content) // 2], content[:200] + b"\xff" * 40 + content[240:], b""):
        path.write_bytes(damaged)
        assert store.get("extract", "ab12") is None
    store.remove("extract", "ab12")
    assert store.info("extract", "ab12") is None
    store.put("extract", "ab12", ARRAYS, {"count": 4})
    assert store.info("extract", "ab12") == {"count": 4}


def test_nothing_half_written_stays(tmp_path):
    class Broken:
        def __array__(self, *_, **__):
            raise RuntimeError("no memory")

    store = Store(str(tmp_path))
    with pytest.raises(RuntimeError):
        store.put("extract", "ab12", {"bad": Broken()}, {})
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_digests_tell_everything_apart():
    base = digest("extract", "1", ["a", "b"], {"x": 1.0})
    assert base == digest("extract", "1", ["a", "b"], {"x": 1.0})
    others = [
        digest("match", "1", ["a", "b"], {"x": 1.0}),
        digest("extract", "2", ["a", "b"], {"x": 1.0}),
        digest("extract", "1", ["b", "a"], {"x": 1.0}),
        digest("extract", "1", ["ab"], {"x": 1.0}),
        digest("extract", "1", ["a", "b"], {"x": 1.5}),
    ]
    assert len({base, *others}) == 6
