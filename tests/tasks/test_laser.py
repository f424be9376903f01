"""Laser points (paper III.B) on synthetic lines of known place."""

import numpy as np
import pytest
from seamosaic.schemas.parameters import LaserParameters
from seamosaic.tasks import laser

PARAMETERS = LaserParameters()
LASER_BGR = np.array([0.25, 1.0, 0.2])


def line_image(
    seed: int = 0,
    size: tuple[int, int] = (500, 640),
    slope: float = 0.9,
    start: float = 90.3,
    sigma: float = 2.6,
    height: float = 120.0,
    background: float = 60.0,
    noise: float = 3.0,
    speckle: float = 0.0,
    texture: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """A colour image with one falling line, and the line's true column in each row."""
    rng = np.random.default_rng(seed)
    rows = np.arange(size[0])
    truth = start + slope * rows
    shape = np.exp(-0.5 * ((np.arange(size[1]) - truth[:, None]) / sigma) ** 2)
    if speckle:
        shape = shape * rng.gamma(1 / speckle**2, speckle**2, shape.shape)
    ground = np.full(size, background) + texture * stones(rng, size)
    image = ground[..., None] * np.array([0.95, 1.0, 0.6]) + height * shape[..., None] * LASER_BGR
    image += rng.normal(0, noise, image.shape) if noise else 0
    return np.clip(np.round(image), 0, 255).astype(np.uint8), truth


def stones(rng: np.random.Generator, size: tuple[int, int], count: int = 250) -> np.ndarray:
    """Pale and dark ellipses, from -1 to 1."""
    ground = np.zeros(size)
    v, u = np.mgrid[: size[0], : size[1]]
    for _ in range(count):
        cv, cu = rng.uniform(0, size[0]), rng.uniform(0, size[1])
        a, b = rng.uniform(1.5, 10, 2)
        window = np.s_[max(0, int(cv) - 12) : int(cv) + 13, max(0, int(cu) - 12) : int(cu) + 13]
        inside = ((u[window] - cu) / a) ** 2 + ((v[window] - cv) / b) ** 2 < 1
        ground[window][inside] = rng.uniform(-1, 1)
    return ground


def errors(points: laser.LaserPoints, truth: np.ndarray) -> np.ndarray:
    return points.uv[:, 0] - np.interp(points.uv[:, 1], np.arange(len(truth)), truth)


def test_noiseless_line_is_found_in_every_row_without_bias():
    image, truth = line_image(noise=0)
    points = laser.detect(image, PARAMETERS)
    assert points.step_px == 1
    assert len(points.uv) > 0.97 * len(truth)
    assert np.abs(errors(points, truth)).max() < 0.03
    assert 2.4 < np.median(points.width_px) < 2.9
    assert 100 < np.median(points.prominence) < 125


def test_pixel_noise_gives_the_predicted_scatter():
    image, truth = line_image(noise=6.0)
    points = laser.detect(image, PARAMETERS)
    error = errors(points, truth)
    # Cramér-Rao: 1.06 sqrt(2.6) 6 / 120 = 0.085 px is the best that can be
    assert 0.08 < error.std() < 0.16
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(len(error))
    assert 0.7 < (error / points.sigma_px).std() < 1.5


def test_speckle_is_measured_from_the_scatter_of_the_points():
    error, sigma = {}, {}
    for speckle in (0.0, 0.5):
        image, truth = line_image(speckle=speckle)
        points = laser.detect(image, PARAMETERS)
        error[speckle], sigma[speckle] = errors(points, truth), points.sigma_px
        assert 0.7 < (error[speckle] / sigma[speckle]).std() < 1.5
    assert error[0.5].std() > 2 * error[0.0].std()
    assert np.median(sigma[0.5]) > 2 * np.median(sigma[0.0])
    assert error[0.5].std() < 0.6


def test_a_saturated_plateau_does_not_draw_the_peak_to_one_side():
    image, truth = line_image(height=900.0, background=60.0)
    points = laser.detect(image, PARAMETERS)
    assert (image[..., 1] == 255).sum() > 5 * len(truth)
    assert len(points.uv) * points.step_px > 0.95 * len(truth)
    assert abs(errors(points, truth).mean()) < 0.02


@pytest.mark.parametrize(("factor", "sigma"), [(1, 1.0), (1, 2.6), (3, 7.8), (4, 10.0)])
def test_wide_lines_of_large_images_are_found_as_well_as_narrow_ones(factor: int, sigma: float):
    size = (400 * factor, 640 * factor)
    image, truth = line_image(size=size, sigma=sigma, start=90.3 * factor)
    points = laser.detect(image, PARAMETERS)
    assert 0.6 < sigma / points.step_px < 4
    assert 0.6 * sigma < np.median(points.width_px) < 1.5 * sigma
    assert len(points.uv) > 0.95 * size[0] / points.step_px - 4
    assert abs(errors(points, truth).mean()) < 0.02 * sigma
    assert errors(points, truth).std() < 0.1 * sigma


def test_line_is_found_on_texture_and_stones_are_not():
    image, truth = line_image(texture=45.0, background=110.0, height=90.0)
    points = laser.detect(image, PARAMETERS)
    near = np.abs(errors(points, truth)) < 3
    assert near.sum() > 0.93 * len(truth)
    assert (~near).sum() < 0.03 * len(truth)


def test_a_strobe_image_without_laser_has_hardly_a_point():
    for seed in range(3):
        image, _ = line_image(seed, texture=60.0, background=110.0, height=0.0)
        assert len(laser.detect(image, PARAMETERS).uv) < 20


def test_line_is_found_in_a_vignetted_image_where_it_is_darker_than_the_middle():
    image, truth = line_image(background=170.0, height=60.0, noise=2.0)
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    falloff = np.exp(-(((u - 320) / 300) ** 2) - ((v - 250) / 230) ** 2)
    image = np.round(image * falloff[..., None]).astype(np.uint8)
    green = image[..., 1].astype(float)
    points = laser.detect(image, PARAMETERS)
    assert np.median(green[:60].max(axis=1)) < green.mean()  # a global mean + k sigma would lose these rows
    assert (points.uv[:, 1] < 60).sum() > 40
    assert np.abs(errors(points, truth)).max() < 2


def test_grey_images_are_scanned_too():
    image, truth = line_image()
    grey = np.ascontiguousarray(image[..., 1])
    for version in (grey, np.repeat(grey[..., None], 3, axis=2)):
        points = laser.detect(version, PARAMETERS)
        assert len(points.uv) > 0.97 * len(truth)
        assert np.abs(errors(points, truth)).max() < 1


def test_thresholds_decide():
    image, truth = line_image(height=14.0, noise=3.0)

    def count(**change: float) -> int:
        return len(laser.detect(image, PARAMETERS.model_copy(update=change)).uv)

    found = count()
    assert 0.2 * len(truth) < found <= 1.1 * len(truth)
    assert count(intensity_sigmas=20) < 0.2 * found
    assert count(curvature_sigmas=20) < 0.2 * found
    assert count(chain_min_points=1000) == 0
    assert count(colour_share=0.0) < 0.2 * found
    assert count(chain_min_points=1, curvature_sigmas=2.0, intensity_sigmas=1.5, colour_share=10.0) > 1.5 * found


@pytest.mark.parametrize("level", [0, 128, 255])
@pytest.mark.parametrize("shape", [(400, 600, 3), (400, 600), (20, 30, 3)])
def test_empty_images_have_no_points(level: int, shape: tuple[int, ...]):
    points = laser.detect(np.full(shape, level, np.uint8), PARAMETERS)
    assert len(points.uv) == 0
    assert points.uv.shape == (0, 2)


def test_pure_noise_has_no_points():
    noise = np.random.default_rng(0).normal(100, 10, (500, 700, 3))
    assert len(laser.detect(np.clip(noise, 0, 255).astype(np.uint8), PARAMETERS).uv) == 0


def test_distance_in_row():
    uv = np.array([[10.0, 0], [25, 0], [31, 0], [7, 1]])
    points = laser.LaserPoints(uv, *np.zeros((3, 4)), 1)
    np.testing.assert_array_equal(laser.distance_in_row(points), [15, 6, 6, np.inf])
    assert len(laser.distance_in_row(laser.no_points())) == 0


def test_mask_covers_the_light_and_little_else():
    image, truth = line_image(noise=0)
    points = laser.detect(image, PARAMETERS)
    erased = laser.mask(image.shape[:2], points.uv, 10.0)
    rows = np.arange(20, 480)
    assert erased[rows, np.round(truth[rows]).astype(int)].all()
    assert image[20:480, 30:-30, 1][~erased[20:480, 30:-30]].max() < 63
    assert 0.02 < erased.mean() < 0.06
    assert not laser.mask((50, 60), np.zeros((0, 2)), 3.0).any()
    assert not laser.mask((50, 60), np.array([[1e6, -1e6], [-400.0, 20.0]]), 3.0).any()


def test_glow_is_the_green_light_that_no_row_has_a_peak_of_and_that_touches_the_line():
    image, truth = line_image(noise=1.0, background=80.0)
    bar, apart = np.s_[300:306, 368:440], np.s_[100:106, 400:440]
    for place in (bar, apart):
        image[place] += np.array([8, 45, 6], np.uint8)
    line = np.column_stack([truth, np.arange(len(truth))])
    found = laser.glow(image, line, 9.0, (3, 3))
    erased = laser.mask(image.shape[:2], np.concatenate([line, found]), 9.0)
    assert erased[bar].all()
    assert not erased[apart].any()
    assert len(laser.glow(np.ascontiguousarray(image[..., 1]), line, 9.0, (3, 3))) == 0
    assert len(laser.glow(image, np.zeros((0, 2)), 9.0, (3, 3))) == 0


def test_green_organisms_that_touch_the_line_are_no_glow():
    image, truth = line_image(noise=1.0, background=100.0)
    leaf, sponge = np.s_[180:240, 290:360], np.s_[380:430, 250:600]
    image[leaf] = (image[leaf] * [0.5, 0.9, 0.5]).astype(np.uint8)
    image[sponge] = (image[sponge] * [0.8, 1.2, 0.8]).astype(np.uint8)
    line = np.column_stack([truth, np.arange(len(truth))])
    found = laser.glow(image, line, 6.0, (3, 3))
    erased = laser.mask(image.shape[:2], np.concatenate([line, found]), 6.0)
    usual = laser.mask(image.shape[:2], line, 6.0)
    np.testing.assert_array_equal(erased[leaf], usual[leaf])
    assert 1.5 * usual[sponge].mean() < erased[sponge].mean() < 0.4
