"""Markov decision processes with padded or dense arrays, and their validation."""

from __future__ import annotations

from typing import cast

from collections.abc import Mapping, Sequence

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import struct, validation
from jaxltl.core.validation import first_true
from numpy.typing import DTypeLike

from jaxltl.core.pretty_print import brief
from jaxltl.core.models.ops.array_namespace import is_traced, to_jax
from jaxltl.core.models.ops.underflow import target_dtype, underflow_text, underflows
from jaxltl.core.models.protocols import Array, Model


class _PaddedShape:
    available: jax.Array

    @property
    def num_states(self) -> int:
        """S."""
        return self.available.shape[-2]

    @property
    def num_actions(self) -> int:
        """A."""
        return self.available.shape[-1]

    @property
    def state_shape(self) -> tuple[int, ...]:
        """The shape of a value: ``(S,)``."""
        return (self.num_states,)


@brief(drawn=True)
@struct.dataclass
class MDP(_PaddedShape):
    """Labelled Markov decision process with padded successor lists; :func:`make_mdp` builds one.

    Action ``a`` in state ``s`` leads to ``successor[s, a, k]`` with ``probability[s, a, k]``. Padding and
    unavailable actions have successor 0 and probability 0.

    Attributes:
      successor: ``int32[S, A, K]``.
      probability: ``float[S, A, K]``; rows of available actions sum to one.
      available: ``bool[S, A]``; every state has an available action.
      initial: ``float[S]``, the initial distribution.
      label: ``bool[S, P]``, the propositions that hold in each state.
      propositions: the P names; static.

    Example:
      >>> import jaxltl as jl
      >>> chain = jl.make_mdp([[[0, 1]], [[1, 0]]], [[[0.5, 0.5]], [[1.0, 0.0]]])
      >>> chain.replace(initial=np.array([1.0, 0.0])).initial.tolist()  # a modified copy
      [1.0, 0.0]
    """

    successor: jax.Array
    probability: jax.Array
    available: jax.Array
    initial: jax.Array
    label: jax.Array
    propositions: tuple[str, ...] = struct.field(pytree_node=False, default=())

    @property
    def num_successors(self) -> int:
        """K."""
        return self.probability.shape[-1]

    @property
    def successor_probability(self) -> jax.Array:
        """``float[S, A, K]``, zero at unavailable actions."""
        return jnp.where(self.available[..., None], self.probability, 0)

    @property
    def dtype(self) -> jnp.dtype:
        """The dtype of the probabilities."""
        return self.probability.dtype


@brief(drawn=True)
@struct.dataclass
class DenseMDP(_PaddedShape):
    """Labelled Markov decision process with a full matrix, for small batched problems.

    Attributes:
      transition: ``float[S, A, S]``; rows of unavailable actions are zero.
      available, initial, label, propositions: as in :class:`MDP`.

    Example:
      >>> import jaxltl as jl
      >>> jl.models.to_dense(jl.from_dense([[[0.5, 0.5]], [[0, 1.0]]])).transition.shape
      (2, 1, 2)
    """

    transition: jax.Array
    available: jax.Array
    initial: jax.Array
    label: jax.Array
    propositions: tuple[str, ...] = struct.field(pytree_node=False, default=())

    @property
    def num_successors(self) -> int:
        """S: all states are listed as successors."""
        return self.num_states

    @property
    def successor_probability(self) -> jax.Array:
        """``float[S, A, S]``, zero at unavailable actions."""
        return jnp.where(self.available[..., None], self.transition, 0)

    @property
    def dtype(self) -> jnp.dtype:
        """The dtype of the probabilities."""
        return self.transition.dtype


