"""Choices of a model's states, and reductions over them.

:class:`Actions` (padded models, ``[S, A]``) and :class:`ChoiceRows` (sparse models, ``[R]``) have the same
methods.
"""

from __future__ import annotations

from functools import reduce, singledispatch
from typing import NamedTuple, Protocol, TypeAlias

import chex
import jax
import jax.numpy as jnp
from jax import lax
from numpy.typing import DTypeLike

from jaxltl.core.models.ops import kernels
from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.protocols import Array, Model, PyTree
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core import struct, validation


def action_mean(policy: jax.Array, quantity: jax.Array) -> jax.Array:
    """Mean over a policy's actions, ``sum_a pi(s, a) x(s, a)``; the policy is ``float[S, A]`` or ``int32[S]``."""
    if is_deterministic(policy):
        return jnp.take_along_axis(quantity, policy[..., None], axis=-1)[..., 0]
    return jnp.sum(policy * quantity, axis=-1)


def action_max(quantity: jax.Array, available: jax.Array) -> jax.Array:
    """Maximum over available actions, ``[S]`` from ``[S, A]``; unrolled for few actions."""
    quantity = jnp.where(available, quantity, -jnp.inf)
    if quantity.shape[-1] > kernels.UNROLL:
        return quantity.max(axis=-1)
    return reduce(jnp.maximum, [quantity[..., a] for a in range(quantity.shape[-1])])


