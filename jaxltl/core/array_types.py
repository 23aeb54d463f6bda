"""Types of NumPy arrays by their kind of number."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Booleans = NDArray[np.bool_]
Integers = NDArray[np.integer[Any]]
Floats = NDArray[np.float64]
