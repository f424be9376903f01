import socket
import subprocess
import sys

import fsspec
import numpy as np
import pytest
from seamosaic.catalog.filesystems import connect
from seamosaic.catalog.store import Store, digest

ARRAYS = {"points": np.arange(12.0).reshape(4, 3), "arm": np.array([0, 1, 1, 0], np.uint8)}


def test_results_come_back(tmp_path):
    for store in (Store(str(tmp_path)), Store("memory://steps")):
        for compress in (False, True, ["arm"]):
            store.put("extract", "ab12", ARRAYS, {"count": 4}, compress)
            entry = store.get("extract", "ab12")
            assert entry is not None
            assert entry.info == {"count": 4}
            for name, values in ARRAYS.items():
                np.testing.assert_array_equal(entry.arrays[name], values)
                assert entry.arrays[name].dtype == values.dtype
    fsspec.filesystem("memory").rm("/steps", recursive=True)


def test_named_arrays_come_back_alone_and_the_others_are_not_read(tmp_path):
    store = Store(str(tmp_path))
    store.put("extract", "ab12", {**ARRAYS, "large": np.zeros(1_000_000)}, {"count": 4})
    entry = store.get("extract", "ab12", ["arm", "none"])
    assert entry is not None
    assert (set(entry.arrays), entry.info) == ({"arm"}, {"count": 4})
    np.testing.assert_array_equal(entry.arrays["arm"], ARRAYS["arm"])
    path = tmp_path / "extract" / "ab" / "ab12.npz"
    content = bytearray(path.read_bytes())
    content[4_000_000] ^= 0xFF  # in the large one
    path.write_bytes(content)
    assert store.get("extract", "ab12", ["arm"]) is not None
    assert store.get("extract", "ab12") is None


def test_only_named_arrays_are_compressed(tmp_path):
    store, path = Store(str(tmp_path)), tmp_path / "a" / "00" / "00.npz"
    arrays = {"a": np.zeros(50_000), "b": np.zeros(50_000)}
    sizes = []
    for compress in (False, ["a"], True):
        store.put("a", "00", arrays, {}, compress)
        sizes.append(path.stat().st_size)
    assert sizes[0] > 800_000 > 500_000 > sizes[1] > 400_000 > 20_000 > sizes[2]


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


def test_no_single_wrong_byte_is_taken_for_a_result(tmp_path):
    store, path = Store(str(tmp_path)), tmp_path / "extract" / "ab" / "ab12.npz"
    store.put("extract", "ab12", ARRAYS, {"count": 4}, ["arm"])
    content = path.read_bytes()
    damaged = 0
    for place in range(len(content)):
        wrong = content[place] ^ (0x80 if place % 2 else 0x01)
        path.write_bytes(content[:place] + bytes([wrong]) + content[place + 1 :])
        for entry in (store.get("extract", "ab12"), store.get("extract", "ab12", ["points", "arm"])):
            damaged += entry is None
            if entry is not None:  # a time of day, or another field that nobody reads
                assert entry.info == {"count": 4}
                assert set(entry.arrays) == set(ARRAYS)
                for name, values in ARRAYS.items():
                    np.testing.assert_array_equal(entry.arrays[name], values)
        assert store.info("extract", "ab12") in (None, {"count": 4})
    assert damaged > len(content)


def test_what_dead_runs_left_is_removed_and_a_mark_is_seen(tmp_path):
    for url in (str(tmp_path / "a"), "memory://marks"):
        store = Store(url)
        store.clean()  # there is nothing yet
        mark = store.mark()
        dead = subprocess.Popen([sys.executable, "-c", ""])
        dead.wait()
        gone = f"{socket.gethostname()}-{dead.pid}-0123abcd"
        fs, folder = connect(f"{url}/.tmp")
        fs.pipe_file(f"{folder}/{gone}", b"half")
        store.clean()
        assert (store.is_marked(mark), fs.exists(f"{folder}/{gone}")) == (True, False)
        assert not Store(f"{url}-other").is_marked(mark)
        store.unmark(mark)
        assert not store.is_marked(mark)


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
