"""Steep faces cut out of images: which image, which pixels, and what is left to the orthomosaic."""

import numpy as np
import pytest
from seamosaic.schemas.calibration import Camera
from seamosaic.tasks import nodes, occlusion, steep_faces
from seamosaic.tasks.frames import LocalAffine
from seamosaic.tasks.grids import Grid, cell_centres
from seamosaic.tasks.terrain import Terrain

CELL, PIXEL = 0.05, 0.002
LENS = Camera(model="brown", width=1200, height=900, fx=1500.0, fy=1500.0, cx=599.5, cy=449.5)
GRID = Grid(CELL, -40, 40, 80, 80)
DOWN = np.diag([1.0, -1.0, -1.0])


def _step():
    """Ground at 0 in the west and at 0.6 m in the east, with a side of 70 degrees between that faces west."""
    x, _ = cell_centres(GRID)
    return np.clip(x * np.tan(np.radians(70)), 0, 0.6)


def _terrain(z):
    return Terrain(z, GRID, LocalAffine(np.eye(3), np.zeros(3)))


def _mesh(z):
    x, y = cell_centres(GRID)
    number = np.arange(z.size).reshape(z.shape)
    a, b, c, d = (number[i : i + 79, j : j + 79].ravel() for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()]), np.concatenate(
        [np.column_stack([a, c, b]), np.column_stack([b, c, d])]
    )