def action_argmax(quantity: jax.Array, available: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Maximum over available actions and the first maximiser, ``[S]`` each."""
    quantity = jnp.where(available, quantity, -jnp.inf)
    if quantity.shape[-1] > kernels.UNROLL:
        return quantity.max(axis=-1), quantity.argmax(axis=-1).astype(jnp.int32)
    best, action = quantity[..., 0], jnp.zeros(quantity.shape[:-1], jnp.int32)
    for a in range(1, quantity.shape[-1]):
        better = quantity[..., a] > best
        best = jnp.where(better, quantity[..., a], best)
        action = jnp.where(better, a, action)
    return best, action


def first_action(condition: jax.Array) -> tuple[jax.Array, jax.Array]:
    """True where a condition ``bool[S, A]`` holds for some action, and the first such action or 0."""
    highest, action = action_argmax(condition.astype(jnp.float32), jnp.ones_like(condition))
    return highest > 0, action


def is_deterministic(policy: chex.Array) -> bool:
    """True for a deterministic policy, given as integers; ValueError for anything but an array."""
    try:
        kind = jnp.result_type(policy)
    except TypeError:
        raise ValueError(
            f"policy is {validation.shorten(policy)}; give the number of an action (of a sparse "
            "model, of a choice) for each state, or weights of all."
        ) from None
    return jnp.issubdtype(kind, jnp.integer)


@struct.dataclass
class Actions:
    """Choices padded to the same number of actions in each state."""

    available: jax.Array  # bool[S, A]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.available.shape

    @property
    def layout(self) -> Columns:
        return Columns()

    def broadcast(self, x: jax.Array) -> jax.Array:
        """Broadcasts a quantity on states to choices."""
        return x[..., None]

    def sum(self, quantity: jax.Array) -> jax.Array:
        """``[S]``, of a quantity that is zero at unavailable actions."""
        return jnp.sum(quantity, axis=-1)

    def max(self, quantity: jax.Array, where: jax.Array | None = None) -> jax.Array:
        """``[S]``; minus infinity where the mask `where` is empty."""
        return action_max(quantity, self.available if where is None else where)

    def argmax(self, quantity: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The maximum and the first maximiser, ``[S]`` each."""
        return action_argmax(quantity, self.available)

    first = staticmethod(first_action)

    def all(self, condition: jax.Array) -> jax.Array:
        """``bool[S]``, True where a condition holds for all entries of a state."""
        return jnp.all(condition, axis=-1)

    def logits(self, quantity: jax.Array) -> jax.Array:
        """The quantity, minus infinity at unavailable actions."""
        return jnp.where(self.available, quantity, -jnp.inf)

    def top(self, logits: jax.Array) -> jax.Array:
        return jnp.max(logits, axis=-1)

    def logsumexp(self, logits: jax.Array) -> jax.Array:
        return jax.scipy.special.logsumexp(logits, axis=-1)

    def softmax(self, logits: jax.Array) -> jax.Array:
        return jax.nn.softmax(logits, axis=-1)

    mean = staticmethod(action_mean)

    def one_hot(self, choice: jax.Array, dtype: DTypeLike) -> jax.Array:
        return jax.nn.one_hot(choice, self.shape[-1], dtype=dtype)

    def columns(self, quantity: jax.Array) -> list[jax.Array]:
        """A arrays ``[N]``, contiguous in memory."""
        return action_columns(self.shape[-1], quantity)

    def whole(self, columns: list[jax.Array]) -> jax.Array:
        """The inverse of `columns`."""
        return jnp.stack(columns, axis=-1).reshape(self.shape)


@struct.dataclass
class Columns:
    """Padded choices as an array ``[N, ...]`` for each action; weight 0 and value -inf where unavailable."""

    def broadcast(self, x: jax.Array, like: list[jax.Array]) -> list[jax.Array]:
        """Broadcasts a quantity on states to choices."""
        return [x] * len(like)

    def sum(self, quantity: list[jax.Array]) -> jax.Array:
        return reduce(jnp.add, quantity)

    def max(self, quantity: list[jax.Array]) -> jax.Array:
        return reduce(jnp.maximum, quantity)

    def best(self, quantity: list[jax.Array]) -> tuple[jax.Array, list[jax.Array]]:
        """The maximum, and weight one on the first maximiser."""
        best = self.max(quantity)
        weight, free = [], jnp.ones(best.shape, bool)
        for x in quantity:
            here = free & (x >= best)
            weight.append(here.astype(best.dtype))
            free &= ~here
        return best, weight

    def mean(self, weight: list[jax.Array], quantity: list[jax.Array]) -> jax.Array:
        """See :class:`Actions`; weights may lack the batch axis."""
        return self.sum([_beside(w, x) * x for w, x in zip(weight, quantity, strict=True)])

    def size(self, quantity: list[jax.Array]) -> int:
        return quantity[0].shape[0]

    def packed(self, quantity: list[jax.Array]) -> jax.Array:
        return jnp.stack(quantity)

    def unpacked(self, packed: jax.Array) -> list[jax.Array]:
        return list(packed)


def _unchanged(quantity: jax.Array) -> jax.Array:
    return quantity


@struct.dataclass
class ChoiceRows:
    """Choices without padding, grouped by state; quantities have the shape ``[R, ...]`` in every layout."""

    state: jax.Array  # int32[R], ascending
    start: jax.Array  # int32[S + 1], the first row of each state

    @property
    def shape(self) -> tuple[int, ...]:
        return self.state.shape

    @property
    def layout(self) -> ChoiceRows:
        return self

    @property
    def num_states(self) -> int:
        return self.start.shape[0] - 1

    @property
    def available(self) -> jax.Array:
        return jnp.ones(self.shape, bool)

    def size(self, quantity: jax.Array) -> int:
        return self.num_states

    def broadcast(self, x: jax.Array, like: jax.Array | None = None) -> jax.Array:
        """See :class:`Actions`; with `like`, a quantity without an axis of states is unchanged."""
        x = jnp.asarray(x)
        if like is not None and x.ndim < like.ndim:
            return x
        return kernels.gather(x, self.state)

    def sum(self, quantity: jax.Array) -> jax.Array:
        return kernels.segment_reduce(jnp.add, quantity, self.state, self.num_states)

    def max(self, quantity: jax.Array, where: jax.Array | None = None) -> jax.Array:
        """See :class:`Actions`; the derivative is that of the maximiser."""
        if where is not None:
            quantity = jnp.where(where, quantity, -jnp.inf)
        best, row = self.argmax(quantity)
        return jnp.where(jnp.isnan(best), jnp.nan, kernels.gather(quantity, row))

    def argmax(self, quantity: jax.Array) -> tuple[jax.Array, jax.Array]:
        fixed = lax.stop_gradient(quantity)
        best = kernels.segment_reduce(jnp.maximum, fixed, self.state, self.num_states)
        some, row = self.first(fixed >= kernels.gather(best, self.state))
        return jnp.where(some, best, jnp.nan), row

    def first(self, condition: jax.Array) -> tuple[jax.Array, jax.Array]:
        last = self.shape[0]
        number = jnp.arange(last, dtype=jnp.int32)
        row = kernels.segment_reduce(
            jnp.minimum, jnp.where(condition, number, last), self.state, self.num_states
        )
        some = row < last
        return some, jnp.where(some, row, self.start[:-1]).astype(jnp.int32)

    def all(self, condition: jax.Array) -> jax.Array:
        return ~self.first(~condition)[0]

    def logits(self, quantity: jax.Array) -> jax.Array:
        return quantity

    def top(self, logits: jax.Array) -> jax.Array:
        fixed = lax.stop_gradient(logits)
        return kernels.segment_reduce(jnp.maximum, fixed, self.state, self.num_states)

    def logsumexp(self, logits: jax.Array) -> jax.Array:
        top = lax.stop_gradient(self.top(logits))
        return jnp.log(self.sum(jnp.exp(logits - self.broadcast(top)))) + top

    def softmax(self, logits: jax.Array) -> jax.Array:
        raised = jnp.exp(logits - self.broadcast(lax.stop_gradient(self.top(logits))))
        return raised / self.broadcast(self.sum(raised))

    def mean(self, policy: jax.Array, quantity: jax.Array) -> jax.Array:
        if is_deterministic(policy):
            return kernels.gather(quantity, policy)
        return self.sum(_beside(policy, quantity) * quantity)

    def one_hot(self, choice: jax.Array, dtype: DTypeLike) -> jax.Array:
        number = jnp.arange(self.shape[0], dtype=jnp.int32)
        mine = kernels.gather(jnp.asarray(choice), self.state)
        return (number == mine).astype(jax.dtypes.canonicalize_dtype(dtype))

    def best(self, quantity: jax.Array) -> tuple[jax.Array, jax.Array]:
        best, row = self.argmax(quantity)
        return best, self.one_hot(row, best.dtype)

    columns = whole = packed = unpacked = staticmethod(_unchanged)


Layout: TypeAlias = Columns | ChoiceRows
Quantity: TypeAlias = PyTree  # on choices: columns ``[N, ...]``, of a sparse model ``[R, ...]``


class SweepOperator(Protocol):
    """Transitions of a model for compiled sweeps."""

    @property
    def choices(self) -> Layout:
        """The layout of quantities on choices."""

    def expectation(self, value: jax.Array) -> Quantity:
        """Expected value of the next state, on choices, from ``[N, ...]``."""


@singledispatch
def choices(model: Model) -> Actions | ChoiceRows:
    """The choices of a model; a new representation has `available`."""
    if not hasattr(model, "available"):
        raise ValueError(validation.unsupported_model(model))
    return Actions(model.available)


@choices.register(SparseMDP)
def row_choices(model: SparseMDP) -> ChoiceRows:
    """Choices of a sparse model, by rows."""
    return ChoiceRows(
        kernels.segment_ids(model.row_start, model.num_rows), jnp.asarray(model.row_start)
    )


class RowEntries(NamedTuple):
    """The transitions of a sparse model for compiled sweeps."""

    choices: ChoiceRows
    row: jax.Array  # int32[T]
    successor: jax.Array  # int32[T]
    probability: jax.Array  # float[T]

    def combined(self, value: jax.Array, term: kernels.Term, combine: kernels.Term) -> jax.Array:
        """A reduction over the entries of each row: ``[R, ...]`` from ``[S, ...]``."""
        reached = kernels.gather(value, self.successor)
        terms = term(self.probability.reshape(-1, *(1,) * (reached.ndim - 1)), reached)
        return kernels.segment_reduce(combine, terms, self.row, self.choices.shape[0])

    def expectation(self, value: jax.Array) -> jax.Array:
        """Expected value of the next state, ``[R, ...]`` from ``[S, ...]``."""
        return self.combined(value, jnp.multiply, jnp.add)

    def matrix(self, weight: jax.Array) -> jax.Array:
        """``float[S, S]`` under weights ``[R]`` of the rows."""
        size = self.choices.num_states
        entry = kernels.gather(weight, self.row) * self.probability
        state = kernels.gather(self.choices.state, self.row)
        return jnp.zeros((size, size), entry.dtype).at[state, self.successor].add(entry)


def row_entries(model: SparseMDP) -> RowEntries:
    """A sparse model's transitions, with the row of each entry and the state of each row."""
    return RowEntries(
        row_choices(model),
        kernels.segment_ids(model.entry_start, model.num_transitions),
        jnp.asarray(model.successor),
        jnp.asarray(model.probability),
    )


@singledispatch
def choice_shape(model: Model) -> tuple[int, ...]:
    """The shape of a quantity on choices: ``(S, A)``, ``(S, Q, A)`` for a product, or ``(R,)``."""
    if not hasattr(model, "num_actions"):
        raise ValueError(validation.unsupported_model(model))
    return (*model.state_shape, model.num_actions)


@choice_shape.register
def _(model: SparseMDP) -> tuple[int, ...]:
    return (model.num_rows,)


def state_mask(model: Model, name: str, value: Array) -> Array:
    """A set of states ``bool[S]`` as an argument; ValueError for another shape or other values."""
    if not hasattr(model, "state_shape"):
        raise ValueError(validation.unsupported_model(model))
    return _mask(name, value, model.state_shape, "a state")


def choice_mask(model: Model, name: str, value: Array | None) -> Array | None:
    """A set of choices ``bool[S, A]``, or ``bool[R]`` of a sparse model, as an argument."""
    return None if value is None else _mask(name, value, choice_shape(model), "a choice")


def _mask(name: str, value: Array, shape: tuple[int, ...], of: str) -> Array:
    traced = is_traced(value)
    # The operators of sets negate bitwise, so that integers 0 and 1 would be other sets.
    mask = value if traced else validation.boolean_array(name, value)
    if mask.shape != shape or mask.dtype != bool:
        raise ValueError(
            f"{name} has shape {list(mask.shape)} and type {mask.dtype}; "
            f"give bool{list(shape)}, whether it contains {of}."
        )
    return mask


def action_columns(num_actions: int, quantity: jax.Array) -> list[jax.Array]:
    """``[S, A]`` as A arrays ``[N]``, contiguous in memory."""
    rows = quantity.reshape(-1, num_actions)
    return [rows[:, a] for a in range(num_actions)]


def _beside(weight: jax.Array, quantity: jax.Array) -> jax.Array:
    return weight.reshape(weight.shape + (1,) * (quantity.ndim - weight.ndim))
