"""Sparse Markov decision processes: rows of choices without padding, with named rewards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, TypedDict, Unpack, cast

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import struct, validation
from jaxltl.core.validation import first_true
from numpy.typing import DTypeLike

from jaxltl.core.language.parser import parse_expression
from jaxltl.core.logic.comparisons import Comparison
from jaxltl.core.models.number_source import NumberSource
from jaxltl.core.models.rewards import (
    Reward as Reward,
    Rewards as Rewards,
    default_reward as default_reward,
    listed_names,
)
from jaxltl.core.models.mdp import checked_initial, checked_label
from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.models.ops.kernels import gather, segment_ids, segment_reduce
from jaxltl.core.models.ops.underflow import underflow_text, underflows
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import SCIPY_SIZE, offsets_from_counts

_PADDED = (
    "this takes models that are padded: give to_padded(model). Sparse models have choices "
    "in rows, and are taken by the primitives, the functions of graphs and games, the "
    "solvers of values, rollouts, and prepare; not by learners."
)
Array = Any  # NumPy's in double precision as it is read, or JAX's


@brief(drawn=True)
@struct.dataclass
class SparseMDP:
    """Labelled Markov decision process in compressed sparse rows; :func:`make_sparse` builds one.

    The choices of state s are the rows ``row_start[s]`` to ``row_start[s + 1] - 1``, and row r leads
    to ``successor[e]`` with ``probability[e]`` for the entries e from ``entry_start[r]`` to
    ``entry_start[r + 1] - 1``. An action of a policy is a row; a Markov chain has one in each state.

    Attributes:
      row_start: ``int32[S + 1]``.
      entry_start: ``int32[R + 1]`` (``int64`` beyond 2^31 entries).
      successor: ``int32[T]``, ascending and without repetition within a row.
      probability: ``float[T]``, positive; rows sum to one.
      initial: ``float[S]``, the initial distribution.
      label: ``bool[S, P]``, the propositions that hold in each state.
      rewards: named :class:`Rewards`.
      action: ``int32[R]``, the action number of each row, or None.
      valuation: values of named variables in each state, ``[S]`` each.
      propositions: the P names; static.
      action_names: names of the actions by number, or empty; static.
      numbers: the source of exact numbers, which decide thresholds of small models; static.

    Example:
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 3, 4, 5], [1, 1, 2, 1, 2], [1, 0.5, 0.5, 1, 1],
      ...                     label={"goal": [1]}, rewards={"steps": Rewards(state=[1, 0, 0])})
      >>> model.num_rows, model.num_transitions, model.states_with_label("goal").tolist()
      (4, 5, [False, True, False])
    """

    row_start: Array
    entry_start: Array
    successor: Array
    probability: Array
    initial: Array
    label: Array
    rewards: dict[str, Rewards] = struct.field(default_factory=dict)
    action: Array | None = None
    valuation: dict[str, Array] = struct.field(default_factory=dict)
    propositions: tuple[str, ...] = struct.field(pytree_node=False, default=())
    action_names: tuple[str, ...] = struct.field(pytree_node=False, default=())
    numbers: PyTree = struct.field(pytree_node=False, default=NumberSource())

    @property
    def num_states(self) -> int:
        """S."""
        return int(self.row_start.shape[-1] - 1)

    @property
    def num_rows(self) -> int:
        """R, the number of choices."""
        return int(self.entry_start.shape[-1] - 1)

    @property
    def num_transitions(self) -> int:
        """T, the number of entries."""
        return int(self.successor.shape[-1])

    @property
    def is_chain(self) -> bool:
        """True if every state has one choice."""
        return self.num_rows == self.num_states

    @property
    def available(self) -> Array:
        """Raises ValueError: only padded models have actions ``[S, A]``."""
        raise ValueError(_PADDED)

    @property
    def num_actions(self) -> int:
        """Raises ValueError, as `available`."""
        raise ValueError(_PADDED)

    @property
    def state_shape(self) -> tuple[int, ...]:
        """The shape of a value: ``(S,)``."""
        return (self.num_states,)

    @property
    def dtype(self) -> np.dtype:
        """The dtype of the probabilities."""
        return cast(np.dtype, np.dtype(self.probability.dtype))

    @cached_property
    def host(self) -> HostMDP:
        """The transitions for the sparse engine, which caches graph properties with them."""
        row_start, entry_start, successor = (
            np.asarray(x) for x in (self.row_start, self.entry_start, self.successor)
        )
        probability = np.asarray(self.probability, np.float64)
        return HostMDP(row_start, entry_start, successor, probability)

    @cached_property
    def action_number(self) -> np.ndarray:
        """``int[R]``, the action number of each row in policies; distinct within a state.

        The number in `action` where actions have numbers and no names, as ``to_sparse`` gives them; else, and where
        two rows of a state share one, the rank of the row among those of its state.
        """
        if self.action is None or self.action_names:
            return self.rank
        number, state = np.asarray(self.action), self.host.state
        if not ((state[1:] > state[:-1]) | (number[1:] > number[:-1])).all():
            place = state * np.int64(number.max() + 1) + number
            if np.unique(place).size < place.size:
                return self.rank
        return number

    @property
    def rank(self) -> np.ndarray:
        """``int[R]``, the number of each row among those of its state."""
        return np.arange(self.num_rows) - self.host.row_start[self.host.state]

    def states_with_label(self, proposition: str) -> Array:
        """``bool[S]``, the states in which a proposition holds; ValueError for an unknown one."""
        if proposition not in self.propositions:
            raise ValueError(
                f"there is no label {proposition!r}; the model has "
                f"{', '.join(self.propositions) or 'none'}."
            )
        return self.label[:, self.propositions.index(proposition)]

    def states_where(self, condition: str) -> np.ndarray:
        """``bool[S]``, the states that satisfy a Boolean expression of variables, ``"x=3 & y>1"``."""
        return Comparison(condition, parse_expression(condition)).holds(self.valuation)


def choice_reward(model: SparseMDP, reward: str | Rewards | chex.Array | None = None) -> np.ndarray:
    """Expected reward of each choice, ``r(s) + r(s, a) + sum_t P(t | s, a) r(s, a, t)``.

    Args:
      model: the sparse model.
      reward: the name of one of its rewards, a structure, or an array on states ``[S]``, choices
        ``[R]`` or transitions ``[T]``, the first of these shapes that fits; default: the reward
        without a name, or the only one.

    Returns:
      ``float64[R]``; of traced arguments a JAX array in the model's precision, differentiable in the
      rewards and the probabilities.

    Raises:
      ValueError: an unknown reward, or another shape.

    Example:
      >>> model = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> choice_reward(model, Rewards(state=[1, 0, 0], transition=[4, 0, 0, 0])).tolist()
      [3.0, 0.0, 0.0]
    """
    if not isinstance(model, SparseMDP):
        raise ValueError(validation.unsupported_model(model))
    reward = reward_structure(model, reward)
    if is_traced((model, reward)):
        return cast(np.ndarray, _traced_reward(model, reward))
    host = model.host
    total = np.zeros(host.num_rows)
    if reward.state is not None:
        total += np.asarray(reward.state, np.float64)[host.state]
    if reward.choice is not None:
        total += np.asarray(reward.choice, np.float64)
    if reward.transition is not None:
        earned = host.probability * np.asarray(reward.transition, np.float64)
        total += np.add.reduceat(earned, host.entry_start[:-1])
    return total


def reward_structure(model: SparseMDP, reward: str | Rewards | chex.Array | None = None) -> Rewards:
    """A reward as a structure, from any form that :func:`choice_reward` accepts."""
    if reward is None:
        reward = default_reward(model.rewards)
    if isinstance(reward, str):
        if reward not in model.rewards:
            raise ValueError(
                f"there is no reward {reward!r}; the model has {listed_names(model.rewards)}."
            )
        reward = model.rewards[reward]
    if not isinstance(reward, Rewards):
        return _shaped(model, reward)
    for size, name in _sizes(model):
        part = getattr(reward, name)
        if part is not None and np.shape(part) != (size,):
            raise ValueError(
                f"reward has shape {np.shape(part)} on its {name} part; expected ({size},)."
            )
    return reward


def _sizes(model: SparseMDP) -> tuple[tuple[int, str], ...]:
    return (
        (model.num_states, "state"),
        (model.num_rows, "choice"),
        (model.num_transitions, "transition"),
    )


def _traced_reward(model: SparseMDP, reward: Rewards) -> Array:
    total = jnp.zeros(model.num_rows, jax.dtypes.canonicalize_dtype(model.dtype))
    if reward.state is not None:
        total += gather(reward.state, segment_ids(model.row_start, model.num_rows))
    if reward.choice is not None:
        total += reward.choice
    if reward.transition is not None:
        row = segment_ids(model.entry_start, model.num_transitions)
        earned = model.probability * jnp.asarray(reward.transition)
        total += segment_reduce(jnp.add, earned, row, model.num_rows)
    return total


def _shaped(model: SparseMDP, reward: Array) -> Rewards:
    reward = reward if isinstance(reward, jax.Array) else validation.float_array("reward", reward)
    for size, name in _sizes(model):
        if reward.shape == (size,):
            return Rewards(**{name: reward})
    raise ValueError(
        f"reward has shape {reward.shape}; give one number for each of the {model.num_states} "
        f"states, {model.num_rows} choices or {model.num_transitions} transitions."
    )


class Annotations(TypedDict, total=False):
    """Optional parts of a sparse model, described at :func:`make_sparse`."""

    label: chex.Array | Mapping[str, Sequence[int]] | None
    propositions: Sequence[str]
    rewards: Mapping[str, Rewards] | None
    action: chex.Array | None
    action_names: Sequence[str]
    valuation: Mapping[str, chex.Array] | None


def make_sparse(
    row_start: chex.Array | None,
    entry_start: chex.Array,
    successor: chex.Array,
    probability: chex.Array,
    *,
    initial: chex.Array | None = None,
    label: chex.Array | Mapping[str, Sequence[int]] | None = None,
    propositions: Sequence[str] = (),
    rewards: Mapping[str, Rewards] | None = None,
    action: chex.Array | None = None,
    action_names: Sequence[str] = (),
    valuation: Mapping[str, chex.Array] | None = None,
) -> SparseMDP:
    """Validated :class:`SparseMDP` from arrays, as NumPy arrays in double precision.

    Successors of a row are sorted; repeated ones are merged, with the sum of their probabilities and
    the mean of their rewards; entries of probability zero are dropped. Rows that sum to one up to
    rounding are kept bit for bit, others within 1e-6 are scaled.

    Args:
      row_start: ``int[S + 1]``; None for a Markov chain.
      entry_start: ``int[R + 1]``.
      successor: ``int[T]``, in ``[0, S)``.
      probability: ``float[T]``.
      initial: ``float[S]``, a distribution; default: uniform.
      label, propositions: as for :func:`~jaxltl.core.models.mdp.make_mdp`.
      rewards, action, action_names, valuation: as in :class:`SparseMDP`.

    Returns:
      :class:`SparseMDP`.

    Raises:
      ValueError: naming the state, the choice and the value: a wrong shape, starts that do not
        ascend, a state without a choice, a choice without a successor, a successor out of range, a
        probability that is negative, not finite or subnormal, or a row that does not sum to one.

    Example:
      >>> model = make_sparse([0, 2, 3], [0, 2, 3, 4], [0, 1, 1, 1], [0.5, 0.5, 1, 1])
      >>> model.num_states, model.num_rows, model.num_transitions, model.is_chain
      (2, 3, 4, False)
    """
    model = sparse_part(
        row_start,
        entry_start,
        successor,
        probability,
        label=label,
        propositions=propositions,
        rewards=rewards,
        action=action,
        action_names=action_names,
        valuation=valuation,
    )
    return replace(model, initial=checked_initial(initial, model.num_states))


def sparse_part(
    row_start: chex.Array | None,
    entry_start: chex.Array,
    successor: chex.Array,
    probability: chex.Array,
    begins: tuple[int, int, int] = (0, 0, 0),
    num_states: int | None = None,
    **annotations: Unpack[Annotations],
) -> SparseMDP:
    """Validated states of a larger model, from the state, choice and transition numbers `begins` on."""
    successor, probability = (
        np.asarray(successor),
        validation.float_array("probability", probability),
    )
    if successor.ndim != 1 or successor.shape != probability.shape:
        raise ValueError(
            f"successor has shape {successor.shape} and probability {probability.shape}; "
            "both must be [transitions]."
        )
    if not np.issubdtype(successor.dtype, np.integer):
        raise ValueError(f"successor has dtype {successor.dtype}; it must hold integers.")
    row_start, entry_start = checked_rows(row_start, entry_start, successor.size)
    here, num_rows, first = row_start.size - 1, entry_start.size - 1, begins[0]
    check_entries(
        row_start, entry_start, successor, probability, first=first, num_states=num_states
    )
    validation.keywords("make_sparse", annotations, Annotations)
    structures, valuation = annotations.get("rewards"), annotations.get("valuation")
    structures = {} if structures is None else structures
    valuation = {} if valuation is None else valuation
    for of, each in (("rewards", structures), ("valuation", valuation)):
        if not isinstance(each, Mapping):
            raise ValueError(f"{of} is {validation.shorten(each)}; give a dict, by name.")
    action_names = tuple(validation.sequence("action_names", annotations.get("action_names", ())))
    sizes = here, num_rows, successor.size
    rewards = {name: _checked_rewards(name, x, sizes, begins) for name, x in structures.items()}
    label, names = checked_label(
        annotations.get("label"), annotations.get("propositions", ()), here
    )
    action = annotations.get("action")
    action = None if action is None else _checked_action(action, num_rows, action_names)
    for name, x in valuation.items():
        if np.shape(x) != (here,):
            raise ValueError(
                f"valuation {name!r} has shape {np.shape(x)}; expected "
                f"({here},), a value for each state."
            )
    parts = _canonical(row_start, entry_start, successor, probability, rewards, first)
    start, successor, probability, rewards = parts
    return SparseMDP(
        row_start=row_start.astype(np.int32),
        entry_start=start,
        successor=successor,
        probability=scaled(row_start, start, probability, first=first),
        initial=np.zeros(here),
        label=label,
        rewards=rewards,
        action=action,
        valuation={n: np.asarray(x) for n, x in valuation.items()},
        propositions=names,
        action_names=action_names,
    )


def checked_rows(
    row_start: Array | None, entry_start: Array, num_entries: int
) -> tuple[np.ndarray, np.ndarray]:
    """Validated starts of the states' rows and of the rows' entries; None: one row in each state."""
    entry_start = _checked_starts("entry_start", entry_start, num_entries, "transitions")
    num_rows = entry_start.size - 1
    row_start = np.arange(num_rows + 1) if row_start is None else row_start
    row_start = _checked_starts("row_start", row_start, num_rows, "choices")
    if row_start.size < 2:
        raise ValueError("the model has no state; it needs at least one.")
    return row_start, entry_start


def _checked_starts(name: str, start: Array, total: int, of: str) -> np.ndarray:
    """Validated span starts as ``int64``: ascending from 0 to `total`."""
    start = np.asarray(start)
    if start.ndim != 1 or not start.size or not np.issubdtype(start.dtype, np.integer):
        raise ValueError(
            f"{name} is {start.dtype}{list(start.shape)}; expected integers, one more "
            "than there are spans."
        )
    if start[0] != 0 or start[-1] != total:
        raise ValueError(
            f"{name} goes from {start[0]} to {start[-1]}; it must go from 0 to the "
            f"number of {of}, {total}."
        )
    falls = start[1:] < start[:-1]  # differences of unsigned numbers are never negative
    for i in first_true(falls):
        raise ValueError(
            f"{name} falls from {start[i]} to {start[i + 1]} at {i + 1}; it must ascend."
        )
    result: np.ndarray = start.astype(np.int64)  # NumPy takes no unsigned ones for counts
    return result


def placed(row_start: np.ndarray, row: int, first: int = 0) -> str:
    """A choice as ``state s, choice i`` for messages; `first` is the number of the first state."""
    state = int(np.searchsorted(row_start, row, "right")) - 1
    return f"state {first + state}, choice {row - int(row_start[state])}"


def _placed_entry(row_start: np.ndarray, entry_start: np.ndarray, entry: int, first: int) -> str:
    return placed(row_start, int(np.searchsorted(entry_start, entry, "right")) - 1, first)


def check_entries(
    row_start: np.ndarray,
    entry_start: np.ndarray,
    successor: np.ndarray,
    probability: np.ndarray,
    *,
    first: int = 0,
    num_states: int | None = None,
) -> None:
    """Raises ValueError if a state, a row or an entry is invalid, by numbers of the whole model."""
    num_states = row_start.size - 1 if num_states is None else num_states
    for s in first_true(np.diff(row_start) == 0):
        raise ValueError(
            f"state {first + s} has no choice; give it one, for example a loop to itself."
        )
    for row in first_true(np.diff(entry_start) == 0):
        raise ValueError(f"{placed(row_start, row, first)} leads nowhere; give it a successor.")
    for e in first_true((successor < 0) | (successor >= num_states)):
        raise ValueError(
            f"{_placed_entry(row_start, entry_start, e, first)}: successor {successor[e]} is out of "
            f"range; states are 0 to {num_states - 1}."
        )
    for e in first_true(~(probability >= 0) | np.isinf(probability)):
        raise ValueError(
            f"{_placed_entry(row_start, entry_start, e, first)}: probability {probability[e]}; "
            "probabilities must be finite and not negative."
        )
    refuse_underflow(row_start, entry_start, probability, np.float64, first=first)


def refuse_underflow(
    row_start: np.ndarray,
    entry_start: np.ndarray,
    probability: np.ndarray,
    dtype: DTypeLike,
    *,
    first: int = 0,
) -> None:
    """Raises ValueError if a positive probability is zero or subnormal in a dtype."""
    if (small := underflows(probability, dtype)) is not None:
        e = int(np.argmax(small))
        place = _placed_entry(row_start, entry_start, e, first)
        raise ValueError(f"{place}: probability {underflow_text(probability[e], dtype)}.")


def _checked_rewards(
    name: str, reward: Rewards, sizes: tuple[int, int, int], begins: tuple[int, int, int]
) -> Rewards:
    if not isinstance(reward, Rewards):
        raise ValueError(f"reward {name!r} is {validation.shorten(reward)}; give Rewards.")
    parts: dict[str, Array] = {}
    for part, size, first in zip(("state", "choice", "transition"), sizes, begins, strict=True):
        array = getattr(reward, part)
        if array is None:
            continue
        array = validation.float_array(f"reward {name!r}", array)
        if array.shape != (size,):
            raise ValueError(
                f"reward {name!r} has shape {array.shape} on its {part} part; expected ({size},)."
            )
        for place in first_true(np.isnan(array)):
            raise ValueError(f"reward {name!r} is NaN at {part} {first + place}; give a number.")
        parts[part] = array
    return Rewards(**parts)


def _checked_action(action: Array, num_rows: int, names: tuple[str, ...]) -> np.ndarray:
    action = np.asarray(action)
    if action.shape != (num_rows,) or not np.issubdtype(action.dtype, np.integer):
        raise ValueError(
            f"action is {action.dtype}{list(action.shape)}; expected integers "
            f"[{num_rows}], the action of each choice."
        )
    if action.size and (action.min() < 0 or (names and action.max() >= len(names))):
        raise ValueError(
            f"actions go from {action.min()} to {action.max()}; there are "
            f"{len(names)} names, for 0 to {len(names) - 1}."
        )
    return cast(np.ndarray, action.astype(np.int32))


def _canonical(
    row_start: np.ndarray,
    entry_start: np.ndarray,
    successor: np.ndarray,
    probability: np.ndarray,
    rewards: dict[str, Rewards],
    state: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, Rewards]]:
    """Sorted entries without repetitions and zeros; `state` is the number of the first state."""
    index: type[np.signedinteger] = np.int32 if successor.size < 2**31 else np.int64
    first = np.zeros(successor.size + 1, bool)
    first[entry_start] = True
    ascends = successor[1:] > successor[:-1]
    if (ascends | first[1:-1]).all() and probability.min(initial=1) > 0:
        return (entry_start.astype(index), successor.astype(np.int32), probability, rewards)
    row = np.repeat(np.arange(entry_start.size - 1, dtype=np.int32), np.diff(entry_start))
    order = _sorted(entry_start, successor, row)
    order = order[probability[order] > 0]
    row, target, weight = row[order], successor[order], probability[order]
    new = np.ones(order.size, bool)
    new[1:] = (row[1:] != row[:-1]) | (target[1:] != target[:-1])
    start = np.flatnonzero(new)
    merged = np.add.reduceat(weight, start) if start.size else weight
    arrays = {}
    for name, reward in rewards.items():
        if reward.transition is not None:
            earned = np.add.reduceat(weight * reward.transition[order], start) / merged
            # Entries that are not merged keep their rewards bit for bit.
            alone = np.diff(np.append(start, order.size)) == 1
            reward = replace(
                reward, transition=np.where(alone, reward.transition[order][start], earned)
            )
        arrays[name] = reward
    count = np.bincount(row[start], minlength=entry_start.size - 1)
    for empty in first_true(count == 0):
        place = placed(row_start, empty, state)
        raise ValueError(f"{place}: the probabilities sum to 0, not 1; correct the row.")
    starts = offsets_from_counts(count).astype(index)
    return starts, target[start].astype(np.int32), merged, arrays


def _sorted(entry_start: np.ndarray, successor: np.ndarray, row: np.ndarray) -> np.ndarray:
    """An order of the entries in which successors ascend in each row."""
    if successor.size <= SCIPY_SIZE:
        return np.lexsort((successor, row))
    from scipy.sparse import csr_array

    place = np.arange(successor.size)
    shape = (entry_start.size - 1, int(successor.max()) + 1)
    within = csr_array((place, successor.copy(), entry_start), shape=shape)
    within.sort_indices()
    return cast(np.ndarray, within.data)


def scaled(
    row_start: np.ndarray, entry_start: np.ndarray, probability: np.ndarray, *, first: int = 0
) -> np.ndarray:
    """Normalised rows; ValueError for a row with a sum that is not within 1e-6 of one."""
    total = np.add.reduceat(probability, entry_start[:-1])
    off = np.abs(total - 1)
    for row in first_true(off > validation.ROW_SUM_TOLERANCE):
        raise ValueError(
            f"{placed(row_start, row, first)}: the probabilities sum to "
            f"{total[row]:.9g}, not 1; correct the row."
        )
    count = np.diff(entry_start)
    wrong = off > (count + 2) * np.finfo(np.float64).eps
    if not wrong.any():
        return probability
    return cast(np.ndarray, probability / np.repeat(np.where(wrong, total, 1), count))
