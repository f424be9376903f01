"""The simulated seabed, and rays and shadows on it, against closed forms and brute force."""

import numpy as np
import pytest
from seamosaic.schemas.scene import SCENES, TerrainScene
from seamosaic.tasks import simulation_terrain as st

DEPTH_M = 10.0


def make(seed: int = 0, half_m: float = 2.0, **fields) -> st.Terrain:
    return st.make_terrain(TerrainScene(depth_m=DEPTH_M, **fields), half_m, np.random.default_rng(seed))


def fan(n: int = 60, reach: float = 0.5):
    """Downward unit vectors (n, n, 3) up to `reach` from the vertical, rows north to south."""
    x, y = np.meshgrid(np.linspace(-reach, reach, n), np.linspace(reach, -reach, n))
    d = np.stack([x, y, -np.ones_like(x)], -1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def brute(terrain: st.Terrain, origin: np.ndarray, directions: np.ndarray, step_m: float = 1e-4) -> np.ndarray:
    """Distances at which rays (N, 3) are first below the seabed, tried every step."""
    s = np.arange(0.5, 5, step_m)
    found = []
    for d in directions:
        x, y, z = origin[:, None] + s * d[:, None]
        found.append(s[np.argmax(z < st.height(terrain, x, y))])
    return np.array(found)


def test_the_box_is_225_mm_high_and_as_wide_as_said():
    box = make(kind="box")
    assert st.height(box, np.zeros(1), np.zeros(1))[0] + DEPTH_M == pytest.approx(0.225, abs=1e-6)
    assert box.h.min() == 0
    area = box.h.sum() / 0.225 * box.cell_m**2
    assert area == pytest.approx(0.6 * 0.45, rel=0.01)


def test_the_pool_slopes_down_at_45_degrees_to_a_flat_floor():
    pool = make(kind="pool", half_m=3.0)
    profile = pool.h[:, pool.h.shape[1] // 2]
    slope = np.degrees(np.arctan(np.diff(profile) / pool.cell_m))
    inside = (profile[1:] < -0.05) & (profile[:-1] > -1.55)
    assert slope[inside].mean() == pytest.approx(-45, abs=0.01)
    assert slope[inside].std() < 0.1
    assert profile[-100:] == pytest.approx(-1.6)
    assert (profile[:100] == 0).all()


def test_relief_has_the_spread_asked_for_and_its_own_seed():
    a, b, again = (make(seed, kind="rough", relief_m=0.1, boulders_per_m2=0) for seed in (0, 1, 0))
    assert 0.08 < a.h.std() < 0.12
    assert abs(np.corrcoef(a.h.ravel(), b.h.ravel())[0, 1]) < 0.5
    assert np.array_equal(a.h, again.h)


def test_boulders_stand_on_the_relief():
    bare, stony = (make(kind="rough", boulders_per_m2=n, boulder_height_m=0.4) for n in (0, 1))
    raised = stony.h - bare.h
    assert raised.min() >= -1e-6
    assert 0.05 < raised.max() <= 0.4 + 1e-6
    assert 0.02 < (raised > 0.01).mean() < 0.6


def test_ripples_have_their_height_and_length():
    sand = make(kind="rough", relief_m=0, boulders_per_m2=0, ripple_height_m=0.05, ripple_length_m=0.5)
    assert np.ptp(sand.h) == pytest.approx(0.05, rel=0.01)
    # crests cross a line along x every 0.5 / 0.8 metres
    crossings = np.diff(np.sign(sand.h), axis=1).astype(bool).sum(axis=1).mean()
    assert crossings == pytest.approx(2 * 4 / (0.5 / 0.8), rel=0.25)


def test_north_is_at_the_top_of_the_grids_rows():
    slope = make(kind="pool")
    assert st.height(slope, np.zeros(1), np.array([1.5]))[0] < st.height(slope, np.zeros(1), np.array([-1.5]))[0]
    assert slope.h[-1, 0] < slope.h[0, 0]


@pytest.mark.parametrize("name", ["box", "pool", "reef", "sand"])
def test_rays_meet_the_seabed_where_brute_force_says(name: str):
    scene = SCENES[name].terrain
    terrain = st.make_terrain(scene, 2.5, np.random.default_rng(3))
    origin, d = np.array([0.13, -0.4, 2.0 - scene.depth_m]), fan(16).reshape(-1, 3)
    s = st.cast(terrain, origin, d)
    wrong = s - brute(terrain, origin, d)
    # brute force is late by up to its own step
    assert wrong.min() > -4e-4
    assert wrong.max() < 3e-4
    P = origin + s[:, None] * d
    assert np.median(abs(P[:, 2] - st.height(terrain, P[:, 0], P[:, 1]))) < 1e-5


@pytest.mark.parametrize("name", ["plane", "box", "reef"])
def test_whole_images_are_cast_as_single_rays_are(name: str):
    scene = SCENES[name].terrain
    terrain = st.make_terrain(scene, 2.5, np.random.default_rng(3))
    # pixels of 3 mm, as images have
    origin, d = np.array([0.2, 0.1, 1.2 - scene.depth_m]), fan(301, 0.45)
    s = st.cast_image(terrain, origin, d)
    single = st.cast(terrain, origin, d.reshape(-1, 3)).reshape(s.shape)
    assert s.shape == (301, 301)
    assert np.percentile(abs(s - single), 99.9) < 1e-4
    assert (abs(s - single) > 1e-3).mean() < 1e-4
    assert np.ptp(s) > 0.05


def test_rays_upwards_never_meet_it():
    up = np.array([[0, 0, 1.0], [0.6, 0, 0.8], [1, 0, 0]])
    assert np.isinf(st.cast(make(kind="plane"), np.array([0, 0, -9.0]), up)).all()


def test_the_shadow_of_the_box_has_the_right_length():
    box = make(kind="box")
    x = np.linspace(0.31, 0.9, 119)
    ground = np.column_stack([x, np.zeros_like(x), np.full_like(x, -DEPTH_M)])
    light = np.array([-1.0, 0.0, 1.5 - DEPTH_M])
    dark = st.occluded(box, ground, light)
    # the ray over the box's edge: 1.3 m along while it falls from 1.5 to 0.225 m
    end = 0.3 + 0.225 * 1.3 / (1.5 - 0.225)
    assert dark[x < end - 0.015].all()
    assert not dark[x > end + 0.015].any()
    assert not st.occluded(box, ground, np.array([0.6, 0, 1.5 - DEPTH_M]))[x > 0.45].any()


def test_nothing_hides_a_plane():
    rng = np.random.default_rng(0)
    X = np.column_stack([rng.uniform(-1, 1, (50, 2)), np.full(50, -DEPTH_M)])
    assert not st.occluded(make(kind="plane"), X, np.array([1.2, 0, 2 - DEPTH_M])).any()
    assert st.occluded(make(kind="plane"), np.zeros((0, 3)), np.zeros(3)).shape == (0,)


def test_normals_of_a_slope():
    pool = make(kind="pool", half_m=3.0)
    n = st.sample_normals(pool, st.normals(pool), np.zeros((1, 1)), np.zeros((1, 1)))[0, 0]
    assert n == pytest.approx([0, np.sqrt(0.5), np.sqrt(0.5)], abs=1e-3)


def test_no_node_rises_above_its_neighbours_cones():
    terrain = make(kind="rough", half_m=0.5, boulders_per_m2=4)
    h, n = terrain.h.astype(float), terrain.h.shape[0]
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, n, (2, 2, 4000))
    distance = np.hypot(*(a - b)) * terrain.cell_m
    rises = h[tuple(b)] - h[tuple(a)]
    assert (rises <= terrain.cone[tuple(a)] * distance + 1e-6).all()
    assert terrain.cone.min() >= 0
