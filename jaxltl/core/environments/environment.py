"""Simulated environments: pure functions of one trajectory, the same for every learner.

An :class:`Environment` consists of functions without batch axes and without internal state::

    reset(key) -> world
    step(world, action, key) -> Timestep(world, reward, terminated, truncated, cost, discount)
    observe(world) -> observation, an array or a tree of arrays
    labels(world) -> bool[P], the propositions that hold
    allowed(world) -> bool[A], the available actions (optional)
    starts() -> (worlds, float[N]), the support of reset and its probabilities (optional)
    outcomes(world, action) -> (Timestep, float[K]), the same of a step (optional)

The state ``world`` is a tree of arrays, and a batch of trajectories is a ``vmap``. An episode is
*terminated* in an absorbing state, and *truncated* where only the simulation ends; values are
bootstrapped at truncation alone. ``step`` never resets, so that the last state of an episode is
visible; :func:`~jaxltl.core.environments.episodes.auto_reset_step` resets.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr
from jax.tree_util import Partial
from numpy.typing import ArrayLike, DTypeLike

from jaxltl.core import struct, validation
from jaxltl.core.models.protocols import Array, Key, Numeric, PyTree
from jaxltl.core.pretty_print import brief
from jaxltl.core.types import require_shape

ENDINGS = ("repeat", "violated", "undecided", "rejected")


@struct.dataclass
class Finite:
    """The finite action space of the actions 0 to `num` - 1; `num` is static.

    >>> Finite(4).num
    4
    """

    num: int = struct.field(pytree_node=False)


@brief
@struct.dataclass
class Box:
    """A space of arrays between two bounds; :func:`make_box` builds a checked one.

    Attributes:
      low, high: arrays that broadcast to the shape, infinite where unbounded.
      shape, dtype: the shape and the name of the dtype; static.

    >>> space = make_box([-1.0, 0.0], 1.0)
    >>> space.shape, space.low.tolist()
    ((2,), [-1.0, 0.0])
    """

    low: Array
    high: Array
    shape: tuple[int, ...] = struct.field(pytree_node=False)
    dtype: str = struct.field(pytree_node=False, default="float32")


def make_box(
    low: ArrayLike,
    high: ArrayLike,
    shape: Sequence[int] | None = None,
    dtype: DTypeLike | None = None,
) -> Box:
    """A checked :class:`Box`.

    Args:
      low, high: bounds, numbers or arrays, infinite for none.
      shape: default: that of the bounds together.
      dtype: default: that of the bounds together, at least a float of the default precision.

    Returns:
      :class:`Box` with NumPy bounds.

    Raises:
      ValueError: bounds that cross, are not numbers, or do not fit the shape.

    >>> make_box(-1.0, [1.0, 2.0]).shape
    (2,)
    """
    bounds = {"low": as_array(low), "high": as_array(high)}
    for name, bound in bounds.items():
        if bound.dtype.kind not in "biuf" or np.isnan(bound.astype(float)).any():
            raise ValueError(f"make_box: {name}={bound.tolist()!r}; give numbers.")
    least, greatest = bounds.values()
    try:
        whole = np.broadcast_shapes(least.shape, greatest.shape) if shape is None else shape
        full = tuple(int(n) for n in whole)
        fits = np.broadcast_shapes(least.shape, greatest.shape, full) == full
    except (TypeError, ValueError):
        fits, full = False, ()
    if not fits:
        raise ValueError(
            f"make_box: bounds of shapes {list(least.shape)} and {list(greatest.shape)} do not fit the "
            f"shape {shape}; give numbers, or arrays of that shape."
        )
    if (least > greatest).any():
        place = np.argwhere(least > greatest)[0].tolist()
        where = f" at {place}" if place else f": {least} above {greatest}"
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
        least, greatest = (_clipped(x.astype(float), *ends).astype(kind) for x in (least, greatest))
    return Box(least.astype(kind), greatest.astype(kind), full, kind.name)


def as_array(values: ArrayLike) -> np.ndarray:
    """The array of nested sequences; one of None if they are ragged."""
    try:
        return np.asarray(values)
    except ValueError:  # ragged
        return np.asarray(None)


def _clipped(x: np.ndarray, least: int, greatest: int) -> np.ndarray:
    """Clips to integer bounds; 2^63 - 1 has no exact floating-point value."""
    inside = (x > least) & (x < greatest)
    return np.where(
        inside, np.where(inside, x, 0).astype(int), np.where(x > least, greatest, least)
    )


@brief
class Timestep(NamedTuple):
    """The result of a step; all fields but `world` are scalars.

    Attributes:
      world: the state after the step, also at the end of an episode.
      reward, cost: of the step; the cost is for constrained learners.
      terminated, truncated: True in an absorbing state, and where only the simulation ends.
      discount: the discount of later rewards, a factor on the learner's own.

    >>> made = Timestep(world=3, reward=1.0, terminated=True)
    >>> made.world, made.truncated, made.discount
    (3, False, 1.0)
    """

    world: PyTree
    reward: Numeric
    terminated: Numeric
    truncated: Numeric = False
    cost: Numeric = 0.0
    discount: Numeric = 1.0


@brief
@struct.dataclass
class Environment:
    """A simulated environment; :func:`make_environment` builds a checked one.

    Its numbers are arrays of the functions, ``jax.tree_util.Partial(function, *arrays)``: new numbers
    do not recompile, and environments of one shape are stacked and vmapped.

    Attributes:
      reset, step, observe, labels, allowed, starts, outcomes: see the module documentation; the last
        three may be None. Arrays of `starts` and `outcomes` have a leading axis.
      actions: :class:`Finite` or :class:`Box`.
      observations: a tree of :class:`Box` with the structure of an observation.
      propositions: names of the P labels; static.
      horizon: an upper bound on the length of episodes, or None; static.
      ending: the default of the option `ending` of tasks, the verdict of terminal states; static.

    >>> coin = make_environment(
    ...     lambda key: jnp.int32(0), lambda world, action, key: Timestep(action, 0.0, False),
    ...     lambda world: world[None], actions=2)
    >>> coin.actions.num, coin.propositions, coin.horizon
    (2, (), None)
    """

    reset: Callable[..., PyTree]
    step: Callable[..., Timestep]
    observe: Callable[..., PyTree]
    labels: Callable[..., jax.Array]
    allowed: Callable[..., jax.Array] | None
    actions: Finite | Box
    observations: PyTree
    propositions: tuple[str, ...] = struct.field(pytree_node=False)
    horizon: int | None = struct.field(pytree_node=False, default=None)
    starts: Callable[..., PyTree] | None = None
    outcomes: Callable[..., PyTree] | None = None
    ending: str = struct.field(pytree_node=False, default="repeat")


def make_environment(
    reset: Callable[..., PyTree],
    step: Callable[..., Timestep],
    observe: Callable[..., PyTree],
    *,
    actions: Finite | Box | int,
    labels: Callable[..., jax.Array] | None = None,
    propositions: Sequence[str] = (),
    allowed: Callable[..., jax.Array] | None = None,
    observations: PyTree = None,
    horizon: int | None = None,
    starts: Callable[..., PyTree] | None = None,
    outcomes: Callable[..., PyTree] | None = None,
    ending: str = "repeat",
) -> Environment:
    """A checked :class:`Environment`.

    Args:
      reset, step, observe: see the module documentation; functions, or ``Partial`` objects with
        arrays. A step may omit the last fields of :class:`Timestep`.
      actions: the action space; a number stands for :class:`Finite`.
      labels, allowed, starts, outcomes: see the module documentation.
      propositions: the P names.
      observations: a tree of :class:`Box`; default: unbounded.
      horizon: an upper bound on the length of episodes.
      ending: ``"repeat"``, ``"violated"``, ``"undecided"`` or ``"rejected"``, the default of the
        argument of tasks (:func:`~jaxltl.core.environments.task_environment.task_environment`).

    Returns:
      :class:`Environment`.

    Raises:
      ValueError: a function with a result of another shape, a function that is not pure, or a
        repeated name.

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
    actions = Finite(int(actions)) if isinstance(actions, int | np.integer) else actions
    if not isinstance(actions, Finite | Box):
        raise ValueError(f"actions={actions!r}; give Finite(number), or make_box(low, high).")
    if isinstance(actions, Finite) and actions.num < 1:
        raise ValueError(f"actions: Finite({actions.num}); there must be at least one.")
    functions: dict[str, PyTree] = {"reset": reset, "step": step, "observe": observe}
    for name, function in functions.items():
        validation.function(name, function)
    functions |= {"labels": labels, "allowed": allowed, "starts": starts, "outcomes": outcomes}
    if labels is None:
        if names:
            raise ValueError(f"propositions={list(names)}, but no labels; give both or neither.")
        functions["labels"] = Partial(no_labels)
    parts: dict[str, PyTree] = {
        name: None if f is None else as_partial(f, name) for name, f in functions.items()
    }
    environment = Environment(
        **parts,
        actions=actions,
        observations=observations,
        propositions=names,
        horizon=horizon,
        ending=validation.choice("ending", ending, ENDINGS),
    )
    seen = _check_functions(environment)
    if observations is None:

        def free(x: jax.Array) -> Box:
            return make_box(-np.inf, np.inf, x.shape, x.dtype)

        environment = replace(environment, observations=jax.tree.map(free, seen))
    elif not _alike(declared := _described(_as_arrays(observations)), _described(seen)):
        raise ValueError(f"observe returns {_described(seen)}, but observations is of {declared}.")
    return environment


