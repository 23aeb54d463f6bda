"""Experiments of the dissertation: measured results compared with the published ones.

One module for each experiment: ``figures(progress)`` measures, with ``seeds`` where learning is
repeated; ``table(result)`` is the report, and ``pictures(result)`` yields names and files. Run in
double precision (``with jax.enable_x64(True)``), as ``jaxltl reproduce`` does.
"""
