import cv2
import numpy as np
from seamosaic.schemas.parameters import FeatureParameters
from seamosaic.tasks import features

P = FeatureParameters()


def _seabed(height=480, width=640, seed=0):
    rng = np.random.default_rng(seed)
    image = np.full((height, width), 120, np.uint8)
    for _ in range(900):
        u, v, r, grey = rng.integers(0, width), rng.integers(0, height), rng.integers(2, 9), rng.integers(40, 220)
        cv2.circle(image, (int(u), int(v)), int(r), int(grey), -1, cv2.LINE_AA)
    return cv2.GaussianBlur(image, (0, 0), 1)


def _none(image):
    return np.zeros(image.shape, bool)


def test_features_follow_a_shift_to_a_fraction_of_a_pixel():
    image = _seabed()
    moved = cv2.warpAffine(image, np.array([[1, 0, 7.4], [0, 1, -3.2]]), image.shape[::-1])
    a, b = (features.detect(each, _none(each), P, 0.0) for each in (image, moved))
    pairs = features.match(a, b, 0.8)
    shift = b.uv[pairs[:, 1]] - a.uv[pairs[:, 0]]
    good = np.linalg.norm(shift - [7.4, -3.2], axis=1) < 1
    assert len(pairs) > 200
    assert good.mean() > 0.97
    assert 0.001 < np.abs(shift[good] - [7.4, -3.2]).mean() < 0.2


def test_no_feature_on_what_is_to_be_ignored():
    image = _seabed()
    ignore = _none(image)
    ignore[:, 200:400] = True
    found = features.detect(image, ignore, P)
    assert len(found.uv) > 100
    assert not ((found.uv[:, 0] > 201) & (found.uv[:, 0] < 398)).any()


def test_large_images_are_halved_and_features_stay_at_full_resolution():
    image = _seabed(240, 320)
    large = cv2.resize(image, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    small_p = FeatureParameters(max_pixels=100_000)
    found = features.detect(large, _none(large), small_p)
    reference = features.detect(image, _none(image), small_p)
    full = (reference.uv + 0.5) * 4 - 0.5
    nearest = np.linalg.norm(full[:, None] - found.uv[None], axis=2).min(1)
    assert np.median(nearest) < 1.0
    assert found.uv.max() > 1000


def test_the_strongest_are_kept_everywhere():
    image = _seabed()
    image[:, :320] = (image[:, :320].astype(int) - 120) // 6 + 120  # the left half has little contrast
    found = features.detect(image, _none(image), FeatureParameters(max_features=200))
    assert len(found.uv) == 200
    assert (found.uv[:, 0] < 320).sum() > 60


def test_an_image_without_texture_has_no_features():
    grey = np.full((300, 400), 90, np.uint8)
    found = features.detect(grey, _none(grey), P)
    assert found.descriptors.shape == (0, 128)
    assert features.match(found, found, 0.8).shape == (0, 2)


def test_the_ratio_decides_how_many_matches_there_are():
    a, b = (features.detect(each, _none(each), P) for each in (_seabed(seed=1), _seabed(seed=2)))
    strict, lax = (len(features.match(a, b, ratio)) for ratio in (0.7, 0.95))
    assert 3 * strict < lax


def test_features_lie_where_they_are_and_not_a_part_of_a_pixel_beside():
    image = np.full((480, 640), 90, np.uint8)
    rng = np.random.default_rng(3)
    true = np.column_stack([rng.permutation(np.arange(40, 600, 35)), rng.integers(40, 440, 16)]) + 0.3125
    for u, v in true:
        cv2.circle(image, (round(u * 16), round(v * 16)), 6 * 16, 200, -1, cv2.LINE_AA, shift=4)
    image = cv2.GaussianBlur(image, (0, 0), 1)
    for pixels in (image.size, image.size // 3):
        found = features.detect(image, _none(image), FeatureParameters(max_pixels=pixels)).uv
        off = found[:, None] - true[None]
        nearest = np.linalg.norm(off, axis=2).argmin(0)
        middle = np.median(off[nearest, np.arange(len(true))], axis=0)
        assert np.abs(middle).max() < 0.1


def _turned(image, degrees):
    rotation = cv2.getRotationMatrix2D((319.5, 239.5), degrees, 1)
    return cv2.warpAffine(image, rotation, image.shape[::-1], borderValue=120), rotation


def _right(a, b, pairs, rotation):
    true = a.uv[pairs[:, 0]] @ rotation[:, :2].T + rotation[:, 2]
    return np.linalg.norm(b.uv[pairs[:, 1]] - true, axis=1) < 1.5


def test_features_are_found_again_in_an_image_that_is_turned_if_their_own_gradient_directs_them():
    image = _seabed()
    turned, rotation = _turned(image, 40)
    a, b = (features.detect(each, _none(each), P) for each in (image, turned))
    pairs = features.match(a, b, 0.8)
    assert len(pairs) > 150
    assert _right(a, b, pairs, rotation).mean() > 0.9


def test_north_directs_descriptors_and_tells_more_features_apart():
    image = _seabed()
    turned, rotation = _turned(image, 40)
    north = np.radians(-90), np.radians(-130)  # the image turns anticlockwise, so north does, too
    a, b = (features.detect(e, _none(e), P, n) for e, n in zip((image, turned), north, strict=True))
    pairs, own = (
        features.match(a, b, 0.8),
        features.match(*(features.detect(e, _none(e), P) for e in (image, turned)), 0.8),
    )
    assert len(pairs) > 1.1 * len(own)
    assert _right(a, b, pairs, rotation).mean() > 0.95
    wrong = features.detect(turned, _none(turned), P, north[0])
    assert len(features.match(a, wrong, 0.8)) < 0.3 * len(pairs)


def test_descriptors_of_a_half_turned_image_are_those_of_the_image_rearranged():
    image = _seabed()
    a = features.detect(image, _none(image), P, 0.0)
    b = features.detect(np.ascontiguousarray(image[::-1, ::-1]), _none(image), P, 0.0)
    rearranged = b._replace(descriptors=features.half_turned(b.descriptors))
    pairs = features.match(a, rearranged, 0.8)
    assert len(pairs) > 0.6 * len(a.uv)
    assert np.median(np.abs(a.uv[pairs[:, 0]] + b.uv[pairs[:, 1]] - [639, 479])) < 0.3
    assert len(features.match(a, b, 0.8)) < 0.1 * len(pairs)


def test_no_match_is_sought_where_it_is_not_expected():
    image = _seabed()
    a = features.detect(image, _none(image), P, 0.0)
    moved = a._replace(uv=a.uv + np.float32([30, 0]))
    everywhere = features.match(a, moved, 0.8)
    assert len(everywhere) > 0.95 * len(a.uv)
    near = features.match(a, moved, 0.8, features.Expected(a.uv + [25, 0], 40.0))
    assert len(near) > 0.95 * len(a.uv)
    assert (near[:, 0] == near[:, 1]).mean() > 0.999
    far = features.match(a, moved, 0.8, features.Expected(a.uv + [400, 0], 40.0))
    assert (far[:, 0] == far[:, 1]).sum() == 0
