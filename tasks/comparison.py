"""What two maps of one seabed differ by, accumulated window by window."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

_SAMPLE = 2_000_000


class Difference(NamedTuple):
    """Cells of a window.

    Attributes
    ----------
    metres : (h, w) second minus first, NaN where either is empty.
    sigmas : (h, w) the same over the 1-sigma of the difference, NaN where a sigma is missing.
    """

    metres: Array
    sigmas: Array


def difference(z1: Array, z2: Array, sigma1: Array, sigma2: Array) -> Difference:
    """Second minus first of two windows (h, w) of the same cells, NaN where empty.

    The two count as independent, so z is too small where both versions share their measurements.
    """
    metres = z2 - z1
    sigma = np.hypot(sigma1, sigma2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return Difference(metres, np.where(sigma > 0, metres / sigma, np.nan))


class Totals:
    """Counts and moments of windows as they come; percentiles from an even sample of the cells.

    Parameters
    ----------
    cells : of the whole map, so that the sample stays below two million.
    """

    def __init__(self, cells: int):
        self._every = max(1, -(-cells // _SAMPLE))
        self._sum = self._squares = self._largest = 0.0
        self.common = self.gained = self.lost = 0
        self._metres: list[Array] = []
        self._sigmas: list[Array] = []

    def add(self, found: Difference, there1: NDArray[np.bool_], there2: NDArray[np.bool_]) -> None:
        """Add a window; there1, there2 (h, w): where the first and the second have a value."""
        both = there1 & there2
        metres = found.metres[both].astype(float)
        sigmas = found.sigmas[both]
        self._sum, self._squares = self._sum + float(metres.sum()), self._squares + float((metres**2).sum())
        self._largest = max(self._largest, float(np.abs(metres).max(initial=0.0)))
        self.common += int(both.sum())
        self.gained += int((there2 & ~there1).sum())
        self.lost += int((there1 & ~there2).sum())
        self._metres.append(metres[:: self._every])
        self._sigmas.append(sigmas[np.isfinite(sigmas)][:: self._every])

    def metres(self) -> dict[str, float] | None:
        """Figures of the differences, metres; None without a common cell."""
        if not self.common:
            return None
        size = np.abs(np.concatenate(self._metres))
        return {
            "mean": self._sum / self.common,
            "median": float(np.median(np.concatenate(self._metres))),
            "median_abs": float(np.median(size)),
            "p95_abs": float(np.percentile(size, 95)),
            "max_abs": self._largest,
            "rmse": float(np.sqrt(self._squares / self.common)),
        }

    def sigmas(self) -> dict[str, float] | None:
        """Figures of the differences over their sigma; None where no sigma is known."""
        z = np.concatenate(self._sigmas) if self._sigmas else np.zeros(0)
        if not len(z):
            return None
        size = np.abs(z)
        return {
            "median_abs": float(np.median(size)),
            "p95_abs": float(np.percentile(size, 95)),
            "rms": float(np.sqrt((z**2).mean())),
            "share_above_2": float((size > 2).mean()),
        }
