"""Tests compare with exact references, so they run in double precision.

The library never sets this; single precision is tested by ``jax.enable_x64(False)``.
"""

from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)

_MAPS = Path("/proc/self/maps")
_MANY = 15_000


@pytest.fixture(autouse=True, scope="module")
def few_compiled_programs():
    """Frees compiled programs after a file, if there are many.

    Each takes some memory maps, of which Linux allows a process 65,530; the compiler crashes
    when there are no more.
    """
    yield
    if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > _MANY:
        jax.clear_caches()