def as_partial(function: Callable[..., PyTree], name: str = "function") -> Partial:
    """A function as a pytree, which compiled functions accept as an argument."""
    if isinstance(function, Partial):
        return function
    return Partial(validation.function(name, function))


def require_environment(environment: object) -> Environment:
    """An :class:`Environment`, or that of an object with the property `environment`; else ValueError."""
    return cast(
        Environment,
        validation.instance(
            "environment",
            getattr(environment, "environment", environment),
            Environment,
            "one of make_environment",
        ),
    )


def require_key(key: Key) -> Key:
    """Raises ValueError for anything but a single random key."""
    dtype = getattr(key, "dtype", None)
    typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    if not (typed and key.shape == ()) and not (dtype == np.uint32 and key.ndim == 1):
        raise ValueError(f"key is {validation.shorten(key)}; give a single one, jax.random.key(0).")
    return key


def no_labels(world: PyTree) -> jax.Array:
    """``bool[0]``: the labels of an environment without propositions."""
    del world
    return jnp.zeros(0, bool)


def some_action(actions: Finite | Box) -> jax.ShapeDtypeStruct:
    """Shape and dtype of an action."""
    if isinstance(actions, Finite):
        return jax.ShapeDtypeStruct((), jnp.int32)
    return jax.ShapeDtypeStruct(actions.shape, jnp.dtype(actions.dtype))


