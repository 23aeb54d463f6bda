"""Types of arrays: NumPy arrays by their kind of number, and arrays of NumPy or JAX."""

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import jax
    from scipy.sparse import csr_array

    Array = jax.Array | NDArray[Any]
    Numeric: TypeAlias = Any  # a number or an array
    Key: TypeAlias = jax.Array  # a random key
    SparseMatrix: TypeAlias = csr_array
else:  # packages without JAX import this module
    Array = Key = Numeric = SparseMatrix = np.ndarray

PyTree: TypeAlias = Any  # a tree of arrays, such as the state of a simulated environment

Booleans = NDArray[np.bool_]
Integers = NDArray[np.integer[Any]]
Floats = NDArray[np.float64]
