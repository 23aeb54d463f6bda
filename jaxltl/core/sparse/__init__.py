"""Certified solvers on sparse rows of concrete arrays, by NumPy and SciPy."""
