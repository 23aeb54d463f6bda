"""Temporal logic: formulas, their truth, normal forms and letters. No JAX here."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
