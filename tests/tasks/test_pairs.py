import numpy as np
from seamosaic.schemas.calibration import Camera
from seamosaic.tasks import pairs
from seamosaic.tasks.navigation import Poses

LENS = Camera(model="brown", width=400, height=300, fx=500, fy=500, cx=199.5, cy=149.5)
DOWN = np.diag([1.0, -1.0, -1.0])


def _line(count, step):
    C = np.column_stack([np.zeros(count), step * np.arange(count), np.full(count, 3.0)])
    return Poses(np.repeat(DOWN[None], count, 0), C)


def test_footprint_on_a_level_seabed():
    outline = pairs.footprints(LENS, _line(1, 1), np.array([3.0]), 2)[0]
    np.testing.assert_allclose(outline.min(0), [-199.5 * 3 / 500, -149.5 * 3 / 500], atol=1e-9)
    np.testing.assert_allclose(outline[0], [-199.5 * 3 / 500, 149.5 * 3 / 500], atol=1e-9)  # top left is north west


def test_only_what_overlaps_enough_is_paired():
    poses = _line(6, 0.9)  # footprints of 1.79 m: half overlaps the next, nothing the second next
    outlines = pairs.footprints(LENS, poses, np.full(6, 3.0))
    found = pairs.overlapping(outlines, np.zeros(6), 0.1, 10)
    np.testing.assert_array_equal(found.images, [[k, k + 1] for k in range(5)])
    assert ((found.overlap > 0.45) & (found.overlap < 0.55)).all()
    grown = pairs.overlapping(outlines, np.full(6, 0.4), 0.1, 10)
    assert len(grown.images) > len(found.images)


def test_of_many_overlaps_the_largest_are_kept():
    outlines = pairs.footprints(LENS, _line(30, 0.05), np.full(30, 3.0))
    found = pairs.overlapping(outlines, np.zeros(30), 0.05, 4)
    counts = np.bincount(found.images.ravel(), minlength=30)
    assert counts.min() >= 4
    assert counts.max() <= 8
    assert np.diff(found.images, axis=1).max() <= 4


def test_where_a_vehicle_stays_in_its_place_the_nearest_are_looked_at():
    rng, count = np.random.default_rng(0), 300
    poses = _line(count, 0.0)
    poses.C_local[:] += rng.normal(0, 0.1, poses.C_local.shape)
    outlines = pairs.footprints(LENS, poses, np.full(count, 3.0))
    found = pairs.overlapping(outlines, np.zeros(count), 0.05, 4)
    assert 2 * count < len(found.images) <= 8 * count
    assert 0.8 < np.median(found.overlap) < 1


def test_images_without_a_pose_pair_with_nothing():
    poses = _line(3, 0.5)
    poses.C_local[1] = np.nan
    outlines = pairs.footprints(LENS, poses, np.full(3, 3.0))
    np.testing.assert_array_equal(pairs.overlapping(outlines, np.zeros(3), 0.1, 10).images, [[0, 2]])


def test_sequential_pairs():
    np.testing.assert_array_equal(pairs.sequential(4, 2).images, [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]])


def test_seen_by_the_other_image():
    poses = _line(2, 0.9)
    pixels = np.array([[200.0, 20.0], [200.0, 280.0]])  # the northern part is what the next image sees
    found = pairs.expected(LENS, pixels, poses, 0, 1, 3.0)
    np.testing.assert_array_equal(pairs.inside(LENS, found, 0.0), [True, False])
    np.testing.assert_allclose(found - pixels, [[0, 0.9 / 3 * LENS.fy]] * 2, atol=1)
    assert pairs.inside(LENS, found, 2.0 / 3 * LENS.fy).all()


def test_depth_is_told_by_large_overlaps_on_a_good_base():
    step = 0.3  # base over height 0.1 to the next; footprints of 1.8 m
    outlines = pairs.footprints(LENS, _line(12, step), np.full(12, 3.0))
    every = pairs.sequential(12, 6).images
    base_to_height = np.diff(every, axis=1)[:, 0] * step / 3
    one = pairs.for_depth(outlines, every, base_to_height, 1).images
    assert (np.diff(one, axis=1) == 2).sum() >= 8  # the next but one: longer bases see less, shorter ones tell less
    assert len(pairs.for_depth(outlines, every, base_to_height, 3).images) > 1.5 * len(one)
    assert len(pairs.for_depth(outlines, every, base_to_height / 10, 3).images) == 0
    assert len(pairs.for_depth(outlines, every, base_to_height * 20, 3).images) == 0
