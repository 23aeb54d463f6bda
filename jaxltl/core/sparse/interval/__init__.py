"""Interval MDPs: uncertainty sets of rows, and the solvers on them."""
