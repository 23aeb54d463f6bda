"""Transition counts from logs: aligned with the entries of a model, or as an empirical model."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.statistics.confidence_sets import LeastProbability, require_graph
from jaxltl.core import validation
from jaxltl.core.sparse.rows import offsets_from_counts
from jaxltl.core.array_types import Integers
from jaxltl.core.pretty_print import brief
from jaxltl.core.models.mdp import MDP, DenseMDP, support
from jaxltl.core.models.sparse import SparseMDP, make_sparse

_INTEGER = re.compile(r"-?[1-9][0-9]{0,17}|0")
MAX_SAMPLES = 2**53  # the largest range of exact integers in double precision
_MAX_ENTRIES = 10**8
_SMALL_TABLE = 10**6  # choices times states up to which all transitions are kept
_ANY = "any"  # the only action of an unvisited state

Initial = str | int | Mapping[str, float] | Mapping[int, float] | Sequence[str | int]


@brief
@dataclass(frozen=True)
class TransitionCounts:
    """Counts of observed transitions, each once and in lexicographic order.

    Attributes:
      state, action, successor: ``int32[N]``, indices of names.
      count: ``int64[N]``; 0 for a transition that is possible and was not observed.
      states, actions: the names.

    Example:
      >>> counts = make_counts([0, 0, 1], [0, 0, 0], [1, 0, 1], states=["dock", "bay"])
      >>> counts.num_samples, counts.states, counts.count.tolist()
      (3, ('dock', 'bay'), [1, 1, 1])
    """

    state: Integers
    action: Integers
    successor: Integers
    count: Integers
    states: tuple[str, ...]
    actions: tuple[str, ...]

    @property
    def num_samples(self) -> int:
        """The number of observed transitions."""
        return int(self.count.sum())


def make_counts(
    state: ArrayLike,
    action: ArrayLike,
    successor: ArrayLike,
    count: ArrayLike | None = None,
    *,
    states: Sequence[str] | None = None,
    actions: Sequence[str] | None = None,
) -> TransitionCounts:
    """Validated :class:`TransitionCounts` from arrays of transitions, in any order, with repetitions.

    Args:
      state, action, successor: ``int[N]``.
      count: ``int[N]``, the multiplicity of each transition; default: one.
      states, actions: the names; default: the numbers from 0 to the largest.

    Returns:
      :class:`TransitionCounts`.

    Raises:
      ValueError: naming the entry: different shapes, a number without a name, a negative count,
        repeated names, or no transition.

    Example:
      >>> counts = make_counts([0, 1, 0, 0], [0, 0, 0, 0], [1, 1, 1, 0])
      >>> counts.successor.tolist(), counts.count.tolist(), counts.states
      ([0, 1, 1], [1, 2, 1], ('0', '1'))
    """
    columns = {"state": state, "action": action, "successor": successor}
    if count is not None:
        columns["count"] = count
    arrays = {name: np.asarray(x) for name, x in columns.items()}
    size = arrays["state"].size
    for name, x in arrays.items():
        if x.shape != (size,) or not size or not np.issubdtype(x.dtype, np.integer):
            raise ValueError(
                f"{name} is {x.dtype}{list(x.shape)}; expected integers [N], one for each "
                "transition, of which there is at least one."
            )
        if (x < 0).any():
            raise ValueError(f"{name}[{int(np.argmax(x < 0))}] is {x.min()}; none is negative.")
    if count is not None and sum(arrays["count"].tolist()) > MAX_SAMPLES:
        raise ValueError(
            f"count adds up to {sum(arrays['count'].tolist())}; at most 2^53 "
            "transitions are counted."
        )
    num_names = {"state": max(arrays["state"].max(), arrays["successor"].max()) + 1}
    num_names |= {"action": arrays["action"].max() + 1}
    state_names = _checked_names("states", states, int(num_names["state"]))
    action_names = _checked_names("actions", actions, int(num_names["action"]))
    count = arrays.get("count", np.ones(size, np.int64))
    rows = [arrays[name] for name in ("state", "action", "successor")]
    s, a, t, number = merged(np.stack([x.astype(np.int64) for x in (*rows, count)]))
    return TransitionCounts(
        s.astype(np.int32),
        a.astype(np.int32),
        t.astype(np.int32),
        number,
        state_names,
        action_names,
    )


def merged(table: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sorted columns of state, action, successor and count, with repeated transitions added up."""
    rows, place = np.unique(table[:3], axis=1, return_inverse=True)
    return np.vstack([rows, _totals(place, table[3])])


