"""Worlds to learn in, a module each, imported when they are first used.

Those that are made by one call are at the top level (``jaxltl.gridworld``,
``jaxltl.envs.letter_world``, ...); here are their modules, with what else they have. Models:
``gridworld``, ``temporal_gridworld``. Games: ``robots``, ``post_offices``. Simulated worlds:
``letter_world``, ``flat_world``, ``zone_world``, ``navigation``, ``lqr``, with
``navigation_steps`` as an environment, and ``networks``, small policies for searches among
parameters.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
