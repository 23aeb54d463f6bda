"""Statistical bounds: binomial, empirical Bernstein, and confidence sets of transition probabilities."""

from jaxltl.core.lazy import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
