import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from seamosaic.tasks import tracks
from seamosaic.tasks.tracks import PairMatches


def _pair(i, j, features, uv=None):
    features = np.array(features)
    places = [np.column_stack([10.0 * side, np.full(len(side), 5.0)]) for side in features.T]
    return PairMatches(i, j, features, *(places if uv is None else uv))


def test_matches_are_joined_through_images():
    sights = tracks.join([_pair(0, 1, [[3, 7], [4, 8]]), _pair(1, 2, [[7, 1]])])
    assert sights.tie_points == 2
    by_track = {tuple(sights.image[sights.track == t]) for t in (0, 1)}
    assert by_track == {(0, 1, 2), (0, 1)}
    long = sights.track == np.bincount(sights.track).argmax()
    np.testing.assert_array_equal(sights.uv[long, 0], [30, 70, 10])


def test_a_track_with_two_features_of_an_image_is_left_out():
    sights = tracks.join([_pair(0, 1, [[3, 7], [9, 9]]), _pair(0, 2, [[4, 1]]), _pair(1, 2, [[7, 1]])])
    assert sights.tie_points == 1
    np.testing.assert_array_equal(sights.uv[:, 0], [90, 90])


def test_no_matches_no_tie_points():
    assert tracks.join([]).tie_points == 0
    assert tracks.thin(tracks.join([]), (900, 1200), 16, 2).tie_points == 0


@given(st.lists(st.booleans(), min_size=8, max_size=8))
def test_a_tie_point_is_kept_while_two_images_see_it(keep):
    sights = tracks.join([_pair(0, 1, [[0, 0], [1, 1], [2, 2]]), _pair(1, 2, [[0, 0], [1, 1]])])
    mask = np.array(keep)
    left = sights.take(mask)
    seen = np.bincount(sights.track[mask], minlength=3)
    assert left.tie_points == (seen > 1).sum()
    assert (np.bincount(left.track, minlength=1) != 1).all()
    assert sights.kept(mask).sum() == len(left.track)


def test_a_track_through_very_many_images_is_shortened_evenly():
    sights = tracks.join([_pair(k, k + 1, [[0, 0], [1, 1]] if k < 9 else [[0, 0]]) for k in range(199)])
    thinned = tracks.thin(sights, (900, 1200), 16, 2)
    long = thinned.image[thinned.track == np.bincount(thinned.track).argmax()]
    assert len(long) == 40
    assert (long[0], np.diff(long).max()) == (0, 5)
    assert sorted(np.bincount(thinned.track)) == [10, 40]


def test_thinning_takes_the_longest_tracks_of_each_cell():
    rng = np.random.default_rng(0)
    uv = rng.uniform(0, 1200, (500, 2)) * [1, 0.75]
    every = np.arange(500)
    pairs = [PairMatches(0, 1, np.column_stack([every, every]), uv, uv)]
    pairs += [PairMatches(1, 2, np.column_stack([every, every])[:100], uv[:100], uv[:100])]
    thinned = tracks.thin(tracks.join(pairs), (900, 1200), 4, 3)
    assert 12 * 3 <= thinned.tie_points <= 3 * 12 * 3
    assert (np.bincount(thinned.track) == 3).sum() >= 12 * 2
