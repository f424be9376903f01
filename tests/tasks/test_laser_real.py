"""Detection on real laser lines (shared/data); how it is judged is said at each test."""

import os
from pathlib import Path

import pytest

SHARED = os.environ.get("SEAMOSAIC_SHARED")
pytestmark = pytest.mark.skipif(SHARED is None, reason="SEAMOSAIC_SHARED names no folder of real recordings")
DATA = Path(SHARED or ".") / "data"
