"""Environments and models for experiments, one module each, imported on first use.

Models: ``gridworld``, ``temporal_gridworld``. Games: ``robots``, ``post_offices``. Simulated
environments: ``letter_world``, ``conveyor_world``, ``flat_world``, ``zone_world``, ``navigation``,
``lqr``. Policies: ``networks``.
"""

from jaxltl.core.lazy import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
