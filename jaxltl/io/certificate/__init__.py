"""Certificates of bounds, which `jaxltl.checker` proves without the solvers."""
