"""Freed memory goes back to the system when it is asked to."""

import platform

import numpy as np
import psutil
import pytest
from seamosaic.workflows import heap

MIB = 2**20


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps freed memory in a way that can be told")
def test_what_was_freed_below_something_kept_goes_back():
    before = psutil.Process().memory_info().rss
    blocks = [np.ones(64 * 1024, np.uint8) for _ in range(4000)]  # too small for pages of their own
    kept = [np.ones(100, np.uint8) for _ in range(100)]
    assert psutil.Process().memory_info().rss - before > 200 * MIB
    del blocks
    heap.give_back()
    assert psutil.Process().memory_info().rss - before < 40 * MIB
    assert len(kept) == 100
