"""Experiments of the dissertation: measured results compared with the published ones.

One module for each experiment, with the interface :class:`~jaxltl.reproduce.experiment.Experiment`.
Run in double precision (``with jax.enable_x64(True)``), as ``jaxltl reproduce`` does.
"""
