"""The simulated survey's motion and its navigation's errors."""

import numpy as np
import pytest
from seamosaic.schemas.calibration import Mount
from seamosaic.schemas.scene import NavigationScene, SurveyScene
from seamosaic.tasks import simulation_navigation as sn

FOOTPRINT_M = (2.0, 1.5)
STEADY = SurveyScene(wobble=0.0)


ABOVE, MOUNT = Mount(), Mount(translation=(0.35, 0.12, 0.25))


def make(survey: SurveyScene = STEADY, images: int = 12, seed: int = 0, mount: Mount = ABOVE) -> sn.Plan:
    return sn.plan(survey, images, FOOTPRINT_M, -12.0, mount.translation[:2], np.random.default_rng(seed))


@pytest.mark.parametrize("mount", [ABOVE, MOUNT])
def test_the_cameras_lines_overlap_as_asked(mount):
    made = make(mount=mount)
    states = sn.trajectory(made, made.image_time_s)
    X, bow = sn.cameras(states, mount).C_local[:, :2], np.radians(STEADY.heading_deg)
    along, across = X @ [np.sin(bow), np.cos(bow)], X @ [np.cos(bow), -np.sin(bow)]
    lines = np.unique(np.round(across, 6))
    assert np.diff(lines) == pytest.approx([2.0 * (1 - STEADY.sidelap)] * 2)
    assert np.diff(along[:4]) == pytest.approx([1.5 * (1 - STEADY.overlap)] * 3)
    assert X.mean(axis=0) == pytest.approx([0, 0], abs=1e-6)
    assert states.attitude_deg[:, 2] == pytest.approx([20] * 4 + [200] * 4 + [20] * 4)
    assert (states.X_local[:, 2] == -12).all()


@pytest.mark.parametrize("mount", [ABOVE, MOUNT])
def test_the_camera_sails_where_it_heads_at_constant_speed(mount):
    made = make(mount=mount)
    t = np.linspace(0, made.image_time_s[-1] + sn.LEAD_S, 4001)
    states = sn.trajectory(made, t)
    step = np.diff(sn.cameras(states, mount).C_local[:, :2], axis=0)
    assert np.linalg.norm(step, axis=1) / np.diff(t) == pytest.approx(np.full(4000, 0.3), rel=0.01)
    course = np.degrees(np.arctan2(step[:, 0], step[:, 1]))
    off = (course - (states.attitude_deg[1:, 2] + states.attitude_deg[:-1, 2]) / 2 + 180) % 180
    assert np.minimum(off, 180 - off).max() < 1.0
    assert made.image_time_s[0] == pytest.approx(sn.LEAD_S)


def test_sway_is_smooth_and_as_large_as_said():
    made = make(SurveyScene(wobble=2.0), 40, seed=5)
    t = np.arange(0, 200, 0.2)
    steady, swaying = (sn.trajectory(p, t) for p in (made._replace(sway=0 * made.sway), made))
    attitude = (swaying.attitude_deg - steady.attitude_deg + 180) % 360 - 180
    assert attitude.std(axis=0) == pytest.approx([1.2, 1.2, 2.2], rel=0.35)
    assert abs(np.diff(attitude, axis=0)).max() < 1.0
    assert 0.02 < (swaying.X_local - steady.X_local)[:, 2].std() < 0.1


def test_pairs_are_apart_by_the_delay():
    made = make(SurveyScene(roles="pairs", pair_delay_s=2.0, lines=2), 9)
    roles, t = np.array(made.image_role), made.image_time_s
    assert len(t) == len(roles) == 9
    assert (roles == "texture").sum() == 5
    assert (np.diff(t) > 0).all()
    for k in np.flatnonzero(roles == "laser"):
        assert np.isclose(t[roles == "texture"], t[k] - 2.0).sum() == 1


def test_images_are_shared_out_over_lines():
    made = make(images=7)
    heading = sn.trajectory(made, made.image_time_s).attitude_deg[:, 2]
    assert np.isclose(heading, 20).sum() == 5
    assert len(make(SurveyScene(lines=1), 1).image_time_s) == 1


def test_the_camera_is_ahead_of_and_below_the_reference_point():
    states = sn.States(np.zeros(1), np.array([[1.0, 2.0, -5.0]]), np.array([[0.0, 0.0, 90.0]]))
    pose = sn.cameras(states, MOUNT)
    # heading east: the bow is east, starboard is south
    assert pose.C_local[0] == pytest.approx([1.35, 1.88, -5.25])
    assert pose.R_local_camera[0] @ [0, 0, 1] == pytest.approx([0, 0, -1], abs=1e-12)
    assert pose.R_local_camera[0] @ [0, -1, 0] == pytest.approx([1, 0, 0], abs=1e-12)


def still(seconds: float = 100.0) -> sn.States:
    t = np.arange(0, seconds, 0.2)
    return sn.States(t, np.zeros((len(t), 3)), np.tile([1.0, 2.0, 359.9], (len(t), 1)))


def errors(seed: int, **fields) -> tuple[np.ndarray, np.ndarray]:
    scene = NavigationScene(**fields)
    said = sn.measured(still(), scene, np.random.default_rng(seed))
    return said.X_local, (said.attitude_deg - still().attitude_deg + 180) % 360 - 180


def test_errors_have_the_stated_sigma():
    sigma = NavigationScene().sigma
    runs = [errors(seed, drift_m_per_sqrt_s=0) for seed in range(200)]
    X, attitude = (np.array([run[k][::50] for run in runs]) for k in (0, 1))
    stated = [sigma.roll, sigma.pitch, sigma.heading]
    assert np.sqrt((X[..., :2] ** 2).mean()) == pytest.approx(sigma.horizontal, rel=0.15)
    assert np.sqrt((X[..., 2] ** 2).mean()) == pytest.approx(sigma.depth, rel=0.15)
    assert np.sqrt((attitude**2).mean(axis=(0, 1))) == pytest.approx(stated, rel=0.15)


def test_attitude_is_a_constant_and_white_noise():
    _, attitude = errors(0)
    sigma = np.array([0.269, 0.269, 0.838])
    assert attitude.std(axis=0) == pytest.approx(0.3 * sigma, rel=0.15)
    correlation = [np.corrcoef(a[1:], a[:-1])[0, 1] for a in attitude.T]
    assert np.abs(correlation).max() < 0.15


def test_drift_grows_as_a_random_walk():
    runs = np.array([errors(s, drift_m_per_sqrt_s=0.05, horizontal_noise_m=0.0)[0][:, :2] for s in range(150)])
    drift = runs - runs[:, :1]
    for seconds in (10, 40, 90):
        spread = drift[:, 5 * seconds].std()
        assert 0.85 < spread / (0.05 * np.sqrt(seconds)) < 1.15


def test_perfect_navigation_is_possible():
    X, attitude = errors(0, error_scale=0.0)
    assert abs(X).max() == 0
    assert abs(attitude).max() < 1e-9


def test_the_altimeter_measures_from_the_reference_point():
    altitude = sn.measured_altitude(still(), np.full(500, -3.0), NavigationScene(), np.random.default_rng(0))
    assert altitude.mean() == pytest.approx(3.0, abs=0.002)
    assert 0.007 < altitude.std() < 0.013
