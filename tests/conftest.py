"""Tests compare with exact references, so they run in double precision.

The library never sets this; single precision is tested by ``jax.enable_x64(False)``.
"""

import jax

jax.config.update("jax_enable_x64", True)
