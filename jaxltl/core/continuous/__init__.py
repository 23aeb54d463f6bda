"""Continuous worlds: stochastic dynamics with noise, disturbances and labelled regions."""

from jaxltl.core.lazy import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
