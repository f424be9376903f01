"""Images that have no laser, or more than one: no false soundings, and a reason."""

import cv2
import numpy as np
import pytest
from seamosaic.catalog.images import UnreadableImage, decode
from seamosaic.schemas.parameters import LaserParameters
from seamosaic.tasks import triangulation as tri

from tests.tasks.laser_scenes import COLOUR, LIGHT, WHITE, Scene, camera, columns, encoded, scene

PARAMETERS = LaserParameters()
VIEW = camera()


def sounded(image: np.ndarray) -> tri.ImageSoundings:
    return tri.sound(image, VIEW, LIGHT, PARAMETERS)


def share_wrong(found: tri.ImageSoundings, made: Scene) -> float:
    s = found.soundings
    return float((np.abs(s.uv[:, 0] - made.u[s.arm, s.uv[:, 1].astype(int)]) > 3).mean())


def bottom(seed: int = 0, contrast: float = 0.15) -> np.ndarray:
    """Linear light (H, W, 3) of a bottom with texture from pixels to stones."""
    rng = np.random.default_rng(seed)
    grey = sum(
        cv2.resize(rng.normal(0, contrast / 2, (VIEW.height // k, VIEW.width // k)), (VIEW.width, VIEW.height))
        for k in (2, 5, 12, 40)
    )
    return 0.25 * np.exp(np.asarray(grey))[..., None] * WHITE


def with_noise(light: np.ndarray, seed: int = 0) -> np.ndarray:
    return encoded(light + np.random.default_rng(seed).normal(0, 0.008, light.shape))


@pytest.mark.parametrize("level", [0, 127, 255])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_even_images_have_no_laser(level: int, channels: tuple[int, ...]):
    found = sounded(np.full((VIEW.height, VIEW.width, *channels), level, np.uint8))
    assert found.reason == "no laser found"
    assert len(found.soundings.uv) == len(found.line_uv) == 0


@pytest.mark.parametrize("seed", range(4))
def test_texture_without_laser(seed: int):
    found = sounded(with_noise(bottom(seed), seed))
    assert found.reason == "no laser found"
    assert len(found.soundings.uv) == 0


def test_two_crosses_by_reflection_give_the_brighter():
    made = scene(25)
    other = columns(VIEW, 2.2, 0.0)
    x = np.arange(VIEW.width)
    ghost = sum(np.exp(-0.5 * ((x - other[k][:, None]) / 2.5) ** 2) for k in (0, 1))
    light = 0.25 * WHITE + 0.1 * np.asarray(ghost)[..., None] * COLOUR
    image = np.maximum(with_noise(light), made.image)
    found = sounded(image)
    assert len(found.soundings.uv) > 700
    assert share_wrong(found, made) < 0.001


def torch(light: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[: VIEW.height, : VIEW.width]
    spot = np.exp(-0.5 * (((u - 250) / 60) ** 2 + ((v - 200) / 50) ** 2))
    return light + 2.5 * spot[..., None] * np.array([0.9, 1.0, 0.9])


def bubbles(light: np.ndarray, seed: int = 3) -> np.ndarray:
    rng, out = np.random.default_rng(seed), light.copy()
    for _ in range(120):
        place = (int(rng.integers(0, VIEW.width)), int(rng.integers(0, VIEW.height)))
        radius = int(rng.integers(3, 22))
        cv2.circle(out, place, radius, (0.8, 0.9, 0.75), 2, cv2.LINE_AA)
        cv2.circle(out, (place[0] - radius // 3, place[1] - radius // 3), 2, (1.0, 1.0, 1.0), cv2.FILLED)
    return out


@pytest.mark.parametrize("disturb", [torch, bubbles])
def test_torch_and_bubbles(disturb):
    assert sounded(with_noise(disturb(bottom()))).reason == "no laser found"
    made = scene(25)
    linear = (made.image / 255.0) ** 2.2
    found = sounded(encoded(disturb(linear)))
    assert len(found.soundings.uv) > 500
    assert share_wrong(found, made) <= 0.001


def grey(image: np.ndarray) -> np.ndarray:
    return np.repeat(image[..., 1:2], 3, axis=2)


def test_torch_in_grey():
    assert sounded(grey(with_noise(torch(bottom())))).reason == "no laser found"
    made = scene(25)
    found = sounded(grey(encoded(torch((made.image / 255.0) ** 2.2))))
    assert len(found.soundings.uv) > 500
    assert share_wrong(found, made) <= 0.001


@pytest.mark.parametrize("snr", [10, 25])
def test_bubbles_in_grey_where_shape_alone_tells(snr: float):
    wrong, count = 0.0, 0
    for seed in range(200, 204):
        assert sounded(grey(with_noise(bubbles(bottom(seed), seed), seed))).reason == "no laser found"
        made = scene(snr, seed)
        found = sounded(grey(encoded(bubbles((made.image / 255.0) ** 2.2, seed))))
        count += len(found.soundings.uv)
        wrong += share_wrong(found, made) * len(found.soundings.uv)
    assert count > 4 * 500
    assert wrong <= 0.001 * count


def test_two_crosses_in_grey_give_the_brighter():
    made = scene(25)
    other = columns(VIEW, 2.2, 0.0)
    ghost = sum(np.exp(-0.5 * ((np.arange(VIEW.width) - other[k][:, None]) / 2.5) ** 2) for k in (0, 1))
    image = np.maximum(with_noise(0.25 * WHITE + 0.1 * np.asarray(ghost)[..., None] * COLOUR), made.image)
    found = sounded(grey(image))
    assert len(found.soundings.uv) > 600
    assert share_wrong(found, made) < 0.001


def test_grey_images_are_measured():
    made = scene(20)
    grey = np.ascontiguousarray(made.image[..., 1])
    for image in (grey, np.repeat(grey[..., None], 3, axis=2)):
        found = sounded(image)
        assert found.reason == ""
        assert len(found.soundings.uv) > 900
        assert share_wrong(found, made) < 0.001


def test_sixteen_bit_png_is_measured():
    made = scene(20)
    for image in (made.image, made.image[..., 1]):
        content = cv2.imencode(".png", image.astype(np.uint16) * 257)[1].tobytes()
        found = sounded(decode(content, VIEW))
        assert len(found.soundings.uv) > 900
        assert share_wrong(found, made) < 0.001


def test_another_size_is_refused():
    image = scene(20).image[:-10]
    found = sounded(image)
    assert found.reason == f"size 900x{VIEW.height - 10}, calibration says 900x{VIEW.height}"
    assert len(found.soundings.uv) == 0
    content = cv2.imencode(".png", image)[1].tobytes()
    with pytest.raises(UnreadableImage, match="size 900x665"):
        decode(content, VIEW)


def test_small_images_have_no_laser():
    tiny = VIEW.model_copy(update={"width": 90, "height": 60})
    found = tri.sound(np.zeros((60, 90, 3), np.uint8), tiny, LIGHT, PARAMETERS)
    assert found.reason == "no laser found"
