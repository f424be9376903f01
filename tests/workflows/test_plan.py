"""Which images are matched, before and after the adjustment."""

import numpy as np
from seamosaic.catalog.missions import open_mission
from seamosaic.schemas.parameters import Parameters
from seamosaic.workflows import plan


def test_images_that_navigation_tore_apart_are_pairs_once_the_poses_are_known(reef):
    opened, p = open_mission(str(reef.mission)), Parameters()
    made = plan.plan(opened, p)
    assert made.prior is not None
    poses, first = made.prior.poses, plan.first_pairs(made, opened, p)
    known = [(pair.i, pair.j) for pair in first]
    assert plan.misplaced_pairs(made, opened, p, poses, made.range_m, known[:3]) == []

    jump = np.where(np.arange(len(made.range_m)) < 4, 0.0, 9.0)
    torn = made._replace(prior=made.prior._replace(poses=poses._replace(C_local=poses.C_local + jump[:, None])))
    found = plan.misplaced_pairs(torn, opened, p, poses, made.range_m, [])
    assert {(pair.i, pair.j) for pair in found} == {(i, j) for i, j in known if i < 4 <= j}
    assert all(pair.free for pair in found)
    assert plan.misplaced_pairs(torn, opened, p, poses, made.range_m, known) == []