def support(world: Model) -> np.ndarray:
    """``bool[S, A, K]``, successors of positive probability; ValueError if one is subnormal."""
    if not isinstance(world, MDP | DenseMDP):
        raise ValueError(validation.unsupported_model(world))
    weight = np.asarray(world.transition if isinstance(world, DenseMDP) else world.probability)
    used, available = weight > 0, np.asarray(world.available)
    if not available.all():
        used &= available[..., None]
    dtype = target_dtype(weight.dtype)
    small = used & (weight < jnp.finfo(dtype).tiny)
    if small.any():
        _raise_underflow(weight, small, dtype)
    return used


def _raise_underflow(probability: np.ndarray, small: np.ndarray, dtype: np.dtype) -> None:
    s, a, k = np.argwhere(small)[0]
    text = underflow_text(probability[s, a, k], dtype)
    raise ValueError(f"state {s}, action {a}: probability (entry {k}) {text}.")


def make_mdp(
    successor: chex.Array,
    probability: chex.Array,
    *,
    available: chex.Array | None = None,
    initial: chex.Array | None = None,
    label: chex.Array | Mapping[str, Sequence[int]] | None = None,
    propositions: Sequence[str] = (),
) -> MDP:
    """Validated :class:`MDP` from arrays, in JAX's current default dtype.

    Args:
      successor: ``int[S, A, K]``, in ``[0, S)`` wherever the probability is positive.
      probability: ``float[S, A, K]``; rows that sum to one within 1e-6 are scaled to do so.
      available: ``bool[S, A]``; default: the actions with a positive probability.
      initial: ``float[S]``, a distribution; default: uniform.
      label: ``bool[S, P]``, or the states of each proposition by its name, such as
        ``{"goal": [15]}``; default: no propositions.
      propositions: P distinct names; default: the keys of `label`.

    Returns:
      :class:`MDP`.

    Raises:
      ValueError: naming the state, the action and the value: a wrong shape, a probability that is
        negative or not finite, a row that does not sum to one, a successor out of range, a state
        without actions, or propositions without labels.

    Example:
      >>> make_mdp([[[0, 1]], [[1, 0]]], [[[0.5, 0.5]], [[1.0, 0.0]]]).num_states
      2
    """
    successor = np.asarray(successor)
    probability = validation.float_array("probability", probability)
    if probability.ndim != 3 or successor.shape != probability.shape:
        raise ValueError(
            f"successor has shape {successor.shape} and probability {probability.shape}; "
            "both must be [states, actions, successors]."
        )
    num_states, num_actions, _ = probability.shape
    if num_states == 0 or num_actions == 0:
        raise ValueError(
            f"the model has {num_states} states and {num_actions} actions; "
            "it needs at least one of each."
        )
    if not np.issubdtype(successor.dtype, np.integer):
        raise ValueError(f"successor has dtype {successor.dtype}; it must hold integers.")
    _check_probability(probability)
    used = probability > 0
    for s, a, k in first_true(used & ((successor < 0) | (successor >= num_states))):
        raise ValueError(
            f"state {s}, action {a}: successor {successor[s, a, k]} is out of range; "
            f"states are 0 to {num_states - 1}."
        )
    if available is None:
        available = used.any(axis=-1)
    available = _checked_available(available, (num_states, num_actions))
    scale = _row_scale(probability.sum(axis=-1, dtype=np.float64), available)
    dtype = jnp.result_type(float)
    used &= available[:, :, None]
    probability = np.where(used, probability * scale[:, :, None], 0)
    if (small := underflows(probability, dtype)) is not None:
        _raise_underflow(probability, small, dtype)
    probability = probability.astype(dtype)
    label, names = checked_label(label, propositions, num_states)
    return MDP(
        successor=to_jax(np.where(used, successor, 0).astype(np.int32)),
        probability=to_jax(probability),
        available=to_jax(available),
        initial=to_jax(checked_initial(initial, num_states, dtype).astype(dtype)),
        label=to_jax(label),
        propositions=names,
    )


