"""Environments and models for experiments, one module each, imported on first use.

Models: ``gridworld``, ``temporal_gridworld``. Games: ``robots``, ``post_offices``. Simulated
environments: ``letter_world``, ``flat_world``, ``zone_world``, ``navigation``, ``lqr``. Policies:
``networks``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