def clipped_action(actions: Box, action: Array) -> jax.Array:
    """The projection of an action onto a box."""
    return jnp.clip(action, actions.low, actions.high)


def flat_observation(observation: PyTree) -> jax.Array:
    """An observation as one vector ``float[O]``, the concatenated arrays of its tree."""
    leaves = [jnp.asarray(x) for x in jax.tree.leaves(observation)]
    floats = [x.dtype for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)]
    kind = jnp.result_type(*floats) if floats else jnp.result_type(float)
    return jnp.concatenate([jnp.ravel(x).astype(kind) for x in leaves])


def optional(function: Callable[..., PyTree], *arguments: PyTree) -> Partial | None:
    """``Partial(function, *arguments)``; None if the last argument is None."""
    return None if arguments[-1] is None else Partial(function, *arguments)


def of_world(function: Callable[..., PyTree], state: PyTree) -> PyTree:
    """A function of the state ``state.world`` of an inner environment."""
    return function(state.world)


def allowed_in(environment: Environment, world: PyTree) -> jax.Array | None:
    """``bool[A]``, the available actions in a state, or None if all are."""
    return None if environment.allowed is None else environment.allowed(world)


# --- checks ---------------------------------------------------------------------------------------


def _check_functions(environment: Environment) -> PyTree:
    """Checks the shapes of all results; returns those of an observation."""
    key = jax.random.key(0)
    world = traced("reset", environment.reset, key)
    seen = traced("observe", environment.observe, world)
    if not jax.tree.leaves(seen):
        raise ValueError("observe returns no array; return what the agent sees.")
    step = traced("step", environment.step, world, some_action(environment.actions), key)
    if not isinstance(step, tuple) or not 3 <= len(step) <= len(Timestep._fields):
        raise ValueError(
            f"step must return Timestep({', '.join(Timestep._fields)}), the last three if they are "
            f"wanted; it returns {_described(step)}."
        )
    step = Timestep(*step)
    for name in Timestep._fields[1:]:
        number = getattr(step, name)
        if np.shape(number) != () or not (np.isscalar(number) or hasattr(number, "dtype")):
            raise ValueError(
                f"step returns {name} of shape {list(np.shape(number))}; it must be "
                "a scalar. Functions are of one trajectory: vmap them for more."
            )
    for name in ("terminated", "truncated"):
        if not _is_bool(getattr(step, name)):
            raise ValueError(
                f"step returns {name} as {getattr(step, name).dtype}; return a Boolean."
            )
    if not _alike(after := _described(step.world), before := _described(world)):
        raise ValueError(
            f"step returns the world {after}, but reset {before}; both must have the "
            "same structure, shapes and dtypes."
        )
    require_labels(traced("labels", environment.labels, world), environment.propositions)
    if environment.allowed is not None:
        if not isinstance(environment.actions, Finite):
            raise ValueError("allowed is for finitely many actions; clip those of a box in step.")
        mask = traced("allowed", environment.allowed, world)
        require_shape("allowed(world)", mask, (environment.actions.num,))
        if not _is_bool(mask):
            raise ValueError(f"allowed returns {mask.dtype}; return Booleans.")
    return seen


def require_labels(label: object, propositions: Sequence[str]) -> None:
    """Raises ValueError unless labels are ``bool[P]``."""
    if getattr(label, "shape", None) != (len(propositions),) or not _is_bool(label):
        raise ValueError(
            f"labels returns {_described(label)}; return bool[{len(propositions)}], one for each "
            f"of the propositions {list(propositions)}."
        )


