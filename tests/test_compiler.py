"""What the installed JAX has to get right, and some released versions did not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.app.compilation import xla_flags

# As users get their programs; other tests are compiled in haste.
DEFAULT = {
    "xla_backend_optimization_level": 3,
    "xla_llvm_disable_expensive_passes": False,
    "xla_cpu_use_fusion_emitters": True,
}
DEFAULT = DEFAULT if xla_flags(dict.fromkeys(DEFAULT, "1")) else {}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sums_of_products_are_compiled_correctly(dtype):
    """With jaxlib 0.10.2 on a CPU all rows of single precision after the 64th are wrong."""
    rng = np.random.default_rng(0)
    x, p = rng.normal(size=(100, 500, 4)), rng.normal(size=(500, 4))
    double = jax.jit(lambda x, p: 2 * (p * x).sum(-1), compiler_options=DEFAULT)
    found = double(x.astype(dtype), p.astype(dtype))
    np.testing.assert_allclose(found, 2 * (p * x).sum(-1), atol=1e-4)


@pytest.mark.parametrize(("dtype", "rows"), [(np.float32, 32_769), (np.float64, 16_385)])
def test_vectors_times_matrices_are_compiled_correctly(dtype, rows):
    """With jaxlib 0.10.2 on a CPU the last row is wrong (jax issue 39103)."""
    x = np.zeros((rows, 3), dtype)
    x[:, 0] = np.arange(rows)
    matrix = np.eye(3, dtype=dtype)
    lengths = jax.vmap(lambda row: jnp.sum((matrix @ row) ** 2))
    found = jax.jit(lengths, compiler_options=DEFAULT)(x)
    np.testing.assert_array_equal(found, x[:, 0] ** 2)