def _totals(place: Integers, count: Integers) -> NDArray[np.int64]:
    """Sums of the counts at each place; at most `MAX_SAMPLES`, which doubles count exactly."""
    return np.bincount(place.ravel(), count).astype(np.int64)


def _checked_names(noun: str, names: Sequence[str] | None, least: int) -> tuple[str, ...]:
    if names is None:
        if least > _MAX_ENTRIES:
            raise ValueError(f"{noun} go up to {least - 1}; number them from 0, without gaps.")
        return tuple(map(str, range(least)))
    names = tuple(map(str, validation.sequence(noun, names)))
    if len(names) < least:
        raise ValueError(f"there are {len(names)} names of {noun}; number {least - 1} has none.")
    if len(set(names)) < len(names):
        twice = next(x for i, x in enumerate(names) if x in names[:i])
        raise ValueError(f"{noun}: the name {twice!r} stands twice.")
    return names


def in_order(names: Iterable[str]) -> tuple[str, ...]:
    """Names sorted by number if all are integers, else alphabetically."""
    names = list(names)
    if all(map(_INTEGER.fullmatch, names)):
        return tuple(sorted(names, key=int))
    return tuple(sorted(names))


# --- alignment with a model ---------------------------------------------------------------------


def state_names(model: MDP | DenseMDP | SparseMDP) -> tuple[str, ...]:
    """Names of the states: the values of the variable `state` if they are distinct, else the numbers."""
    if isinstance(model, SparseMDP) and "state" in model.valuation:
        names = tuple(map(str, np.asarray(model.valuation["state"]).tolist()))
        if len(set(names)) == len(names):
            return names
    return tuple(map(str, range(model.num_states)))


def action_names(model: MDP | DenseMDP | SparseMDP) -> tuple[str, ...]:
    """Names of the actions, else their numbers or, without numbers, their ranks."""
    if isinstance(model, SparseMDP):
        if model.action_names:
            return model.action_names
        number = _row_action(model)
        return tuple(map(str, range(int(number.max()) + 1)))
    return tuple(map(str, range(model.num_actions)))


def _row_action(model: SparseMDP) -> Integers:
    return model.rank if model.action is None else np.asarray(model.action)


@brief
@dataclass(frozen=True)
class Places:
    """Index of a model's transitions by the numbers of their names."""

    states: tuple[str, ...]
    actions: tuple[str, ...]
    row_state: Integers  # int[R], of each choice
    row_action: Integers  # int[R]
    entry_start: Integers  # int[R + 1]
    successor: Integers  # int[T]
    place: Integers  # int[T], the flat position of each entry among the probabilities
    shape: tuple[int, ...]  # of the array of probabilities

    @cached_property
    def _rows(self) -> tuple[Integers, Integers]:
        return _sorted_keys(self.row_state, self.row_action, len(self.actions))

    @cached_property
    def _entries(self) -> tuple[Integers, Integers]:
        row = np.repeat(np.arange(self.row_state.size), np.diff(self.entry_start))
        return _sorted_keys(row, self.successor, len(self.states))

    def ambiguous(self) -> str | None:
        """A description of two choices or successors with the same names, or None."""
        for (key, order), noun in ((self._rows, "choice"), (self._entries, "successor")):
            same = np.flatnonzero(key[1:] == key[:-1])
            if same.size:
                return f"{noun}s {order[same[0]]} and {order[same[0] + 1]}"
        return None

    def rows(self, state: Integers, action: Integers) -> Integers:
        """The rows of state-action pairs, -1 for none."""
        return _found(self._rows, np.asarray(state, np.int64) * len(self.actions) + action)

    def entries(self, row: Integers, successor: Integers) -> Integers:
        """The entries of rows and successors, -1 for none."""
        return _found(self._entries, np.asarray(row, np.int64) * len(self.states) + successor)


