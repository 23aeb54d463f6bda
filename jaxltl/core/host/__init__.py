"""Exact work on concrete arrays, by NumPy and SciPy: sparse rows, components, worklists."""