def from_dense(
    transition: chex.Array,
    *,
    available: chex.Array | None = None,
    initial: chex.Array | None = None,
    label: chex.Array | Mapping[str, Sequence[int]] | None = None,
    propositions: Sequence[str] = (),
) -> MDP:
    """Validated :class:`MDP` of a full matrix ``transition[s, a, t]``.

    Args:
      transition: ``float[S, A, S]``; K is the largest number of successors of a row.
      available, initial, label, propositions: as for :func:`make_mdp`.

    Returns:
      :class:`MDP`.

    Raises:
      ValueError: as :func:`make_mdp`.

    Example:
      >>> mdp = from_dense([[[0.5, 0.5]], [[0.0, 1.0]]], label={"goal": [1]})
      >>> mdp.successor.shape, mdp.propositions, mdp.label[:, 0].tolist()
      ((2, 1, 2), ('goal',), [False, True])
    """
    transition = validation.float_array("transition", transition)
    if transition.ndim != 3 or transition.shape[0] != transition.shape[2]:
        raise ValueError(f"transition has shape {transition.shape}; it must be [S, A, S].")
    _check_probability(transition)
    width = max(1, int((transition > 0).sum(axis=-1).max(initial=1)))
    # A stable sort puts the positive entries first and keeps them in state order.
    successor = np.argsort(~(transition > 0), axis=-1, kind="stable")[:, :, :width]
    probability = np.take_along_axis(transition, successor, axis=-1)
    return make_mdp(
        successor,
        probability,
        available=available,
        initial=initial,
        label=label,
        propositions=propositions,
    )


def to_dense(mdp: MDP) -> DenseMDP:
    """A model as a :class:`DenseMDP`; memory grows with S squared.

    Args:
      mdp: concrete or traced; differentiable in the probabilities.

    Returns:
      :class:`DenseMDP`.

    Raises:
      ValueError: a sparse or an interval model.

    Example:
      >>> to_dense(from_dense([[[0.5, 0.5]], [[0.0, 1.0]]])).transition.tolist()
      [[[0.5, 0.5]], [[0.0, 1.0]]]
    """
    if not hasattr(mdp, "num_actions") or not hasattr(mdp, "successor"):
        raise ValueError(validation.unsupported_model(mdp))
    num_states, num_actions = mdp.num_states, mdp.num_actions
    shape = num_states, num_actions, num_states
    place = np.arange(num_states)[:, None, None], np.arange(num_actions)[:, None]
    transition: Array
    if is_traced(mdp):
        empty = jnp.zeros(shape, mdp.dtype)
        transition = empty.at[*place, mdp.successor].add(mdp.probability)
    else:
        support(mdp)  # refuses probabilities that underflow
        transition = np.zeros(shape, mdp.dtype)
        np.add.at(transition, (*place, np.asarray(mdp.successor)), np.asarray(mdp.probability))
    return DenseMDP(
        transition=to_jax(transition),
        available=mdp.available,
        initial=mdp.initial,
        label=mdp.label,
        propositions=mdp.propositions,
    )


def _check_probability(probability: np.ndarray) -> None:
    for s, a, k in first_true(~(probability >= 0) | np.isinf(probability)):
        raise ValueError(
            f"state {s}, action {a}: probability {probability[s, a, k]} (entry {k}); "
            "probabilities must be finite and not negative."
        )


def _row_scale(total: np.ndarray, available: np.ndarray) -> np.ndarray:
    for s, a in first_true(available & (np.abs(total - 1) > validation.ROW_SUM_TOLERANCE)):
        raise ValueError(
            f"state {s}, action {a}: the probabilities sum to {total[s, a]:.9g}, not 1; "
            "correct the row, or mark the action unavailable."
        )
    return 1 / np.where(available, total, 1)


def _checked_available(available: chex.Array, shape: tuple[int, int]) -> np.ndarray:
    checked: np.ndarray = validation.boolean_array("available", available)
    if checked.shape != shape:
        raise ValueError(f"available has shape {checked.shape}; expected {shape}.")
    for s in first_true(~checked.any(axis=1)):
        raise ValueError(
            f"state {s} has no available action; give it one, for example a loop to itself."
        )
    return checked


