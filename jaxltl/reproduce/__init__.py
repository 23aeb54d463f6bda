"""The dissertation's tables and figures, published beside measured.

A module for each experiment, with ``figures(progress) -> dict``, plain numbers, and
``table(result) -> str``. Run inside double precision (``with jax.enable_x64(True)``), as
``jaxltl reproduce`` does.
"""
