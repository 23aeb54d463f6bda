"""Enclosures of JAX functions over boxes: intervals with outward rounding, and linear bounds."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
