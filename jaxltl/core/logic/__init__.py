"""Temporal logic: formulas, their truth, normal forms and letters. No JAX here."""

from jaxltl.core.lazy import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
