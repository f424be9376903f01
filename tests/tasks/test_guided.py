"""Matches that a known motion leads to, on features whose true match is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from seamosaic.tasks import guided
from seamosaic.tasks.features import Features
from seamosaic.tasks.motion import Motion

FOCAL_PX = 1500.0
COUNT = 800


def scene(seed: int, twins: int = 0):
    """Features of two images of rough ground at 3 m, in the same order; the first `twins` of b are there twice."""
    rng = np.random.default_rng(seed)
    x_a = rng.uniform(-0.35, 0.35, (COUNT, 2))
    Z = 3 + 0.1 * np.sin(8 * x_a[:, 0]) * np.cos(7 * x_a[:, 1])
    R = Rotation.from_euler("xyz", [1, -2, 170], degrees=True).as_matrix()
    t = np.array([0.6, 0.3, 0.05])
    X_b = (np.column_stack([x_a, np.ones(COUNT)]) * Z[:, None] - t) @ R
    x_b = X_b[:, :2] / X_b[:, 2:] + rng.normal(0, 0.2 / FOCAL_PX, (COUNT, 2))
    descriptors = rng.gamma(0.6, 40, (COUNT, 128)).clip(0, 255)
    other = (descriptors * rng.normal(1, 0.25, descriptors.shape)).clip(0, 255)
    x_b = np.concatenate([x_b, x_b[:twins] + 3 / FOCAL_PX * R[0, 1:]])
    other = np.concatenate([other, other[:twins]])
    a = Features((x_a * FOCAL_PX).astype(np.float32), descriptors.astype(np.uint8))
    b = Features((x_b * FOCAL_PX).astype(np.float32), other.astype(np.uint8))
    motion = Motion(R, t, np.eye(6), np.arange(COUNT), "essential", True, 0.001)
    return a, b, x_a, x_b, motion


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_few_known_matches_lead_to_most_others_and_to_no_wrong_ones(seed):
    a, b, x_a, x_b, motion = scene(seed)
    known = np.column_stack([np.arange(0, COUNT, 20)] * 2)
    found = guided.match(a, b, x_a, x_b, known, motion, FOCAL_PX)
    assert (found[:, 0] == found[:, 1]).mean() > 0.995
    assert 0.8 * COUNT < len(found) <= COUNT
    assert len(np.unique(found[:, 0])) == len(np.unique(found[:, 1])) == len(found)


def test_a_feature_with_a_twin_beside_it_stays_unmatched():
    twins = 100
    a, b, x_a, x_b, motion = scene(3, twins)
    known = np.column_stack([np.arange(twins, COUNT, 10)] * 2)
    found = guided.match(a, b, x_a, x_b, known, motion, FOCAL_PX)
    assert (found[:, 0] < twins).sum() < 0.1 * twins
    assert (found[:, 0] >= twins).sum() > 0.8 * (COUNT - twins)


def test_the_wrong_motion_leads_nowhere():
    a, b, x_a, x_b, motion = scene(4)
    known = np.column_stack([np.arange(0, COUNT, 20)] * 2)
    turned = motion._replace(R_i_j=motion.R_i_j @ Rotation.from_euler("x", 5, degrees=True).as_matrix())
    assert guided.match(a, b, x_a, x_b, known, turned, FOCAL_PX) is known


def test_too_few_known_matches_stay_as_they_are():
    a, b, x_a, x_b, motion = scene(5)
    known = np.column_stack([np.arange(3)] * 2)
    assert guided.match(a, b, x_a, x_b, known, motion, FOCAL_PX) is known
