"""Games against an environment: objectives, winning regions, strategies and their check."""

from jaxltl.core.lazy import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