def _shot(number, erase=None):
    scale = nodes.quality_scale(LENS)
    shape = -(-LENS.height // scale), -(-LENS.width // scale)
    return nodes.Shot(number, LENS, nodes.qualities(np.zeros(shape, bool) if erase is None else erase(shape), scale))


def _lie(x, y, z=2.5):
    return nodes.lie(LocalAffine(np.eye(3), np.zeros(3)), DOWN, np.array([x, y, z]))


def _charts(views, z=None):
    z = _step() if z is None else z
    X, triangles = _mesh(z)
    times = {shot.number: 1 for shot, _ in views}
    return X, triangles, steep_faces.charts(X, triangles, _terrain(z), GRID, views, times, PIXEL)


def test_the_image_that_faces_a_side_shows_it():
    X, triangles, found = _charts([(_shot(k), _lie(x, 0, 3.5)) for k, x in enumerate((0.8, -0.8, -0.1))])
    assert found[0].number == 1
    shown = X[triangles[np.concatenate([chart.faces for chart in found])]]
    assert (np.ptp(shown[..., 2], axis=1) > 0.02).all()  # steep ones only
    assert shown[..., 0].min() > -CELL
    assert shown[..., 0].max() < 0.3
    u, v = found[0].uv[0, 0]
    x, y, z = X[triangles[found[0].faces[0], 0]]
    assert (u, v) == pytest.approx((599.5 + 1500 * (x + 0.8) / (3.5 - z), 449.5 - 1500 * y / (3.5 - z)), abs=0.01)
    assert found[0].range_m == pytest.approx(np.hypot(3.2, 0.9), rel=0.1)


def test_a_side_that_no_image_faces_is_left_to_the_orthomosaic():
    assert _charts([(_shot(0), _lie(0.9, 0))])[2] == []
    assert _charts([(_shot(0), _lie(-0.9, 0))], np.zeros(GRID.shape))[2] == []
    assert _charts([])[2] == []


def test_neither_the_laser_nor_what_hides_it_is_shown():
    def lit(shape):
        erase = np.zeros(shape, bool)
        erase[:, shape[1] // 2 :] = True  # where the side is seen from the west
        return erase

    west = _lie(-0.8, 0, 3.5)
    assert _charts([(_shot(0), west)])[2] != []
    assert _charts([(_shot(0, lit), west)])[2] == []
    z = _step()
    z[:, 30:32] = 2.6  # a wall 0.45 m west of the side: its shadow ends 0.66 m east of it at 0 m, 0.41 m at 0.6 m
    X, triangles, found = _charts([(_shot(0), west)], z)
    assert not [chart for chart in found if (X[triangles[chart.faces], 0] > -CELL).all(1).any()]


def test_a_laser_line_between_the_corners_of_a_large_face_is_not_shown():
    near = _lie(-0.3, 0, 1.4)
    _, _, (chart, *_) = _charts([(_shot(0), near)])
    across = chart.uv[..., 0]
    column = across[np.ptp(across, axis=1).argmax()].mean()
    crossed = (across.min(1) < column) & (across.max(1) > column)
    assert crossed.any()

    def line(shape):
        erase = np.zeros(shape, bool)
        erase[: shape[0] // 2, int((column + 0.5) / nodes.quality_scale(LENS))] = True
        return erase

    left = _charts([(_shot(0, line), near)])[2]
    shown = [uv for one in left for uv in one.uv if uv[:, 0].min() < column < uv[:, 0].max()]
    assert shown
    assert min(uv[:, 1].min() for uv in shown) > LENS.height / 2


def test_tiles_without_steep_faces_that_images_show_do_without_a_scene(monkeypatch):
    asked = []
    made = occlusion.scene
    monkeypatch.setattr(occlusion, "scene", lambda *a: asked.append(a) or made(*a))
    _charts([(_shot(0), _lie(-0.9, 0))], np.zeros(GRID.shape))
    _charts([(_shot(0), _lie(0.9, 0))])  # the side faces the other way
    assert asked == []
    assert _charts([(_shot(0), _lie(-0.8, 0, 3.5))])[2] != []
    assert len(asked) == 1


def test_charts_are_laid_side_by_side_and_their_faces_stay_on_them():
    rng = np.random.default_rng(0)
    found = []
    for k in range(9):
        corner = rng.uniform(100, 700, 2)
        found.append(steep_faces.Chart(k % 2, np.arange(2) + 2 * k, corner + rng.uniform(0, 90, (2, 3, 2)), 3.0))
    times = {0: 1, 1: 2}
    placed = steep_faces.arranged(found, times, 200, 1000)
    assert set(placed) == set(range(9))
    taken = np.zeros((1000, 200), int)
    for place in placed.values():
        taken[place.row : place.row + place.height, place.column : place.column + place.width] += 1
    assert taken.max() == 1
    rows = steep_faces.sheet_rows(placed)
    assert taken[rows - 1].any()
    assert not taken[rows:].any()
    triangles = np.arange(54).reshape(18, 3) % 20
    split = steep_faces.split(triangles, rng.uniform(0, 1, (20, 2)), found, placed, times, 200)
    for k, place in placed.items():
        uv = split.uv[split.triangles[found[k].faces]]
        pixel = uv * [200, 200 + rows] - [place.column, 200 + place.row]
        expected = (found[k].uv + 0.5) / times[found[k].number] - [place.left, place.top]
        np.testing.assert_allclose(pixel, expected, atol=1e-6)
        assert (pixel > 1).all()
        assert (pixel < [place.width - 1, place.height - 1]).all()
        assert (split.source[split.triangles[found[k].faces]] == triangles[found[k].faces]).all()
    # what does not fit stays away
    assert 0 < len(steep_faces.arranged(found, times, 200, 100)) < 9


def test_cuttings_are_as_bright_as_what_is_around_them():
    chart = steep_faces.Chart(0, np.arange(2), np.array([[[10, 10], [30, 12], [12, 30.0]]] * 2), 3.0)
    place = steep_faces.arranged([chart], {0: 1}, 100, 100)[0]
    image = np.full((60, 80, 3), (90, 100, 110), np.uint8)
    light = (np.array([90, 100, 110]) / 255) ** 2.2

    def tone(u, v, range_m):
        return np.full((*u.shape, 3), 2.0, np.float32), np.full((*u.shape, 3), 0.01, np.float32)

    part = steep_faces.cut_out(chart, place, image, 1, tone, 2.2, (2 * light - 0.01) * 1.2)
    found = (part[10, 10] / 255) ** 2.2
    np.testing.assert_allclose(found, (2 * light - 0.01) * 1.2, rtol=0.03)
    far = steep_faces.cut_out(chart, place, image, 1, tone, 2.2, (2 * light - 0.01) * 9)
    np.testing.assert_allclose((far[10, 10] / 255) ** 2.2, (2 * light - 0.01) * 1.5, rtol=0.03)
    assert (steep_faces.cut_out(chart, place, image, 1, None, 1.0, light) == image[0, 0]).all()
