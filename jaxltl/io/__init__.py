"""Readers and writers of external file formats.

``jaxltl.read_model`` and ``jaxltl.write_model`` detect the format of a model; the functions here
have format-specific options. Only ``read_parametric`` is differentiable, in its parameters.
"""

from jaxltl.core.lazy import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
