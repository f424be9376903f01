"""The robust minimum beside scipy's, and what wrong residuals do to it."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from seamosaic.tasks.robust_minimum import HUBER, minimise

TRUE = np.array([0.02, -0.01, 0.03, 0.1, -0.2, 0.05])


def _seen(seed: int, wrong: int):
    """Residuals, in sigmas, of 120 curved measurements of six numbers; so many of them far off."""
    rng = np.random.default_rng(seed)
    A = rng.normal(0, 30, (120, 6))
    noise = rng.normal(0, 1, 120)
    noise[:wrong] += 40

    def at(steps: np.ndarray) -> np.ndarray:
        off = steps - TRUE
        return off @ A.T + 20 * (off**2) @ np.abs(A).T / 30 + noise

    return at, A


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("wrong", [0, 12])
def test_it_is_where_scipy_finds_it(seed, wrong):
    at, A = _seen(seed, wrong)
    found = minimise(at)
    expected = least_squares(lambda step: at(step[None])[0], np.zeros(6), loss="huber", f_scale=HUBER, xtol=1e-12)
    sigma = np.sqrt(np.diag(np.linalg.inv(A.T @ A)))
    assert (np.abs(found.step - expected.x) < 0.1 * sigma).all()  # it stops where nothing more is won
    assert np.allclose(found.residual, at(found.step[None])[0])
    assert 0.05 < np.linalg.norm((found.step - TRUE) / sigma) < 6
    assert found.jacobian.shape == (120, 6)
