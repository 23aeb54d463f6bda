"""Environments and dynamics by name: of the library, of other packages, and of the user's own functions.

Example:
  >>> from jaxltl import envs
  >>> envs.make("flat_world", {"horizon": 20}).horizon
  20
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import inspect
import operator
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType

from jaxltl.core.array_types import PyTree
from jaxltl.core.continuous.dynamics import Dynamics
from jaxltl.core.environments.environment import Environment, make_environment
from jaxltl.envs.continuous_worlds import BenchmarkWorld

BUILT_IN = {
    "conveyor_world": "jaxltl.envs.conveyor_world:conveyor_world",
    "flat_world": "jaxltl.envs.flat_world:flat_world",
    "letter_world": "jaxltl.envs.letter_world:letter_world",
    "zone_world": "jaxltl.envs.zone_world:zone_world",
}
# By package, the module and function that make the argument of its adapter.
PACKAGES = {
    "brax": ("brax.envs", "get_environment"),
    "craftax": ("craftax.craftax_env", "make_craftax_env_from_name"),
    "gymnax": ("gymnax", "make"),
    "jumanji": ("jumanji", "make"),
    "navix": ("navix", "make"),
    "playground": ("mujoco_playground", "registry.load"),
    "xminigrid": ("xminigrid", "make"),
}


def make(
    name: str,
    arguments: Mapping[str, PyTree] | None = None,
    *,
    labels: Callable[..., PyTree] | None = None,
    propositions: Sequence[str] = (),
    folder: str | Path = ".",
) -> Environment:
    """An environment by its name, as task files name it.

    Args:
      name: of the library, such as ``"flat_world"``; of another package, such as ``"brax:ant"`` or
        ``"gymnax:CartPole-v1"``; or a function that returns an environment,
        ``"package.module:function"`` or ``"file.py:function"``, which is imported and called.
      arguments: of the function, by name.
      labels: function of labels ``state -> bool[P]``; default the environment's.
      propositions: names of the labels.
      folder: directory of ``"file.py"``.

    Returns:
      The environment.

    Raises:
      ValueError: an unknown name, a missing package, or an error of the function, in one line.

    Example:
      >>> make("letter_world").propositions[:2]
      ('a', 'b')
    """
    arguments, folder = arguments or {}, Path(folder)
    root, _, rest = name.partition(":")
    if root in PACKAGES and rest:
        return _of_package(root, rest, arguments, labels, list(propositions))
    environment = _called(name, function_of(BUILT_IN.get(name, name), folder), arguments)
    if isinstance(environment, Dynamics):
        raise ValueError(f"{name!r} returns dynamics; write dynamics = {name!r} for them.")
    if not isinstance(environment, Environment):
        raise ValueError(
            f"{name!r} returns a {type(environment).__name__}, no Environment; let it return one of "
            "make_environment, or of an adapter such as from_gymnax."
        )
    if labels is None:
        return environment
    with _user_errors("labels"):
        names = ["actions", "allowed", "observations", "horizon", "starts", "outcomes", "ending"]
        return make_environment(
            *(environment.reset, environment.step, environment.observe),
            **{name: getattr(environment, name) for name in names},
            labels=labels,
            propositions=list(propositions),
        )


def make_dynamics_of(name: str, arguments: Mapping[str, object], folder: Path) -> Dynamics:
    """The dynamics that a user's function of a `name` returns, by its `arguments`, in a `folder`."""
    value = _called(name, function_of(name, folder), arguments)
    if isinstance(value, BenchmarkWorld):
        return value.dynamics
    if isinstance(value, Dynamics):
        return value
    raise ValueError(
        f"{name!r} returns a {type(value).__name__}, no dynamics; let it return those of "
        "make_dynamics, or write environment = for one that is only simulated."
    )


def _called(name: str, function: Callable[..., object], arguments: Mapping[str, object]) -> object:
    """The result of a user's function."""
    try:
        inspect.signature(function).bind(**arguments)
    except TypeError as problem:
        raise ValueError(f"{name!r} does not take [world.arguments]: {problem}.") from None
    with _user_errors(name):
        return function(**arguments)


