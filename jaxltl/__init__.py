"""jaxltl: policies known to do their task.

State a task by a temporal-logic formula, demonstrations, a reward, or a mix; learn in the
product of the world and the task's automaton; get every answer with its evidence.
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from jaxltl import algos as algos
    from jaxltl import envs as envs
    from jaxltl import io as io
    from jaxltl import plot as plot
    from jaxltl._public import *  # noqa: F403
    from jaxltl._public import __all__ as __all__
else:
    # With the first public name, so that the command line can speak before JAX is imported.

    def __getattr__(name: str) -> Any:
        if name.startswith("_") and name != "__all__":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        if importlib.util.find_spec(f"{__name__}.{name}"):  # a module of ours
            return importlib.import_module(f"{__name__}.{name}")
        public = importlib.import_module(f"{__name__}._public")
        found = {"__all__": public.__all__, **{x: getattr(public, x) for x in public.__all__}}
        globals().update(found)
        if name not in globals():
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return globals()[name]

    def __dir__() -> list[str]:
        return sorted({*globals(), *__getattr__("__all__"), "algos", "envs", "io", "plot"})