def places(model: MDP | DenseMDP | SparseMDP) -> Places:
    """The index of a concrete model; ValueError for another kind of model, or ambiguous names."""
    if isinstance(model, SparseMDP):
        host = model.host
        entry = np.arange(host.num_transitions)
        parts = host.state, _row_action(model), host.entry_start, host.successor, entry
        shape: tuple[int, ...] = entry.shape
    elif isinstance(model, MDP | DenseMDP):
        used = support(model)
        state, action = np.nonzero(np.asarray(model.available))
        shape = used.shape
        successor = np.nonzero(used)[2]
        if isinstance(model, MDP):
            successor = np.asarray(model.successor)[used]
        start = offsets_from_counts(used.sum(-1)[state, action])
        parts = state, action, start, successor, np.flatnonzero(used)
    else:
        raise ValueError(
            f"{type(model).__name__} has no transitions to count; give an MDP, a DenseMDP or a "
            "SparseMDP (of a game, its mdp; of an interval model, its nominal one)."
        )
    result = Places(state_names(model), action_names(model), *parts, shape)
    if twice := result.ambiguous():
        raise ValueError(
            f"{twice} of the model have the same names, so that no count says which it is of; give "
            "each choice of a state an action of its own, and convert a model whose rows repeat a "
            "successor by to_sparse."
        )
    return result


def _sorted_keys(first: Integers, second: Integers, size: int) -> tuple[Integers, Integers]:
    key = first.astype(np.int64) * size + second
    order = np.argsort(key, kind="stable")
    return key[order], order


def _found(keys: tuple[Integers, Integers], wanted: Integers) -> Integers:
    key, order = keys
    at = np.minimum(np.searchsorted(key, wanted), key.size - 1)
    return np.where(key[at] == wanted, order[at], -1)


def align_counts(model: MDP | DenseMDP | SparseMDP, counts: TransitionCounts) -> NDArray[np.int64]:
    """Counts aligned with a model's probabilities; states and actions are matched by name.

    Args:
      model, counts: a concrete model, and counts of some of its transitions.

    Returns:
      ``int64``, of the shape of the model's probabilities; 0 for unobserved transitions.

    Raises:
      ValueError: a transition that the model does not have, or ambiguous names.

    Example:
      >>> from jaxltl import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> align_counts(coin, make_counts([0, 0, 0], [0, 0, 0], [2, 1, 2])).tolist()
      [1, 2, 0, 0]
    """
    _require_counts(counts)
    known = places(model)
    state = _renumbered("state", counts.states, counts.state, known.states)
    action = _renumbered("action", counts.actions, counts.action, known.actions)
    successor = _renumbered("state", counts.states, counts.successor, known.states)
    place, wrong = place_of(known, state, action, successor)
    if wrong:
        raise ValueError(f"the counts do not fit the model: {wrong[1]}.")
    aligned = np.zeros(known.shape, np.int64)
    aligned.reshape(-1)[place] = counts.count
    return aligned


def _renumbered(
    noun: str, names: tuple[str, ...], number: Integers, to: tuple[str, ...]
) -> Integers:
    """Indices of names as indices of the same names in another list."""
    if names == to:
        return number
    of = {name: i for i, name in enumerate(to)}
    renumbered = np.array([of.get(name, -1) for name in names], np.int64)[number]
    if (renumbered < 0).any():
        name = names[number[int(np.argmin(renumbered >= 0))]]
        raise ValueError(f"the model has no {noun} {name!r}; it has {listed(to)}.")
    return renumbered


def listed(names: Sequence[str], limit: int = 8) -> str:
    """The number of names and the first `limit`, for messages."""
    names_text = ", ".join(map(repr, names[:limit]))
    return f"{len(names)}: {names_text}{', ...' if len(names) > limit else ''}"


