"""What is acted in: MDPs, games, products, and the primitives through which they are seen."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
