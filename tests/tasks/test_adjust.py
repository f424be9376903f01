import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from seamosaic.schemas.parameters import AdjustParameters
from seamosaic.tasks import adjust, rotations
from seamosaic.tasks.adjust import Link
from seamosaic.tasks.motion import Motion
from seamosaic.tasks.navigation import NavigationPrior, Poses

from tests.tasks import scenes

P = AdjustParameters()
SIGMA_T, SIGMA_R = 0.003, np.radians(0.05)


def _survey(lines=3, images=8):
    x, y = np.meshgrid(np.arange(lines) * 1.2, np.arange(images) * 0.8)
    y[:, 1::2] = y[::-1, 1::2]
    C = np.column_stack([x.T.ravel(), y.T.ravel(), np.zeros(lines * images)])
    return scenes.cameras(C, tilt_deg=1.0)


def _motion(R, t, metric=True, inliers=100):
    covariance = np.diag([SIGMA_R] * 3 + [SIGMA_T] * 3) ** 2
    return Motion(R, t, covariance, np.arange(inliers), "essential", metric, 0.001 if metric else np.nan)


def _links(poses, rng, reach=1.5, metric=True):
    links = []
    for i in range(len(poses.C_local)):
        for j in range(i + 1, len(poses.C_local)):
            if np.linalg.norm(poses.C_local[i] - poses.C_local[j]) < reach:
                R, t = scenes.true_motion(poses, i, j)
                R = R @ Rotation.from_rotvec(rng.normal(0, SIGMA_R, 3)).as_matrix()
                t = t + rng.normal(0, SIGMA_T, 3)
                links.append(Link(i, j, _motion(R, t if metric else t / np.linalg.norm(t), metric)))
    return links


def _navigation(poses, rng, offset=(0.3, -0.2, 0.0)):
    count = len(poses.C_local)
    walk = np.cumsum(rng.normal(0, 0.02 * 2, (count, 2)), axis=0)
    noise = np.column_stack([walk, rng.normal(0, 0.03, count)])
    turned = Rotation.from_rotvec(np.radians(rng.normal(0, 0.2, (count, 3)))).as_matrix()
    return NavigationPrior(
        poses=Poses(poses.R_local_camera @ turned, poses.C_local + noise + offset),
        time_s=4.0 * np.arange(count),
        sigma_horizontal=np.full(count, 0.4),
        sigma_depth=np.full(count, 0.03),
        sigma_attitude=np.radians(np.tile([0.3, 0.3, 0.8], (count, 1))),
        drift_m_per_sqrt_s=0.02,
        R_camera_vehicle=rotations.R_vehicle_camera(0, 0, 0).T,
    )


def _rigid_rms(A, B):
    a, b = A - A.mean(0), B - B.mean(0)
    R = rotations.nearest_rotation(b.T @ a)
    return np.sqrt(((a @ R.T - b) ** 2).sum(1).mean())


def _run(poses, links, navigation, R_first=None):
    return adjust.adjust(
        len(poses.C_local), links, navigation, poses.R_local_camera[0] if R_first is None else R_first, P
    )


def test_links_hold_the_track_better_than_navigation():
    rng, poses = np.random.default_rng(0), _survey()
    navigation = _navigation(poses, rng)
    found = _run(poses, _links(poses, rng), navigation)
    before, after = (_rigid_rms(p.C_local, poses.C_local) for p in (navigation.poses, found.poses))
    assert 0.0005 < after < 0.01 < before
    assert found.used.all()
    assert set(found.status) == {"adjusted"}


def test_the_track_stays_where_navigation_has_it_and_says_how_sure_that_is():
    rng, poses = np.random.default_rng(1), _survey()
    navigation = _navigation(poses, rng)
    found = _run(poses, _links(poses, rng), navigation)
    shift = (found.poses.C_local - navigation.poses.C_local).mean(0)
    assert np.abs(shift).max() < 0.05
    assert (np.abs(found.sigma_m[:, :2] / 0.4 - 1) < 0.1).all()
    assert (found.sigma_m[:, 2] > 0.025).all()
    assert (found.sigma_m[:, 2] < 0.04).all()
    tilt = np.degrees(found.sigma_tilt_rad)  # the bias of the sensor stays, the noise averages down
    assert ((tilt > 0.3) & (tilt < 0.35)).all()


def test_the_stated_tilt_does_not_depend_on_how_many_images_there_are():
    sigmas = []
    for lines in (2, 8):
        poses = _survey(lines=lines)
        navigation = _navigation(poses, np.random.default_rng(0))
        sigmas.append(np.degrees(_run(poses, [], navigation).sigma_tilt_rad).mean())
    assert 0.3 < sigmas[0] < 0.45
    assert abs(sigmas[1] / sigmas[0] - 1) < 0.1


def test_wrong_links_are_found_out():
    rng, poses = np.random.default_rng(2), _survey()
    links = _links(poses, rng)
    wrong = [
        Link(0, 20, _motion(*scenes.true_motion(poses, 0, 1))),  # a false loop of repeated texture
        Link(3, 14, _motion(np.eye(3), np.array([0.4, 0.4, 0.0]))),
    ]
    found = _run(poses, links + wrong, _navigation(poses, rng))
    assert not found.used[-2:].any()
    assert found.used[:-2].mean() > 0.97
    assert _rigid_rms(found.poses.C_local, poses.C_local) < 0.01


