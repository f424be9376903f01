"""What the adjustment left, of each image and pair, as quality.json has it; and what only navigation holds together."""

from collections.abc import Iterator, Sequence

import numpy as np

from ..catalog import trajectories
from ..schemas.products import ImageResidual, PairResidual
from ..tasks.residuals import blocks
from .solve import Solution


def held_together(solution: Solution) -> np.ndarray:
    """Number (n,) of the block of each image: what matches and crossovers hold together."""
    left = solution.residuals
    crossed = np.zeros((0, 2), int) if left is None else left.crossed
    if left is not None and np.isin(crossed, left.sighted).any():  # where there are features, they have to tell
        crossed = crossed[:0]
    return blocks(len(solution.status), np.concatenate([solution.pairs, crossed]).astype(np.intp))


def sizes(rows: Sequence[trajectories.Row], block: np.ndarray) -> tuple[int, ...]:
    """Images with a pose in each block, largest first; an image alone is a block of one."""
    placed = block[[k for k, row in enumerate(rows) if row.pose is not None]]
    return tuple(sorted(np.unique(placed, return_counts=True)[1].tolist(), reverse=True))


def images(
    rows: Sequence[trajectories.Row], navigation: np.ndarray, solution: Solution, block: np.ndarray
) -> Iterator[ImageResidual]:
    """Of each image with a pose; navigation (n, 3) in map coordinates."""
    left = solution.residuals
    for k, row in enumerate(rows):
        if row.pose is None:
            continue
        off = navigation[k] - np.asarray(row.pose.position)
        px = np.nan if left is None else float(left.image_px[k])
        yield ImageResidual(
            image=row.image,
            block=int(block[k]),
            reprojection_px=None if np.isnan(px) else round(px, 4),
            navigation_minus_adjusted_m=tuple(np.round(off, 5).tolist()) if np.isfinite(off).all() else None,
        )


def pairs(names: Sequence[str], solution: Solution) -> Iterator[PairResidual]:
    """Of each pair that tie points or crossovers hold; names of all images."""
    left = solution.residuals
    if left is None:
        return
    seen = {(i, j): k for k, (i, j) in enumerate(left.sighted.tolist())}
    crossed = {(i, j): k for k, (i, j) in enumerate(left.crossed.tolist())}
    for i, j in sorted({*seen, *crossed}):
        s, c = seen.get((i, j)), crossed.get((i, j))
        yield PairResidual(
            images=(names[int(i)], names[int(j)]),
            tie_points=0 if s is None else int(left.shared[s]),
            reprojection_px=None if s is None else round(float(left.pair_px[s]), 4),
            crossovers=0 if c is None else int(left.crossings[c]),
            apart_m=None if c is None else round(float(left.apart_m[c]), 6),
        )


def crossover_rms(solution: Solution) -> float | None:
    """Distance of all laser lines at their crossings, metres; None where none cross."""
    left = solution.residuals
    if left is None or not len(left.crossed):
        return None
    return float(np.sqrt((left.apart_m**2 * left.crossings).sum() / left.crossings.sum()))


def doubts(rows: Sequence[trajectories.Row], block: np.ndarray) -> Iterator[str]:
    """Blocks of several images that nothing but navigation holds to each other."""
    several = [size for size in sizes(rows, block) if size > 1]
    if len(several) > 1:
        shown = ", ".join(map(str, several[:6])) + (" ..." if len(several) > 6 else "")
        yield (
            f"{len(several)} blocks of images ({shown} images) are held together by navigation alone: neither matches "
            "nor crossing laser lines link them"
        )
