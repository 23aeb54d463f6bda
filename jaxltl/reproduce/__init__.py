"""Experiments of Wen (2019): measured results compared with the published ones.

One module for each experiment: ``measure(progress)`` returns the measured values, with ``seeds`` where
learning is repeated; ``table(result)`` is the report, and ``pictures(result)`` are drawings by name. Run in
double precision (``with jax.enable_x64(True)``), as ``jaxltl reproduce`` does.
"""
