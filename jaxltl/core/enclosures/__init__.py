"""Enclosures of JAX functions over boxes: intervals with outward rounding, and linear bounds."""

from jaxltl.core.lazy import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