def _is_bool(x: object) -> bool:
    return np.dtype(getattr(x, "dtype", type(x))) == np.bool_


def _as_arrays(observations: PyTree) -> PyTree:
    for leaf in jax.tree.leaves(observations, is_leaf=lambda b: isinstance(b, Box)):
        validation.instance("observations", leaf, Box, "a tree of make_box(low, high)")
    return jax.tree.map(
        lambda b: jax.ShapeDtypeStruct(b.shape, jnp.dtype(b.dtype)),
        observations,
        is_leaf=lambda b: isinstance(b, Box),
    )


def _alike(described: PyTree, other: PyTree) -> bool:
    """True if two trees agree; node classes may define another ``==``."""
    same: PyTree = jax.tree.structure(described)
    return same == jax.tree.structure(other) and (
        jax.tree.leaves(described) == jax.tree.leaves(other)
    )


def _described(tree: PyTree) -> PyTree:
    return jax.tree.map(
        lambda x: f"{x.dtype}{list(x.shape)}" if hasattr(x, "dtype") else type(x).__name__, tree
    )


# --- purity, and dependence on arguments -----------------------------------------------------------


def traced(name: str, function: Callable[..., PyTree], *arguments: PyTree) -> PyTree:
    """Shapes of the results of a function that is pure, as far as tracing it twice shows."""
    try:
        try:
            with jax.checking_leaks():
                first, again, shapes = _twice(function, *arguments)
        except Exception as problem:
            if not _kept_by_jax(problem):
                raise
            first, again, shapes = _twice(function, *arguments)
    except (jax.errors.JAXTypeError, jax.errors.ConcretizationTypeError) as problem:
        text = str(problem).split("\n", 1)[0]
        raise ValueError(
            f"{name} cannot be traced: {text} Write it with jax.numpy; lax.cond and jnp.where "
            "take the place of if."
        ) from problem
    except Exception as problem:
        if "Leaked" not in str(problem):
            raise
        raise ValueError(
            f"{name} is not pure: it keeps what it was called with. Keep it in the world that "
            "is returned."
        ) from problem
    if not _same(first, again):
        raise ValueError(
            f"{name} is not pure: called twice it is two different functions. Draw from the key "
            "that is given, and keep what changes in the world that is returned."
        )
    return shapes


def _twice(
    function: Callable[..., PyTree], *arguments: PyTree
) -> tuple[ClosedJaxpr, ClosedJaxpr, PyTree]:
    first, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    # Another object, so that the second trace is not the first, remembered.
    return first, jax.make_jaxpr(lambda *args: function(*args))(*arguments), shapes


def _kept_by_jax(problem: Exception) -> bool:
    """True if JAX's own caches hold all leaked tracers, as for solvers of jaxopt."""
    head, *leaks = str(problem).strip().split("\n\n")
    own = "<PyTreeDef ", "<WeakrefLRUCache ", "jax._src."
    return (
        "Leaked" in head
        and bool(leaks)
        and all(any(f" is referred to by {x}" in leak for x in own) for leak in leaks)
    )


def _same(first: ClosedJaxpr, again: ClosedJaxpr) -> bool:
    constants = zip(first.consts, again.consts, strict=False)
    return (
        len(first.consts) == len(again.consts)
        and str(first.jaxpr) == str(again.jaxpr)
        and all(
            np.array_equal(np.asarray(x), np.asarray(y), equal_nan=np.asarray(x).dtype.kind == "f")
            for x, y in constants
            if not isinstance(x, jax.core.Tracer)
            and not jnp.issubdtype(getattr(x, "dtype", np.dtype(float)), jax.dtypes.prng_key)
        )
    )


def reads_key(function: Callable[..., PyTree], *arguments: PyTree) -> bool:
    """True if a result may depend on the last argument; False is a proof, by the jaxpr."""
    program = jax.make_jaxpr(function)(*arguments).jaxpr
    count = len(jax.tree.leaves(arguments[-1]))
    return any(marked_results(program, [False] * (len(program.invars) - count) + [True] * count))


def marked_results(program: Jaxpr, marked: list[bool]) -> list[bool]:
    """The results that may depend on marked arguments."""
    marks = {id(x) for x, mark in zip(program.invars, marked, strict=True) if mark}
    for line in program.eqns:
        reads = [id(x) in marks for x in line.invars]
        if not any(reads):
            continue
        written = [True] * len(line.outvars)
        part = line.params.get("jaxpr") if line.primitive.name in ("pjit", "jit") else None
        if part is not None:
            written = marked_results(part.jaxpr, reads)
        marks |= {id(x) for x, mark in zip(line.outvars, written, strict=True) if mark}
    return [id(x) in marks for x in program.outvars]
