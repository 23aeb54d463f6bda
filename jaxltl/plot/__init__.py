"""Pictures, one call each: automata, models, grid maps, games of two robots, learning curves.

Each function returns a new matplotlib ``Figure`` and touches no global state, so it works
without a display and in any thread. ``figure.savefig("name.svg")`` writes it. Those named live
return the text of an SVG for pages that move, and ``playback`` that of one that moves by itself.
"""

from jaxltl.core.lazy import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
