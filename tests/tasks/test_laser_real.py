"""Detection on real laser lines (shared/data); how it is judged is said at each test."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from seamosaic.schemas.parameters import LaserParameters
from seamosaic.tasks import laser

SHARED = os.environ.get("SEAMOSAIC_SHARED")
pytestmark = pytest.mark.skipif(SHARED is None, reason="SEAMOSAIC_SHARED names no folder of real recordings")
DATA = Path(SHARED or ".") / "data"


def images(folder: str) -> list[Path]:
    return sorted((DATA / folder).glob("*.png"))


def share_found(points: laser.LaserPoints, expected_uv: np.ndarray, within_px: float) -> float:
    """Share of expected points with a detection in the same row (or the row averaged with it) at most so far away."""
    u, v = points.uv.T
    near = [
        bool(np.any((np.abs(v - y) <= points.step_px) & (np.abs(u - x) <= within_px))) for x, y in expected_uv.tolist()
    ]
    return float(np.mean(near))


@pytest.mark.parametrize("number", range(10))
def test_etna_line(number: int):
    """One bright line from top to bottom. Judged against the middle of the widest clipped run of each row.

    That criterion (the longest run of values of 250 and more) has nothing in common with the detection; rows whose run
    is far from the straight line through all of them (glare on metal) are left out. At least 95 % of the rows must
    have a point within 3 px.
    """
    path = images("etna")[number]
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    expected = widest_runs(grey >= 250)
    fit = np.polynomial.Polynomial.fit(expected[:, 1], expected[:, 0], 1)
    for _ in range(10):
        off = np.abs(expected[:, 0] - fit(expected[:, 1]))
        u, v = expected[off <= max(6.0, float(np.median(off)))].T
        fit = np.polynomial.Polynomial.fit(v, u, 1)
    expected = expected[np.abs(expected[:, 0] - fit(expected[:, 1])) < 8]
    assert len(expected) > 200
    points = laser.detect(np.asarray(grey, np.uint8), LaserParameters())
    assert share_found(points, expected, 3.0) > 0.95


def widest_runs(lit: np.ndarray) -> np.ndarray:
    """Middle (N, 2) u, v of the longest run of each row that has one of 5 px or more."""
    middle = []
    for v, row in enumerate(lit):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(np.int8), [0]])))
        start, end = edges[0::2], edges[1::2]
        if len(start) and (end - start).max() >= 5:
            k = int(np.argmax(end - start))
            middle.append([(start[k] + end[k] - 1) / 2, v])
    return np.array(middle, float).reshape(-1, 2)


@pytest.mark.parametrize("number", range(8))
def test_lsu_lines(number: int):
    """Fifteen green lines on a wall (image*) or on a coral and what is behind it (coral*).

    Judged in a region drawn by hand around them (the chessboard and the window of the room are outside): the
    middle of each run of 2 to 30 px in a row that is greener than red by more than Otsu's threshold of that region.
    On the wall 80 % of these runs must have a point within 3 px, and 60 % of all points must lie within 3 px of the
    light; on the coral, which glows and is not only lines, half of the runs.
    """
    path = images("lsu")[number]
    image = cv2.imread(str(path))
    assert image is not None
    region = np.s_[300:1130, 820:1500]
    greener = np.clip(image[..., 1].astype(int) - image[..., 2], 0, 255).astype(np.uint8)
    threshold, _ = cv2.threshold(np.ascontiguousarray(greener[region]), 0, 255, cv2.THRESH_OTSU)
    lit = np.zeros(greener.shape, bool)
    lit[region] = greener[region] > threshold
    expected = all_runs(lit)
    points = laser.detect(np.asarray(image, np.uint8), LaserParameters())
    chosen = np.random.default_rng(0).permutation(len(expected))[:1500]
    found = share_found(points, expected[chosen], 3.0)
    near_light = cv2.dilate(lit.astype(np.uint8), np.ones((1, 7), np.uint8))
    u, v = np.round(points.uv).astype(int).T
    if path.name.startswith("coral"):
        assert found > 0.5
    else:
        assert found > 0.8
        assert near_light[v, u].mean() > 0.6


def all_runs(lit: np.ndarray) -> np.ndarray:
    """Middle (N, 2) u, v of every run of 2 to 30 px."""
    middle = []
    for v, row in enumerate(lit):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(np.int8), [0]])))
        middle += [[(a + b - 1) / 2, v] for a, b in zip(edges[0::2], edges[1::2], strict=True) if 2 <= b - a <= 30]
    return np.array(middle, float).reshape(-1, 2)
