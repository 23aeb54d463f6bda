"""Hyperparameters: ranges declared with the fields, and their validation for all learners.

A learner's ``Hparams`` declares each field with its valid values::

    @struct.dataclass
    class Hparams:
        discount: Number = traced("discount")
        learning_rate: Schedule = traced(Range(0, open_above=True), default=1e-3, schedule=True)
        method: str = static(("trpo", "cpo"), default="cpo")
        num_envs: int = static(Range(1, integer=True), default=8)

A number that solvers have too, such as a discount, names its range in ``validation.RANGES``. A field
with default None may be None. The functions made by
:func:`~jaxltl.algos.common.learner.bind` call :func:`require_hparams` and :func:`flag_invalid`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, Protocol, TypeVar, cast

import flax.errors
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from numpy.typing import ArrayLike

from jaxltl.algos.common.networks import NetworkLike
from jaxltl.algos.common.schedules import at, is_schedule
from jaxltl.core import struct, validation
from jaxltl.core.array_types import PyTree
from jaxltl.core.types import Status, worst
from jaxltl.core.validation import Range

Number = jax.Array | float  # traced
MAX_INT = 2**31 - 1
COUNT = Range(1, MAX_INT, integer=True)


@struct.dataclass
class RunState:
    """Base of a learner's state.

    Attributes:
      key: root key of the run.
      step: ``int32[]``, number of steps made.

    >>> RunState(jax.random.key(0), jnp.int32(3)).step.item()
    3
    """

    key: jax.Array
    step: jax.Array


class HasStatus(Protocol):
    """A learner's metrics."""

    @property
    def status(self) -> jax.Array:
        """``int32[]``, a :class:`~jaxltl.Status`."""


MetricsT = TypeVar("MetricsT", bound=HasStatus)


class _Valid(NamedTuple):
    """Valid values of a field: a range, words, or the type bool."""

    values: Range | tuple[str, ...] | type[bool]
    is_static: bool
    may_be_schedule: bool


def traced(
    valid: Range | str, *, default: object = dataclasses.MISSING, schedule: bool = False
) -> Any:
    """A dataclass field with a traced number in the range `valid`, or if `schedule` a schedule of them.

    `valid` may name one of ``validation.RANGES``; a field with `default` None may be None.
    """
    valid = validation.RANGES[valid] if isinstance(valid, str) else valid
    return struct.field(default=default, metadata={"valid": _Valid(valid, False, schedule)})


def static(valid: Range | tuple[str, ...] | type[bool], *, default: object) -> Any:
    """A dataclass field with a static integer (or a tuple of them), word or truth value.

    `valid` is the range, the words, or bool; a field with `default` None may be None.

    >>> static(("trpo", "cpo"), default="cpo").default
    'cpo'
    """
    metadata = {"valid": _Valid(valid, True, False)}
    return struct.field(pytree_node=False, default=default, metadata=metadata)


def _declared(hparams: object) -> Iterator[tuple[str, Any, _Valid]]:
    """Name, value and valid values of all fields except those with a default of None and no value."""
    if not dataclasses.is_dataclass(hparams):
        return
    for field in dataclasses.fields(hparams):
        value = getattr(hparams, field.name)
        if "valid" in field.metadata and not (value is None and field.default is None):
            yield field.name, value, field.metadata["valid"]


def require_hparams(hparams: object, *, batched: bool = False) -> None:
    """Raises ValueError if a concrete number in `hparams` is outside its declared range.

    If `batched`, numbers may have a leading axis of lanes.

    >>> @struct.dataclass
    ... class Hparams:
    ...     discount: Number = traced(Range(0, 1))
    >>> require_hparams(Hparams(discount=1.5))
    Traceback (most recent call last):
    ValueError: discount=1.5; it must be at least 0 and at most 1.
    """
    fields = dataclasses.fields(hparams) if dataclasses.is_dataclass(hparams) else ()
    tuples = {field.name for field in fields if isinstance(field.default, tuple)}
    for name, value, (valid, is_static, may_be_schedule) in _declared(hparams):
        if valid is bool:
            validation.boolean(name, value)
        elif isinstance(valid, tuple):
            validation.choice(name, value, valid)
        elif is_static:
            for one in value if isinstance(value, tuple | list) and name in tuples else [value]:
                validation.require_in_range(name, one, valid)
        elif may_be_schedule and is_schedule(value):
            continue  # its values are checked step by step
        else:
            for one in np.ravel(value) if batched and np.ndim(value) else [value]:
                validation.require_in_range(name, one, valid)


