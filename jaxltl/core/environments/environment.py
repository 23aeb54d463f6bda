"""Worlds that are simulated: pure functions of one trajectory, the same for every learner.

An :class:`Environment` is made of functions of one trajectory, without batch axes and without
state of their own::

    reset(key) -> world
    step(world, action, key) -> Timestep(world, reward, terminated, truncated, cost, discount)
    observe(world) -> observation, an array or a tree of arrays
    labels(world) -> bool[P], which propositions hold
    allowed(world) -> bool[A], which of finitely many actions may be taken (optional)
    starts() -> (worlds, float[N]), all that reset draws, and how likely each is (optional)
    outcomes(world, action) -> (Timestep, float[K]), the same of a step (optional)

``world`` is any tree of arrays. Many trajectories are a ``vmap``. Two ways in which an episode ends
are told apart: it is *terminated* if nothing comes after it, and *truncated* if something would,
but is not simulated; a value is bootstrapped at the second alone. ``step`` never starts anew by
itself, so that the world in which an episode ended is seen;
:func:`~jaxltl.core.environments.episodes.auto_reset_step` does, for those who draw episodes one after the
other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.environments.purity import traced
from jaxltl.core.models import facts
from jaxltl.core.pretty_print import brief
from jaxltl.core.types import require_shape


@brief
@struct.dataclass
class Finite:
    """The actions ``0 .. num - 1``.

    Attributes:
      num: how many there are; static.

    Example:
      >>> Finite(4).num
      4
    """

    num: int = struct.field(pytree_node=False)


@brief(facts=facts.space)
@struct.dataclass
class Box:
    """Arrays between two bounds; made by :func:`make_box`.

    Attributes:
      low, high: arrays that broadcast to the shape; infinite where there is no bound.
      shape: static.
      dtype: by name; static.

    Example:
      >>> space = make_box([-1.0, 0.0], 1.0)
      >>> space.shape, space.low.tolist()
      ((2,), [-1.0, 0.0])
    """

    low: chex.Array
    high: chex.Array
    shape: tuple[int, ...] = struct.field(pytree_node=False)
    dtype: str = struct.field(pytree_node=False, default="float32")


def make_box(
    low: ArrayLike, high: ArrayLike, shape: Sequence[int] | None = None, dtype: Any = None
) -> Box:
    """Arrays between two bounds, checked: a :class:`Box`.


    Args:
      low, high: bounds, numbers or arrays; infinite for none.
      shape: of what is in it; default that of the bounds together.
      dtype: default that of the bounds together, at least a float of the default precision.

    Returns:
      :class:`Box`, whose bounds are NumPy's.

    Raises:
      ValueError: bounds that cross, are no numbers, or do not fit the shape.

    Example:
      >>> make_box(-1.0, [1.0, 2.0]).shape
      (2,)
    """
    bounds = {"low": _bounds(low), "high": _bounds(high)}
    for name, bound in bounds.items():
        if bound.dtype.kind not in "biuf" or np.isnan(bound.astype(float)).any():
            raise ValueError(f"make_box: {name}={bound.tolist()!r}; give numbers.")
    least, most = bounds.values()
    try:
        full = (
            np.broadcast_shapes(least.shape, most.shape)
            if shape is None
            else tuple(int(n) for n in shape)
        )
        fits = np.broadcast_shapes(least.shape, most.shape, full) == full
    except (TypeError, ValueError):
        fits, full = False, ()
    if not fits:
        raise ValueError(
            f"make_box: bounds of shapes {list(least.shape)} and {list(most.shape)} do not fit the "
            f"shape {shape}; give numbers, or arrays of that shape."
        )
    if (least > most).any():
        place = np.argwhere(least > most)[0].tolist()
        where = f" at {place}" if place else f": {least} above {most}"
        raise ValueError(f"make_box: low is above high{where}; exchange them.")
    try:
        kind = jnp.dtype(jnp.result_type(float) if dtype is None else dtype)
    except (TypeError, ValueError):
        raise ValueError(
            f"make_box: dtype={validation.shorten(dtype)}; give a type of numbers."
        ) from None
    if kind.kind not in "biuf":
        raise ValueError(f"make_box: dtype={kind.name}; give a type of numbers.")
    if kind.kind in "biu":  # an infinite bound is that of the type
        ends = (0, 1) if kind.kind == "b" else (jnp.iinfo(kind).min, jnp.iinfo(kind).max)
        least, most = (_clipped(x.astype(float), *ends).astype(kind) for x in (least, most))
    return Box(least.astype(kind), most.astype(kind), full, kind.name)


def _bounds(bound: ArrayLike) -> np.ndarray:
    try:
        return np.asarray(bound)
    except ValueError:  # ragged
        return np.asarray(None)


def _clipped(x: np.ndarray, least: int, most: int) -> np.ndarray:
    """In integers, since the greatest of 64 bits is no floating-point number."""
    inside = (x > least) & (x < most)
    return np.where(inside, np.where(inside, x, 0).astype(int), np.where(x > least, most, least))


@brief
class Timestep(NamedTuple):
    """What a step leads to; all but the world are scalars.

    Attributes:
      world: after the step, also where the episode ends with it.
      reward: earned by the step.
      terminated: whether the episode is over: nothing comes after `world`.
      truncated: whether it is merely cut off. Both may hold; then it is over.
      cost: of the step, for learners that keep to a limit.
      discount: of all that comes after the step, times the learner's own.

    Example:
      >>> made = Timestep(world=3, reward=1.0, terminated=True)
      >>> made.world, made.truncated, made.discount
      (3, False, 1.0)
    """

    world: Any
    reward: chex.Numeric
    terminated: chex.Numeric
    truncated: chex.Numeric = False
    cost: chex.Numeric = 0.0
    discount: chex.Numeric = 1.0


@brief(facts=facts.environment)
@struct.dataclass
class Environment:
    """A simulated world; made by :func:`make_environment`, whose text tells the functions.

    All of its numbers are arrays of the functions, ``jax.tree_util.Partial(function, *arrays)``:
    new ones do not recompile, and environments of one shape are stacked and vmapped.

    Attributes:
      reset, step, observe, labels: see the module's text.
      allowed: the actions that may be taken, or None: all.
      actions: :class:`Finite` or :class:`Box`.
      observations: a tree of :class:`Box`, as `observe` returns arrays.
      propositions: names of the P labels; static.
      horizon: after how many steps every episode has ended; None: not known; static.
      starts, outcomes: what may be drawn, or None: not told; the worlds and the fields of the
        Timestep have a first axis. Of a step that draws nothing they may be left out.

    Example:
      >>> coin = make_environment(
      ...     lambda key: jnp.int32(0), lambda world, action, key: Timestep(action, 0.0, False),
      ...     lambda world: world[None], actions=2)
      >>> coin.actions.num, coin.propositions, coin.horizon
      (2, (), None)
      >>> coin.step(0, 1, jax.random.key(0)).world
      1
    """

    reset: Callable[..., Any]
    step: Callable[..., Timestep]
    observe: Callable[..., Any]
    labels: Callable[..., jax.Array]
    allowed: Callable[..., jax.Array] | None
    actions: Finite | Box
    observations: Any
    propositions: tuple[str, ...] = struct.field(pytree_node=False)
    horizon: int | None = struct.field(pytree_node=False, default=None)
    starts: Callable[..., Any] | None = None
    outcomes: Callable[..., Any] | None = None


def make_environment(
    reset: Callable[..., Any],
    step: Callable[..., Timestep],
    observe: Callable[..., Any],
    *,
    actions: Finite | Box | int,
    labels: Callable[..., jax.Array] | None = None,
    propositions: Sequence[str] = (),
    allowed: Callable[..., jax.Array] | None = None,
    observations: Any = None,
    horizon: int | None = None,
    starts: Callable[..., Any] | None = None,
    outcomes: Callable[..., Any] | None = None,
) -> Environment:
    """A checked :class:`Environment`.

    Args:
      reset, step, observe: see the module's text; functions, or ``Partial`` objects that hand over
        arrays. A step may leave out what the last fields of :class:`Timestep` have by default.
      actions: what a step takes; a number is that of finitely many actions.
      labels: ``world -> bool[P]``; a row of all False where it is left out.
      propositions: their names.
      allowed: ``world -> bool[A]``, for finitely many actions.
      observations: a tree of :class:`Box`; default: without bounds.
      horizon: after how many steps every episode has ended, if that is known.
      starts, outcomes: see the module's text; for :func:`~jaxltl.core.environments.tabulate.tabulate`.

    Returns:
      :class:`Environment`.

    Raises:
      ValueError: a function that returns something of another shape, that is not pure (it keeps
        what it was called with, or is another function each time), or a name given twice.

    Example:
      >>> def reset(key):
      ...     return jnp.int32(0)
      >>> def step(place, action, key):
      ...     place = jnp.clip(place + 2 * action - 1, 0, 4)
      ...     return Timestep(place, reward=0.0, terminated=place == 4)
      >>> corridor = make_environment(
      ...     reset, step, lambda place: place[None] / 4, actions=2,
      ...     labels=lambda place: jnp.array([place == 4]), propositions=["goal"])
      >>> corridor.actions.num, corridor.observations.shape
      (2, (1,))
    """
    names = validation.distinct_names("propositions", propositions)
    if horizon is not None:
        horizon = validation.integer("horizon", horizon, least=1)
    if isinstance(actions, int | np.integer):
        actions = Finite(int(actions))
    if not isinstance(actions, Finite | Box):
        raise ValueError(f"actions={actions!r}; give Finite(number), or make_box(low, high).")
    if isinstance(actions, Finite) and actions.num < 1:
        raise ValueError(f"actions: Finite({actions.num}); there must be at least one.")
    if labels is None:
        if names:
            raise ValueError(f"propositions={list(names)}, but no labels; give both or neither.")
        labels = Partial(no_labels)
    made = Environment(
        reset=as_partial(reset, "reset"),
        step=as_partial(step, "step"),
        observe=as_partial(observe, "observe"),
        labels=as_partial(labels, "labels"),
        allowed=None if allowed is None else as_partial(allowed, "allowed"),
        actions=actions,
        observations=observations,
        propositions=names,
        horizon=horizon,
        starts=None if starts is None else as_partial(starts, "starts"),
        outcomes=None if outcomes is None else as_partial(outcomes, "outcomes"),
    )
    seen = _check_functions(made)
    if observations is None:

        def free(x: Any) -> Box:
            return make_box(-np.inf, np.inf, x.shape, x.dtype)

        made = replace(made, observations=jax.tree.map(free, seen))
    elif not _alike(found := _described(_as_arrays(observations)), _described(seen)):
        raise ValueError(f"observe returns {_described(seen)}, but observations is of {found}.")
    return made


def as_partial(function: Callable[..., Any], name: str = "function") -> Partial:
    """A function as a tree of arrays, which those that ``jit`` compiles take as an argument."""
    return (
        function if isinstance(function, Partial) else Partial(validation.function(name, function))
    )


def require_environment(environment: Any) -> Environment:
    """Refuses what is no :class:`Environment`."""
    found: Environment = validation.instance(
        "environment", environment, Environment, "one of make_environment"
    )
    return found


def require_key(key: Any) -> chex.PRNGKey:
    """Refuses what is no single key."""
    dtype = getattr(key, "dtype", None)
    typed = dtype is not None and jax.dtypes.issubdtype(dtype, jax.dtypes.prng_key)
    if not (typed and key.shape == ()) and not (dtype == np.uint32 and key.ndim == 1):
        raise ValueError(f"key is {validation.shorten(key)}; give a single one, jax.random.key(0).")
    return key


def no_labels(world: Any) -> jax.Array:
    """``bool[0]``: the labels of a world without propositions."""
    del world
    return jnp.zeros(0, bool)


def some_action(actions: Finite | Box) -> jax.ShapeDtypeStruct:
    """The shape and type of one action."""
    if isinstance(actions, Finite):
        return jax.ShapeDtypeStruct((), jnp.int32)
    return jax.ShapeDtypeStruct(actions.shape, jnp.dtype(actions.dtype))


def random_action(
    key: chex.PRNGKey, actions: Finite | Box, allowed: chex.Array | None = None
) -> jax.Array:
    """One action, uniform among those that are allowed; where a box has no bound, normal."""
    if isinstance(actions, Finite):
        weight = jnp.zeros(actions.num) if allowed is None else jnp.where(allowed, 0, -jnp.inf)
        return jax.random.categorical(key, weight).astype(jnp.int32)
    space = some_action(actions)
    low, high = (jnp.broadcast_to(x, space.shape) for x in (actions.low, actions.high))
    bounded = jnp.isfinite(low) & jnp.isfinite(high)
    share = jax.random.uniform(key, space.shape, space.dtype)
    inside = jnp.where(bounded, low, 0) + share * jnp.where(bounded, high - low, 0)
    normal = jax.random.normal(key, space.shape, space.dtype)
    return jnp.where(bounded, inside, jnp.clip(normal, low, high))


def clipped_action(actions: Box, action: chex.Array) -> jax.Array:
    """The action of a box that is nearest to an array of its shape."""
    return jnp.clip(action, actions.low, actions.high)


def flat_observation(observation: Any) -> jax.Array:
    """What is observed as one vector ``float[O]``, the arrays of a tree one after the other.

    Example:
      >>> flat_observation({"at": jnp.array([1.5, 2.5]), "open": jnp.bool_(True)}).tolist()
      [1.5, 2.5, 1.0]
    """
    leaves = [jnp.asarray(x) for x in jax.tree.leaves(observation)]
    floats = [x.dtype for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)]
    kind = jnp.result_type(*floats) if floats else jnp.result_type(float)
    return jnp.concatenate([jnp.ravel(x).astype(kind) for x in leaves])


def allowed_in(environment: Environment, world: Any) -> jax.Array | None:
    """``bool[A]``, the actions that may be taken in a world, or None: all."""
    return None if environment.allowed is None else environment.allowed(world)


# --- checks ---------------------------------------------------------------------------------------


def _check_functions(made: Environment) -> Any:
    """Shapes of all that the functions return; those of an observation are returned."""
    key = jax.random.key(0)
    world = traced("reset", made.reset, key)
    seen = traced("observe", made.observe, world)
    if not jax.tree.leaves(seen):
        raise ValueError("observe returns no array; return what the agent sees.")
    found = traced("step", made.step, world, some_action(made.actions), key)
    if not isinstance(found, tuple) or not 3 <= len(found) <= len(Timestep._fields):
        raise ValueError(
            f"step must return Timestep({', '.join(Timestep._fields)}), the last three if they are "
            f"wanted; it returns {_described(found)}."
        )
    found = Timestep(*found)
    for name in Timestep._fields[1:]:
        number = getattr(found, name)
        if np.shape(number) != () or not (np.isscalar(number) or hasattr(number, "dtype")):
            raise ValueError(
                f"step returns {name} of shape {list(np.shape(number))}; it must be "
                "a scalar. Functions are of one trajectory: vmap them for more."
            )
    for name in ("terminated", "truncated"):
        if not _is_bool(getattr(found, name)):
            raise ValueError(
                f"step returns {name} as {getattr(found, name).dtype}; return a Boolean."
            )
    if not _alike(after := _described(found.world), before := _described(world)):
        raise ValueError(
            f"step returns the world {after}, but reset {before}; both must have the "
            "same structure, shapes and dtypes."
        )
    require_labels(traced("labels", made.labels, world), made.propositions)
    if made.allowed is not None:
        if not isinstance(made.actions, Finite):
            raise ValueError("allowed is for finitely many actions; clip those of a box in step.")
        mask = traced("allowed", made.allowed, world)
        require_shape("allowed(world)", mask, (made.actions.num,))
        if not _is_bool(mask):
            raise ValueError(f"allowed returns {mask.dtype}; return Booleans.")
    return seen


def require_labels(label: Any, propositions: Sequence[str]) -> None:
    """Refuses labels of a world that are not ``bool[P]``."""
    if getattr(label, "shape", None) != (len(propositions),) or not _is_bool(label):
        raise ValueError(
            f"labels returns {_described(label)}; return bool[{len(propositions)}], one for each "
            f"of the propositions {list(propositions)}."
        )


def _is_bool(x: Any) -> bool:
    return np.dtype(getattr(x, "dtype", type(x))) == np.bool_


def _as_arrays(observations: Any) -> Any:
    for leaf in jax.tree.leaves(observations, is_leaf=lambda b: isinstance(b, Box)):
        validation.instance("observations", leaf, Box, "a tree of make_box(low, high)")
    return jax.tree.map(
        lambda b: jax.ShapeDtypeStruct(b.shape, jnp.dtype(b.dtype)),
        observations,
        is_leaf=lambda b: isinstance(b, Box),
    )


def _alike(described: Any, other: Any) -> bool:
    """Whether two trees are the same; classes of nodes may have an idea of their own of ``==``."""
    same: Any = jax.tree.structure(described)
    return same == jax.tree.structure(other) and (
        jax.tree.leaves(described) == jax.tree.leaves(other)
    )


def _described(tree: Any) -> Any:
    return jax.tree.map(
        lambda x: f"{x.dtype}{list(x.shape)}" if hasattr(x, "dtype") else type(x).__name__, tree
    )
