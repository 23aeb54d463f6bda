"""The process in which tests run."""

import importlib
import os
import sys

import numpy as np
import pytest


@pytest.mark.skipif(
    sys.platform != "linux" or os.environ["JAX_PLATFORMS"] != "cpu", reason="it is without a limit"
)
def test_a_test_that_fills_the_memory_fails():
    """Rather than the workers of all tests, which the kernel ends."""
    resource = importlib.import_module("resource")
    limit = resource.getrlimit(resource.RLIMIT_DATA)[0]
    assert 0 < limit <= 8 * 2**30
    with pytest.raises(MemoryError):
        np.empty(limit, np.uint8)
