"""Continuous worlds: stochastic dynamics with noise, disturbances and labelled regions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