def place_of(
    known: Places, state: Integers, action: Integers, successor: Integers
) -> tuple[Integers, tuple[int, str] | None]:
    """Flat positions ``int[N]`` of transitions, and the first unknown one with the reason, or None."""
    row = known.rows(state, action)
    entry = np.where(row >= 0, known.entries(row, successor), -1)
    if (entry >= 0).all():
        return known.place[entry], None
    i = int(np.argmin(entry >= 0))
    s, a, t = known.states[state[i]], known.actions[action[i]], known.states[successor[i]]
    if row[i] < 0:
        return entry, (i, f"state {s!r} has no action {a!r}")
    return entry, (i, f"action {a!r} in state {s!r} cannot lead to {t!r}")


# --- empirical models ---------------------------------------------------------------------------


def model_from_counts(
    counts: TransitionCounts,
    *,
    initial: Initial,
    graph: Literal["seen", "complete"] | LeastProbability,
    labels: Mapping[str, Iterable[object]] | None = None,
    terminal: Iterable[object] = (),
) -> tuple[SparseMDP, NDArray[np.int64]]:
    """Empirical model of the counted choices, and the counts of its transitions.

    Probabilities are the frequencies, or, in rows with a count of 0, those after one more sample of
    each transition. A state without samples that is not terminal has one choice, `any`, which may lead
    to every state. For confidence sets of the true probabilities see
    :func:`~jaxltl.core.statistics.confidence_sets.intervals_from_counts`.

    Args:
      counts: the observed transitions.
      initial: the initial state, several that are equally likely, or probabilities by name.
      labels: the states where each proposition holds, by name.
      terminal: absorbing states.
      graph: the assumption on transitions that were not observed: ``"seen"``, they are impossible
        (except those with a count of 0); ``"complete"``, each choice may lead to every state; or
        :class:`~jaxltl.core.statistics.confidence_sets.LeastProbability`, each choice may lead to
        every state, and confidence sets exclude those below the least probability; in a table of more
        than 10^6 entries they are impossible for choices with sufficiently many samples.

    Returns:
      The model, which keeps the names of states as its variable `state`, and ``int64[T]``.

    Raises:
      ValueError: naming the state: an unknown one, or a terminal one with an observed exit; a
        complete graph of more than 1e8 entries.

    Example:
      >>> counts = make_counts([0, 0, 1], [0, 0, 0], [0, 1, 1], [7, 3, 9], states=["a", "b"])
      >>> model, count = model_from_counts(counts, initial="a", graph="seen")
      >>> model.probability.tolist(), count.tolist()
      ([0.7, 0.3, 1.0], [7, 3, 9])
    """
    _require_counts(counts)
    require_graph(graph, ("seen", "complete"))
    if labels is not None and not isinstance(labels, Mapping):
        raise ValueError(
            f"labels is {validation.shorten(labels)}; give the states of each label, in a dict."
        )
    number = {name: i for i, name in enumerate(counts.states)}
    stays = np.zeros(len(number), bool)
    stays[_numbers(terminal, number, "terminal")] = True
    departures = np.flatnonzero(stays[counts.state] & (counts.state != counts.successor))
    if departures.size:
        name, to = (counts.states[x[departures[0]]] for x in (counts.state, counts.successor))
        raise ValueError(f"the terminal state {name!r} was left to {to!r}; it is not terminal.")
    untried = np.setdiff1d(np.arange(len(number)), counts.state)
    names = counts.actions
    if untried.size and _ANY not in names:
        names = (*names, _ANY)
    tried = counts.state.astype(np.int64) * len(names) + counts.action
    lone = untried * len(names) + (names.index(_ANY) if untried.size else 0)
    choice = np.unique(np.concatenate([tried, lone]))
    state, action = np.divmod(choice, len(names))
    samples = np.bincount(np.searchsorted(choice, tried), counts.count, choice.size)
    is_open = ~stays[state] & (_may_miss(graph, samples, len(number)) | np.isin(choice, lone))
    start, successor, count = _entries(counts, np.searchsorted(choice, tried), state, is_open)
    labels = {
        name: _numbers(some, number, f"label {name!r}") for name, some in (labels or {}).items()
    }
    model = make_sparse(
        offsets_from_counts(np.bincount(state)),
        start,
        successor,
        _nominal(count, start),
        initial=_initial(initial, number),
        label=labels or None,
        action=action,
        action_names=names,
        valuation={"state": _variable(counts.states)},
    )
    return model, count