def flag_invalid(metrics: MetricsT, hparams: object, step: jax.Array) -> MetricsT:
    """The `metrics`, with status INVALID if a traced hyperparameter in `hparams` is out of range.

    Schedules are evaluated at `step`, ``int32[]``.

    >>> @struct.dataclass
    ... class Metrics:
    ...     status: jax.Array
    >>> @struct.dataclass
    ... class Hparams:
    ...     discount: Number = traced(Range(0, 1))
    >>> check = jax.jit(lambda x: flag_invalid(Metrics(jnp.int32(0)), Hparams(x), jnp.int32(0)))
    >>> check(1.5).status.item() == Status.INVALID
    True
    """
    flags = []
    for _, value, (valid, is_static, may_be_schedule) in _declared(hparams):
        if is_static or not isinstance(valid, Range):
            continue
        number = at(value, step) if may_be_schedule else value
        if isinstance(number, jax.core.Tracer):
            flags.append(valid.contains(number))
    if not flags:
        return metrics
    status = jnp.where(jnp.stack(flags).all(), Status.CONVERGED, Status.INVALID)
    status = worst(metrics.status, status.astype(jnp.int32))
    return dataclasses.replace(cast(Any, metrics), status=status)


def require_own(*objects: tuple[object, type]) -> None:
    """Validation that each of the `objects` is of a learner's type: State, Problem or Hparams.

    Raises:
      ValueError: naming the function that makes such an object.

    >>> from jaxltl.algos import ppo
    >>> require_own((0.5, ppo.Hparams))
    Traceback (most recent call last):
    ValueError: hparams is float; give ppo.Hparams.
    """
    makers = {"State": "one of {0}.init or {0}.train", "Problem": "one of {0}.make_problem"}
    for value, kind in objects:
        learner, name = kind.__module__.split(".")[2], kind.__name__
        remedy = makers.get(name, "{0}.Hparams").format(learner)
        validation.instance(name.lower(), value, kind, remedy)


def require_arrays(**trees: PyTree) -> None:
    """Validation of `trees` by name: every leaf is an array or a number.

    Raises:
      ValueError: naming the place in the tree.

    >>> require_arrays(problem={"limit": "high"})
    Traceback (most recent call last):
    ValueError: problem['limit'] is 'high'; give a number or an array.
    """
    for name, tree in trees.items():
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            if not _is_array(leaf):
                place = f"{name}{jax.tree_util.keystr(path)}"
                raise ValueError(
                    f"{place} is {validation.shorten(leaf)}; give a number or an array."
                )


def _is_array(leaf: object) -> bool:
    if isinstance(leaf, bool | float | complex | jax.Array):
        return True
    if isinstance(leaf, int):
        largest = jnp.iinfo(jnp.result_type(int)).max
        return -largest <= leaf <= largest
    return isinstance(leaf, np.ndarray | np.generic) and leaf.dtype.kind in "biufc"


def require_output(
    subject: str, network: NetworkLike, inputs: PyTree, expected: tuple[int, ...], rows: str
) -> None:
    """Validation of the shape that a `network` returns for `inputs`; `subject` and `rows` are for the text.

    Raises:
      ValueError: with the shapes returned and expected.

    >>> import flax.linen as nn
    >>> require_output("logits have", nn.Dense(2), (np.zeros(3),), (2,), "one a symbol.")
    """
    output = jax.eval_shape(lambda *x: network.init_with_output(jax.random.key(0), *x)[0], *inputs)
    shape = getattr(output, "shape", type(output).__name__)
    if shape != expected:
        raise ValueError(f"{subject} shape {shape}; expected {expected}, {rows}")


def finite_features(
    name: str, table: ArrayLike, rows: tuple[int, ...], dtype: DTypeLike
) -> jax.Array:
    """The features `table` as ``float[*rows, F]`` in `dtype`; `name` is the argument in errors.

    Raises:
      ValueError: another shape than `rows` and one more axis, or entries that are not finite.

    >>> finite_features("features", np.ones((3, 2)), (3,), float).shape
    (3, 2)
    """
    values = np.asarray(table)
    if values.shape[:-1] != rows:
        raise ValueError(
            f"{name} has shape {values.shape}; expected ({', '.join(map(str, rows))}, any)."
        )
    if (wrong := np.argwhere(~np.isfinite(values))).size:
        raise ValueError(f"{name} at {tuple(wrong[0].tolist())} is not finite.")
    return jnp.asarray(values, dtype)


def applied(network: NetworkLike, parameters: PyTree, *read: PyTree) -> PyTree:
    """The output of a `network` with `parameters` for the inputs `read`.

    Raises:
      ValueError: parameters of another network, or inputs of other shapes.

    >>> import flax.linen as nn
    >>> applied(nn.Dense(2), {"kernel": np.eye(2), "bias": np.zeros(2)}, np.zeros(3))
    ... # doctest: +IGNORE_EXCEPTION_DETAIL
    Traceback (most recent call last):
    ValueError: the parameters are not those of this Dense ...
    """
    if not isinstance(parameters, Mapping):
        raise ValueError(
            f"the parameters are {validation.shorten(parameters)}; give the dict of those of the "
            f"{type(network).__name__}, such as state.parameters."
        )
    try:
        return network.apply({"params": parameters}, *read)
    except flax.errors.FlaxError as problem:
        text = str(problem).partition(" (https:")[0]
        raise ValueError(
            f"the parameters are not those of this {type(network).__name__} for what it reads: "
            f"{text} Give the state, the problem and the settings of one run, and observations "
            "of its environment."
        ) from problem