def test_images_without_links_keep_navigation_and_say_so():
    rng, poses = np.random.default_rng(3), _survey()
    links = [link for link in _links(poses, rng) if 5 not in (link.i, link.j)]
    navigation = _navigation(poses, rng)
    found = _run(poses, links, navigation)
    assert [k for k, status in enumerate(found.status) if status == "navigation"] == [5]
    assert np.linalg.norm(found.poses.C_local[5] - poses.C_local[5] - found.poses.C_local[4] + poses.C_local[4]) < 0.2
    alone = _run(poses, [], navigation)
    assert set(alone.status) == {"navigation"}
    assert np.abs(alone.poses.C_local - navigation.poses.C_local).max() < 0.1


def test_without_laser_navigation_gives_the_scale():
    rng, poses = np.random.default_rng(4), _survey()
    navigation = _navigation(poses, rng)
    found = _run(poses, _links(poses, rng, metric=False), navigation)
    before, after = (_rigid_rms(p.C_local, poses.C_local) for p in (navigation.poses, found.poses))
    assert 0.001 < after < 0.7 * before


def test_without_navigation_motions_are_chained_from_the_first_image():
    rng, poses = np.random.default_rng(5), _survey()
    found = _run(poses, _links(poses, rng), None)
    np.testing.assert_allclose(found.poses.C_local[0], 0, atol=1e-4)
    np.testing.assert_allclose(found.poses.R_local_camera[0], poses.R_local_camera[0], atol=1e-4)
    assert 0.0005 < _rigid_rms(found.poses.C_local, poses.C_local) < 0.02
    assert np.nanmax(found.sigma_m[0]) < 1e-3 < np.nanmax(found.sigma_m[-1])


def test_without_navigation_an_image_without_link_is_rejected():
    rng, poses = np.random.default_rng(6), _survey()
    links = [link for link in _links(poses, rng) if 23 not in (link.i, link.j)]
    found = _run(poses, links, None)
    assert found.status[23] == "rejected: no link to the placed images"
    assert np.isnan(found.poses.C_local[23]).all()
    assert found.status.count("adjusted") == 23


@pytest.mark.parametrize("threshold", [0.5, 5.0])
def test_the_robust_threshold_matters(threshold):
    rng, poses = np.random.default_rng(7), _survey()
    links = _links(poses, rng)
    R, t = scenes.true_motion(poses, 4, 5)
    links.append(Link(4, 5, _motion(R, np.add(t, [0.02, 0, 0]))))
    found = adjust.adjust(24, links, None, poses.R_local_camera[0], AdjustParameters(robust_threshold=threshold))
    pulled = scenes.true_motion(found.poses, 4, 5)[1][0] - t[0]
    assert (abs(pulled) < 0.004) == (threshold < 1)


def test_images_that_lie_the_other_way_round_are_found_and_turned():
    rng, poses = np.random.default_rng(7), _survey()
    other_way = np.zeros(len(poses.C_local), bool)
    other_way[8:16] = True  # the second line
    half_turn = np.diag([-1.0, -1.0, 1.0])
    navigation = _navigation(poses, rng)
    seen = Poses(
        np.where(other_way[:, None, None], poses.R_local_camera @ half_turn, poses.R_local_camera), poses.C_local
    )
    links = [link._replace(turned=(other_way[link.i], other_way[link.j])) for link in _links(seen, rng)]
    links[5] = links[5]._replace(turned=(True, True))  # one vote is not the majority
    found = _run(poses, links, navigation)
    assert (found.turned == other_way).all()
    assert 0.0005 < _rigid_rms(found.poses.C_local, poses.C_local) < 0.01
    turn = Rotation.from_matrix(found.poses.R_local_camera.transpose(0, 2, 1) @ seen.R_local_camera)
    assert np.degrees(turn.magnitude()).max() < 3


def test_a_jump_of_navigation_does_not_tear_the_map():
    rng, poses = np.random.default_rng(8), _survey()
    navigation = _navigation(poses, rng)
    C = navigation.poses.C_local.copy()
    C[12:] += [8.0, 2.0, 0.0]
    navigation = navigation._replace(poses=Poses(navigation.poses.R_local_camera, C))
    links = _links(poses, rng)
    torn = _run(poses, links, navigation)
    held = _run(poses, [link._replace(free=link.j == link.i + 1) for link in links], navigation)
    assert _rigid_rms(torn.poses.C_local, poses.C_local) > 0.3
    assert 0.0005 < _rigid_rms(held.poses.C_local, poses.C_local) < 0.03


@pytest.mark.parametrize("metric", [True, False])
def test_later_links_tell_anew_what_they_contradict_or_join(metric):
    rng, poses = np.random.default_rng(9), _survey()
    navigation, links = _navigation(poses, rng), _links(poses, rng, metric=metric)
    later = links[5::6]
    found = _run(poses, [link for link in links if link not in later], navigation)

    def anew(links, poses=found.poses, status=found.status):
        return adjust.would_change(links, poses, status, navigation, 0.3)

    assert not anew(later)
    wrong = Link(3, 14, _motion(np.eye(3), np.array([0.4, 0.4, 0.0]) / (1 if metric else 0.566), metric))
    assert not anew([*later, wrong])
    moved = found.poses._replace(C_local=found.poses.C_local + np.where(np.arange(24) < 12, 0.0, 0.5)[:, None])
    assert anew(links, moved)
    nudged = found.poses._replace(C_local=found.poses.C_local + np.where(np.arange(24) < 12, 0.0, 0.1)[:, None])
    assert not anew(links, nudged)  # what is off by so little is no jump
    assert anew(later, status=["navigation" if k == later[0].i else one for k, one in enumerate(found.status)])