def checked_initial(
    initial: chex.Array | None, num_states: int, dtype: DTypeLike = np.float64
) -> np.ndarray:
    """Validated initial distribution ``float64[S]`` that sums to 1; None: the uniform one."""
    if initial is None:
        return np.full(num_states, 1 / num_states)
    initial = validation.float_array("initial", initial)
    if initial.shape != (num_states,):
        raise ValueError(f"initial has shape {initial.shape}; expected ({num_states},).")
    refuse_negative(initial)
    if abs(initial.sum() - 1) > validation.ROW_SUM_TOLERANCE:
        raise ValueError(f"the initial distribution sums to {initial.sum():.9g}, not 1.")
    initial = initial / initial.sum()
    if (small := underflows(initial, dtype)) is not None:
        s = int(np.argmax(small))
        raise ValueError(f"initial probability of state {s} {underflow_text(initial[s], dtype)}.")
    return cast(np.ndarray, initial)


def refuse_negative(initial: np.ndarray, *, first: int = 0) -> None:
    """Raises ValueError for a negative probability; `first` is the number of the first state."""
    for s in first_true(~(initial >= 0)):
        raise ValueError(
            f"initial probability of state {first + s} is {initial[s]}; "
            "it must not be negative or NaN."
        )


def checked_label(
    label: chex.Array | Mapping[str, Sequence[int]] | None,
    propositions: Sequence[str],
    num_states: int,
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Validated labels ``bool[S, P]`` with their names, from a matrix, a mapping or None."""
    names = tuple(validation.sequence("propositions", propositions))
    if not all(isinstance(x, str) for x in names) or len(set(names)) != len(names):
        raise ValueError(f"propositions {validation.shorten(names)} are not distinct.")
    if isinstance(label, Mapping):
        return _label_by_name(label, names or tuple(label), num_states)
    if label is None:
        if names:
            raise ValueError(
                f"there are propositions {names} but no label, so that none would hold anywhere; "
                f"give label as bool[{num_states}, {len(names)}], one row per state, or as the "
                f"states where each holds, {{{names[0]!r}: [...]}}."
            )
        label = np.zeros((num_states, 0), bool)
    by_name = 'or give the states where each holds, label={"goal": [3]}'
    with validation.errors_in("", f" {by_name.capitalize()}."):
        label = validation.boolean_array("label", label)
    if label.shape != (num_states, len(names)):
        named = f"one column per proposition {names}"
        if not names:
            named = f"and one column per name in propositions, which is empty: give it, {by_name}"
        raise ValueError(
            f"label has shape {label.shape}; expected ({num_states}, {len(names) or 'P'}): "
            f"one row per state, {named}."
        )
    return label, names


def _label_by_name(
    label: Mapping[str, Sequence[int]], names: tuple[str, ...], num_states: int
) -> tuple[np.ndarray, tuple[str, ...]]:
    if set(label) != set(names):
        raise ValueError(
            f"label names {tuple(label)}, propositions are {names}; give the states of each of "
            "them, [] where it holds nowhere, or leave propositions out."
        )
    holds = np.zeros((num_states, len(names)), bool)
    for column, name in enumerate(names):
        states = np.asarray(label[name])
        if states.size and (states.ndim != 1 or not np.issubdtype(states.dtype, np.integer)):
            raise ValueError(
                f"label[{name!r}] has dtype {states.dtype} and shape {states.shape}; it must be "
                "a list of the numbers of the states where it holds."
            )
        states = states.astype(int)
        for i in first_true((states < 0) | (states >= num_states)):
            raise ValueError(
                f"label[{name!r}] has the state {states[i]}; states are 0 to {num_states - 1}."
            )
        holds[states, column] = True
    return holds, names
