"""Exact questions about supports, on the host or traced: attractors, components, acceptance."""

from jaxltl.core.lazy import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
