"""Shared parts of the adapters of other packages' environments."""

from __future__ import annotations

import contextlib
import importlib
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jax.tree_util import Partial
from jax.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.environments.environment import Timestep, as_partial
from jaxltl.core.models.protocols import Array, PyTree
from jaxltl.core.pretty_print import brief

Foreign: TypeAlias = Any  # an object, a type or a module of a package that may be missing


@jax.tree_util.register_static
class Held:
    """A static pytree leaf `it`: an object of a package, compared by identity."""

    def __init__(self, it: Foreign) -> None:
        self.it = it

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Held) and other.it is self.it

    def __hash__(self) -> int:
        return id(self.it)


@brief
class Seen(NamedTuple):
    """The package's state of an environment together with its last observation."""

    state: PyTree
    observation: PyTree


def package(name: str, root: str | None = None) -> Foreign:
    """Imports a module of another package; ImportError with the command that installs it.

    `root` is the name of the package and of its extra, by default the top-level module.
    """
    root = name.partition(".")[0] if root is None else root
    try:
        with warnings.catch_warnings():  # in its own imports
            warnings.simplefilter("ignore", DeprecationWarning)
            return importlib.import_module(name)
    except ImportError as problem:
        raise ImportError(
            f'from_{root} needs the package {root} ({problem}); pip install "jaxltl[{root}]".',
            name=problem.name,
        ) from problem


def require_environment(root: str, env: Foreign, kinds: Foreign, remedy: str) -> None:
    """Raises ValueError unless the argument is an environment of the package."""
    if not isinstance(env, kinds):
        kind = type(env)
        raise ValueError(
            f"from_{root}: env is a {kind.__module__}.{kind.__qualname__}, no environment of "
            f"{root}; give {remedy}."
        )


def params_of(root: str, params: Foreign, own: Foreign) -> Foreign:
    """The given parameters or the environment's default ones; ValueError for another type."""
    if params is None:
        return own
    if not isinstance(params, type(own)):
        raise ValueError(
            f"from_{root}: params is {validation.shorten(params)}; give a {type(own).__qualname__}, such "
            "as the environment's own with params.replace(...), or None for its own."
        )
    return params


@contextlib.contextmanager
def own_errors(root: str, env: Foreign) -> Iterator[None]:
    """Context manager that attributes errors raised while tracing to the package."""
    try:
        yield
    except ValueError:
        raise
    except Exception as problem:
        first = (str(problem).strip().splitlines() or [""])[0].rstrip(".")
        raise ValueError(
            f"from_{root}: {type(env).__name__} cannot be traced with JAX {jax.__version__}: "
            f"{type(problem).__name__}: {first}. Take another version of {root} or of "
            "JAX, or mend its labels."
        ) from problem


def refuse_wrappers(root: str, env: Foreign, attribute: str, kinds: Foreign, remedy: str) -> None:
    """Raises ValueError for auto-reset or batch wrappers in any layer of an environment."""
    for layer in layers(env, attribute):
        if isinstance(layer, kinds):
            raise ValueError(
                f"from_{root}: env is wrapped in {type(layer).__name__}; {remedy}. Episodes are "
                "started anew by those who draw them, and many of them are a vmap."
            )


def layers(env: Foreign, attribute: str) -> Iterator[Foreign]:
    """An environment and the environments that it wraps, outermost first."""
    while env is not None:
        yield env
        env = vars(env).get(attribute) if hasattr(env, "__dict__") else None


def copied(tree: PyTree) -> PyTree:
    """A copy of the containers of a tree, since some packages modify their arguments."""
    return jax.tree.map(lambda x: x, tree)


def reset_to_arrays(held: Held, *arguments: PyTree) -> PyTree:
    """The initial state of a package whose `reset` returns it alone."""
    return arrays(held.it.reset(*arguments))


def arrays(tree: PyTree, like: PyTree = None) -> PyTree:
    """Leaves as arrays with strong dtypes, those of a reference tree of the same structure if given."""
    like = tree if like is None else like
    kind: PyTree = jax.tree.structure(like)
    if kind != jax.tree.structure(tree):
        return tree

    def typed(x: ArrayLike, y: ArrayLike) -> ArrayLike:
        dtype = jnp.result_type(y)
        if jnp.issubdtype(dtype, jax.dtypes.extended):  # a key
            return x
        return lax.convert_element_type(x, dtype)

    return jax.tree.map(typed, tree, like)


def timestep(
    world: PyTree, before: PyTree, reward: Array, terminated: Array, truncated: Array
) -> Timestep:
    """A :class:`Timestep` with the dtypes of the protocol and zero costs."""
    return Timestep(
        arrays(world, before),
        jnp.asarray(reward, jnp.result_type(float)),
        jnp.asarray(terminated, bool),
        jnp.asarray(truncated, bool),
        jnp.zeros(()),
    )


def labels_of_state(labels: Callable[..., jax.Array] | None) -> Partial | None:
    """Labelling function of wrapped states from one of the package's states."""
    return None if labels is None else Partial(_label_state, as_partial(labels))


def _label_state(labels: Callable[..., jax.Array], world: Seen) -> jax.Array:
    return labels(world.state)


def observation_of(world: Seen) -> PyTree:
    """The observation stored in a wrapped state."""
    return world.observation


def some_allowed(mask: jax.Array) -> jax.Array:
    """An action mask; all actions where it is empty, which happens after the end of an episode."""
    return mask | ~mask.any()
