import numpy as np
import pytest
from seamosaic.tasks.calibration_solve import Layout, colours, jacobian, solve, unit_sigma


def chain(count: int) -> np.ndarray:
    return np.array([[i, i + 1] for i in range(count - 1)] + [[0, -1]])


def test_images_that_share_a_residual_differ_in_colour():
    rows = np.vstack([chain(9), [[2, 7], [3, 3]]])
    colour = colours(9, rows)
    assert all(colour[i] != colour[j] for i, j in rows.tolist() if j >= 0 and i != j)
    assert colour.max() < 4


def test_jacobian_equals_one_made_column_by_column():
    rng, rows = np.random.default_rng(0), chain(6)
    layout = Layout(2, 6, 2, rng.uniform(0.1, 3, 14))

    def residuals(x: np.ndarray) -> np.ndarray:
        shared, images = layout.split(x)
        first, second = images[rows[:, 0]], np.where(rows[:, 1:] >= 0, images[rows[:, 1]], 0.0)
        return np.sin(shared[0]) * first[:, 0] + shared[1] * second[:, 1] ** 2 + first[:, 1] * second[:, 0]

    x = rng.normal(size=14)
    J = jacobian(residuals, x, layout, rows)
    h = 1e-6
    expected = np.stack([(residuals(x + h * e) - residuals(x - h * e)) / (2 * h) for e in np.eye(14)], 1)
    assert np.allclose(J, expected, atol=1e-4)


@pytest.mark.parametrize("stated", [0.5, 1.0, 3.0])
def test_unit_sigma_finds_the_true_noise(stated: float):
    rng, n = np.random.default_rng(1), 400
    t = np.linspace(-1, 1, n)
    y = 2 + 3 * t + rng.normal(0, 1.0, n)
    layout = Layout(2, 0, 0, np.ones(2))
    found = solve(lambda x: (x[0] + x[1] * t - y) / stated, np.zeros(2), layout, np.full((n, 2), -1))
    assert unit_sigma(found, np.ones(n, bool)) * stated == pytest.approx(1.0, abs=0.1)
    z = (found.x - [2, 3]) / (np.sqrt(np.diag(found.covariance)) / stated)
    assert np.abs(z).max() < 3