def _of_package(
    root: str,
    name: str,
    arguments: Mapping[str, object],
    labels: Callable[..., PyTree] | None,
    propositions: list[str],
) -> Environment:
    """An environment of another package, by its adapter."""
    module, function = PACKAGES[root]
    try:
        make = operator.attrgetter(function)(importlib.import_module(module))
    except ImportError as problem:
        raise ValueError(
            f'needs the package {root} ({problem}); pip install "jaxltl[{root}]".'
        ) from None
    extra = {"auto_reset": False} if root == "craftax" else {}
    adapter = getattr(importlib.import_module("jaxltl.envs"), f"from_{root}")
    ours = {x: arguments[x] for x in inspect.getfullargspec(adapter).kwonlyargs if x in arguments}
    with _user_errors(f"{root}:{name}"):
        value = make(name, **extra, **{k: v for k, v in arguments.items() if k not in ours})
        pair = value if isinstance(value, tuple) else (value,)
        return adapter(*pair, **ours | {"labels": labels, "propositions": propositions})


def function_of(name: str, folder: Path) -> Callable[..., PyTree]:
    """The function of a `name` ``"package.module:function"`` or ``"file.py:function"`` in a `folder`."""
    place, _, attribute = name.rpartition(":")
    if not place or not attribute.isidentifier():
        known = ", ".join((*BUILT_IN, *(f"{p}:NAME" for p in PACKAGES)))
        raise ValueError(
            f'{name!r} names no function; write "package.module:function", "file.py:function" '
            f"for a file beside the task file, or one of {known}."
        )
    module = _module_of_file(folder / place) if place.endswith(".py") else _module(place)
    value = getattr(module, attribute, None)
    if not callable(value):
        there = [
            n
            for n, x in vars(module).items()
            if callable(x)
            and not n.startswith("_")
            and getattr(x, "__module__", None) == module.__name__
        ]
        is_ = "is no function" if hasattr(module, attribute) else "is not there"
        raise ValueError(
            f"{attribute!r} {is_} in {place!r}; its functions are {', '.join(there) or '(none)'}."
        )
    return value


def _module(name: str) -> ModuleType:
    if not all(part.isidentifier() for part in name.split(".")):
        raise ValueError(
            f"{name!r} is neither the name of a module, package.module, nor that of a file, "
            "file.py."
        )
    try:
        return importlib.import_module(name)
    except ImportError as problem:
        missing = getattr(problem, "name", None) or ""
        if name != missing and not name.startswith(f"{missing}."):
            raise ValueError(f"{name!r} cannot be imported: {problem}.") from None
        raise ValueError(
            f"there is no module {name!r}: {problem}. Install its package, or name a file beside "
            'the task file, "file.py:function".'
        ) from None
    except (Exception, SystemExit) as problem:
        raise ValueError(_error_line(name, problem)) from problem


def _module_of_file(path: Path) -> ModuleType:
    """Imports a file, with its directory on the module path."""
    if not path.is_file():
        raise ValueError(f"there is no file {str(path)!r}.")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(path.parent.absolute()))
    before = sys.modules.get(path.stem)
    sys.modules[path.stem] = module  # needed by dataclasses
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as problem:
        raise ValueError(_error_line(path.name, problem)) from problem
    finally:
        sys.path.pop(0)
        if before is not None:
            sys.modules[path.stem] = before
    return module


@contextlib.contextmanager
def _user_errors(name: str) -> Iterator[None]:
    """Reports errors of a user's function in one line."""
    try:
        yield
    except (Exception, SystemExit) as problem:
        raise ValueError(_error_line(name, problem)) from problem


def _error_line(name: str, problem: BaseException) -> str:
    """The first line of an error, with its place in the user's code."""
    text = (str(problem).strip().splitlines() or [""])[0].rstrip(".: ")
    if isinstance(problem, ValueError) and text:
        return f"{name!r}: {text}."
    places = traceback.extract_tb(problem.__traceback__)
    # A SyntaxError names its own place.
    where = (
        ""
        if isinstance(problem, SyntaxError) or not places
        else (f" ({Path(places[-1].filename).name}, line {places[-1].lineno})")
    )
    return f"{name!r} raises {type(problem).__name__}{': ' if text else ''}{text}{where}."
