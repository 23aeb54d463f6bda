"""jaxltl: policies with certified guarantees for temporal-logic tasks, in JAX.

State a task by a temporal-logic formula, demonstrations, a reward, or a mix; learn in the
product of the world and the task's automaton; every answer comes with certified bounds, a proof
or a confidence interval. Public names are listed in ``__init__.pyi`` and imported on first use.
"""

from jaxltl.core.lazy import attach_stub

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
