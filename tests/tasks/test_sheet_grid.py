"""Interpolated inverse depths against the exact intersection of ray and sheet."""

import numpy as np
import pytest
from seamosaic.schemas.calibration import Camera, Port
from seamosaic.tasks.sheet_grid import on_sheets
from seamosaic.tasks.triangulation import intersect

from tests.tasks.laser_scenes import LIGHT, camera

BROWN = Camera(
    model="brown", width=1216, height=912, fx=1584, fy=1586, cx=610, cy=450, distortion=(-0.05, 0.02, 0.0004, -0.0003)
)
PORT = BROWN.model_copy(update={"model": "flat-port", "distortion": (), "port": Port(distance=0.035, thickness=0.012)})


@pytest.mark.parametrize("view", [BROWN, PORT, camera(150)])
def test_interpolation_is_good_to_a_fraction_of_a_pixel(view: Camera):
    uv = np.random.default_rng(0).uniform(0, [view.width - 1, view.height - 1], (40_000, 2))
    seen = on_sheets(view, LIGHT, *uv.T)
    for number, sheet in enumerate(LIGHT.sheets):
        X, distance = intersect(view, sheet, uv)
        beside = intersect(view, sheet, uv + [0.1, 0])[1]
        inverse_depth, change = 1 / X[:, 2], (beside / distance - 1) / 0.1
        near = (inverse_depth > 1 / 8) & (inverse_depth < 2)
        assert near.sum() > 1000
        off_px = (seen.inverse_depth[number] - inverse_depth) / np.abs(inverse_depth * change)
        assert np.abs(off_px[near]).max() < 0.15
        assert seen.per_px[number][near] == pytest.approx(change[near], rel=0.1)