def _may_miss(graph: str | LeastProbability, samples: np.ndarray, size: int) -> NDArray[np.bool_]:
    """Choices with possible transitions that may not have been observed."""
    if isinstance(graph, LeastProbability) and samples.size * size > _SMALL_TABLE:
        return samples < graph.sufficient_samples(samples.size)
    if isinstance(
        graph, LeastProbability
    ):  # confidence sets exclude transitions, see learn_guarantee
        return np.ones(samples.shape, bool)
    return np.full(samples.shape, graph == "complete")


def _entries(
    counts: TransitionCounts, counted_row: Integers, state: Integers, is_open: NDArray[np.bool_]
) -> tuple[Integers, Integers, NDArray[np.int64]]:
    """Row starts, successors and counts of the observed and of the possible transitions."""
    size, num_open = len(counts.states), int(is_open.sum())
    if num_open * size > _MAX_ENTRIES:
        raise ValueError(
            f"{num_open} choices that may lead to each of {size} states are {num_open * size} "
            f"entries of 28 bytes; at most {_MAX_ENTRIES} are built. Say which states are "
            "terminal, or what is possible, with a count of 0."
        )
    counted = np.zeros(state.size, bool)
    counted[counted_row] = True
    loop = np.flatnonzero(~counted & ~is_open)
    every = np.tile(np.arange(size), num_open)
    row = np.concatenate([counted_row, loop, np.repeat(np.flatnonzero(is_open), size)])
    successor = np.concatenate([counts.successor, state[loop], every])
    count = np.concatenate([counts.count, np.zeros(loop.size + every.size, np.int64)])
    key, place = np.unique(row * np.int64(size) + successor, return_inverse=True)
    row, successor = np.divmod(key, size)
    return offsets_from_counts(np.bincount(row)), successor, _totals(place, count)


def _nominal(count: Integers, start: Integers) -> NDArray[np.float64]:
    """Empirical frequencies; rows with a zero use additive smoothing by one."""
    width = np.diff(start)
    more = np.repeat(np.minimum.reduceat(count, start[:-1]) == 0, width) + count.astype(np.float64)
    return cast(NDArray[np.float64], more / np.repeat(np.add.reduceat(more, start[:-1]), width))


def _require_counts(counts: object) -> None:
    if not isinstance(counts, TransitionCounts):
        raise ValueError(
            f"counts is {validation.shorten(counts)}; give TransitionCounts, as make_counts and "
            "read_log return them."
        )


def _variable(names: tuple[str, ...]) -> np.ndarray:
    if all(map(_INTEGER.fullmatch, names)):
        return np.array([int(name) for name in names], np.int64)
    return np.array(names, object)


def _numbers(names: object, number: Mapping[str, int], place: str) -> list[int]:
    numbers = []
    for name in [names] if isinstance(names, str | int) else validation.sequence(place, names):
        if str(name) not in number:
            raise ValueError(
                f"{place}: there is no state {str(name)!r}; there are {listed(tuple(number))}."
            )
        numbers.append(number[str(name)])
    return numbers


def _initial(initial: Initial, number: Mapping[str, int]) -> NDArray[np.float64]:
    weights = np.zeros(len(number))
    weight: ArrayLike = 1.0
    if isinstance(initial, Mapping):
        weight = validation.float_array("initial", list(initial.values()))
    weights[_numbers(initial, number, "initial")] = weight
    return weights if isinstance(initial, Mapping) else weights / max(weights.sum(), 1)
