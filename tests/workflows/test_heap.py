"""Freed memory goes back to the system when it is asked to."""

import platform
import subprocess
import sys

import pytest

# In a process of its own: another may have had such memory before
MEASURED = """
import numpy, psutil
from seamosaic.workflows import heap

def held():
    return psutil.Process().memory_info().rss / 2**20

before = held()
blocks = [numpy.ones(64 * 1024, numpy.uint8) for _ in range(4000)]  # too small for pages of their own
kept = [numpy.ones(100, numpy.uint8) for _ in range(100)]
full = held() - before
del blocks
heap.give_back()
print(full, held() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps freed memory in a way that can be told")
def test_what_was_freed_below_something_kept_goes_back():
    done = subprocess.run([sys.executable, "-c", MEASURED], capture_output=True, text=True, check=True)
    full, left = map(float, done.stdout.split())
    assert full > 200
    assert left < 40
