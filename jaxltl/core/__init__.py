"""The mathematics: models, automata, products, and the solvers on them."""

from jaxltl.core.lazy import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
