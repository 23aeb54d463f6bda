"""Models: MDPs, games, products and interval models, with their operators."""

from jaxltl.core.lazy import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
