"""What finds images, pairs and tiles by place, beside what looks at each of them; and sigmas along the map's axes."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from seamosaic.tasks import grids
from seamosaic.tasks.grids import Grid
from seamosaic.workflows import mapping, products
from seamosaic.workflows.job import Done
from seamosaic.workflows.maps_inputs import Image, Pair


def image(row: int) -> Image:
    return Image(row, f"{row}.jpg", "", f"{row}", True, 3.0)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1), st.integers(0, 12))
def test_what_is_found_by_place_is_what_lies_there(seed: int, count: int):
    rng = np.random.default_rng(seed)
    whole = Grid(0.5, int(rng.integers(-50, 50)), int(rng.integers(-50, 50)), 40, 25)
    tiles = [(tile, str(k)) for k, tile in enumerate(grids.tiles(whole, 8))]
    part = Grid(0.5, *(int(value) for value in rng.integers(-60, 90, 2)), *(int(v) for v in rng.integers(1, 30, 2)))
    placed = mapping._Placed(tiles)  # pyright: ignore[reportArgumentType]
    assert placed.overlapping(part) == [one for one in tiles if grids.intersection(part, one[0])]

    images = [image(3 * k) for k in range(count)]
    linked = [Pair(3 * i, 3 * j, f"{i}-{j}") for i in range(count) for j in range(i + 1, count) if rng.random() < 0.3]
    some = [one for one in images if rng.random() < 0.4]
    rows = {one.row for one in some}
    expected = tuple(pair for pair in linked if pair.i in rows and pair.j in rows)
    assert mapping._Pairs(linked).images(some) == expected


def test_images_are_found_where_their_footprints_with_a_margin_touch():
    square = np.array([[0.0, 0.0], [2, 0], [2, 2], [0, 2]])
    outlines = np.stack([square, square + 5, square + (20, 0)])
    images = [image(0), image(2)]
    footprints = mapping._Footprints(outlines, images)
    margin, other = mapping._margins(outlines, images).tolist()
    assert margin == other
    assert footprints.touching(Grid(1.0, 3, 2, 2, 2)) == ()
    assert 0 < margin < 1
    assert footprints.touching(Grid(0.1, 20, 20, 5, 5)) == (images[0],)
    assert footprints.touching(Grid(0.1, round(10 * (2 + margin)) + 1, 20, 5, 5)) == ()
    assert footprints.touching(Grid(1.0, -5, 10, 40, 20)) == tuple(images)
    moved = mapping._Footprints(outlines, images, [0.0, 3.0])
    assert moved.touching(Grid(1.0, 17, 2, 1, 1)) == (images[1],)
    assert moved.touching(Grid(1.0, 3, 2, 2, 2)) == ()
    assert mapping._Footprints(outlines, []).touching(Grid(1.0, -5, 10, 40, 20)) == ()


@pytest.mark.parametrize("turn_deg", [0.0, 2.0, 90.0, 137.0])
def test_sigmas_are_along_the_axes_of_the_map(turn_deg: float):
    rng = np.random.default_rng(0)
    root = np.array([[0.3, 0.0, 0.0], [-0.1, 0.1, 0.0], [0.0, 0.0, 0.02]])
    covariance = root @ root.T
    R_map_local = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    drawn = rng.normal(size=(200_000, 3)) @ root.T @ R_map_local.T
    solution = SimpleNamespace(sigma_m=np.sqrt(np.diag(covariance))[None], covariance_xy_m2=covariance[None, 0, 1])
    (sigma,) = products._along_map_axes(solution, R_map_local[None], [0])  # pyright: ignore[reportArgumentType]
    assert sigma == pytest.approx(drawn.std(0), rel=0.01)


@pytest.mark.parametrize(("altitude", "expected"), [(np.nan, [6, 6, 6.5, 7, 7]), (4.0, [3, 6, 3, 7, 3])])
def test_heights_are_the_lasers_then_the_altimeters_then_those_around(altitude: float, expected: list[float]):
    frames = xarray.Dataset({"altitude": ("image", np.full(5, altitude))})
    state = SimpleNamespace(plan=SimpleNamespace(range_m=np.full(5, 3.0)), opened=SimpleNamespace(frames=frames))
    told = {0: None, 1: 6.0, 3: 7.0}
    extracted = {row: Done("extract", "", True, 0.0, {"range_m": value}) for row, value in told.items()}
    found = mapping.heights(state, extracted, [], SimpleNamespace())  # pyright: ignore[reportArgumentType]
    assert found.tolist() == expected


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (["", "rejected: too dark"], "no image has a pose"),
        (
            ["rejected: 12 bits", "rejected: 12 bits", "rejected: too dark"],
            "no image of 3 can be used; 2 of them: reje",
        ),
    ],
)
def test_why_there_is_no_image(status: list[str], expected: str):
    assert mapping._no_images(status).startswith(expected)
