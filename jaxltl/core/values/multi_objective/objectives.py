"""Objectives of a multi-objective query, and the product with the memory that they need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Integers
from jaxltl.core.automata.runs import live_states, universal_states
from jaxltl.core.automata.table import explore
from jaxltl.core.automata.translate import FormulaLike
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.multi_objective.weighted_sum import WeightedProblem
from jaxltl.core.sparse.product import SparseProduct, sparse_product
from jaxltl.core.values.undiscounted.sparse_satisfaction import automaton_and_letters
from jaxltl.core.values.engine.state_quantities import nonnegative_reward, state_mask

_LIMIT = 8  # probabilities at once, of which all sets are looked at


@brief
@dataclass(frozen=True, eq=False)
class Objective:
    """One of several objectives: a probability or an expected reward.

    Give one of ``formula`` (the probability of an LTL formula), ``avoid`` (never to enter a set),
    ``reward`` (the expected total; with a target until that is reached, infinite if it is missed with
    positive probability), or ``target`` alone (to reach a set, through `stay`).

    Attributes:
      formula: a formula, its text, or an automaton.
      target: ``bool[S]``, or the name of a label.
      stay: with a target, ``bool[S]`` or a label that must hold until then.
      avoid: ``bool[S]``, or the name of a label.
      reward: as for :func:`~jaxltl.core.models.sparse.choice_reward`, not negative.
      direction: ``"max"`` or ``"min"``.
      threshold: at least that, or at most that for ``"min"``; None to optimise.

    Raises:
      ValueError: on use: none or several of the four are given, or a direction, a label or a shape
        is wrong.

    Example:
      >>> from jaxltl import constrained_optimum, make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> query = [Objective(formula="F G a"), Objective(target="b", threshold=0.25)]
      >>> round(constrained_optimum(model, query).value, 6)
      0.75
    """

    formula: FormulaLike | None = None
    target: Array | str | None = None
    stay: Array | str | None = None
    avoid: Array | str | None = None
    reward: Array | str | None = None
    direction: str = "max"
    threshold: float | Fraction | None = None


@brief
class ObjectivePart(NamedTuple):
    """Place of an objective in a weighted problem."""

    number: int  # of the objective, from 0
    kind: str  # "sure" for a probability, "gain" for a maximised reward, "cost"
    place: int  # its number among those of its kind
    sign: int  # 1 to maximise, -1 to minimise
    pending: np.ndarray | None  # bool[N], of a reward with a target, where that is not reached yet


class _ObjectiveMonitor(NamedTuple):
    """Deterministic monitor of an objective."""

    delta: np.ndarray  # int[Q, L]
    letter: np.ndarray  # int[S]
    first: int  # the initial state, before anything is read
    decided: np.ndarray  # bool[Q], where the verdict is known
    # int[Q, L] of reading a letter, of the event to be maximised; None of a reward
    priority: np.ndarray | None
    verdict: np.ndarray | None  # int[Q], the priority of decided states


def weighted_problem(
    model: SparseMDP, objectives: Sequence[Objective]
) -> tuple[WeightedProblem, list[ObjectivePart], SparseProduct]:
    """The objectives on the reachable product of the model and their monitors."""
    rewards = [_checked(model, i, o) for i, o in enumerate(objectives)]
    trackers = [_tracker(model, o, r is not None) for o, r in zip(objectives, rewards, strict=True)]
    used = [i for i, x in enumerate(trackers) if x is not None]
    if sum(r is None for r in rewards) > _LIMIT:
        raise ValueError(
            f"there are {sum(r is None for r in rewards)} probabilities; at most "
            f"{_LIMIT} can be had at once."
        )
    product, members = _product(
        model,
        [x for x in trackers if x is not None],
        all(
            o.target is not None for o, r in zip(objectives, rewards, strict=True) if r is not None
        ),
    )
    mdp = product.host
    state = members[product.memory]  # int[N, trackers]
    still = product.still
    parts: list[ObjectivePart] = []
    rows: dict[str, list[np.ndarray]] = {"sure": [], "gain": [], "cost": []}
    ended = np.ones(mdp.num_states, bool)
    for i, (objective, reward) in enumerate(zip(objectives, rewards, strict=True)):
        tracker, sign = trackers[i], 1 if objective.direction == "max" else -1
        memory = None if tracker is None else state[:, used.index(i)]
        pending = None
        if reward is not None:
            kind = "gain" if sign > 0 else "cost"
            counted = reward[product.base_row]
            if tracker is not None and memory is not None:
                pending = ~tracker.decided[memory]
                if sign < 0:  # a maximised reward without its target is infinite, which is allowed
                    ended &= ~pending
                counted = np.where(pending[mdp.state], counted, 0)
        else:
            assert tracker is not None and memory is not None
            kind, counted = "sure", _priorities(product, tracker, memory, still)
        parts.append(ObjectivePart(i, kind, len(rows[kind]), sign, pending))
        rows[kind].append(counted)
    initial = np.asarray(model.initial, np.float64)
    start = np.zeros(mdp.num_states)
    start[product.start] = initial[initial > 0]
    shape = (-1, mdp.num_rows)
    return (
        WeightedProblem(
            mdp,
            start,
            np.array(rows["sure"], np.int64).reshape(shape),
            np.array(rows["gain"], np.float64).reshape(shape),
            np.array(rows["cost"], np.float64).reshape(shape),
            ended,
        ),
        parts,
        product,
    )


def _checked(model: SparseMDP, index: int, objective: Objective) -> np.ndarray | None:
    """Validates an objective; the expected reward of rows if it is one of rewards."""
    name = f"objective {index + 1}"
    if objective.direction not in ("max", "min"):
        raise ValueError(f'{name}: direction={objective.direction!r}; it must be "max" or "min".')
    kinds = [n for n in ("formula", "avoid", "reward") if getattr(objective, n) is not None]
    if len(kinds) > 1 or (not kinds and objective.target is None):
        raise ValueError(
            f"{name}: give one of formula, avoid, reward or target; it has "
            f"{', '.join(kinds) or 'none'}."
        )
    if kinds and kinds[0] != "reward" and objective.target is not None:
        raise ValueError(f"{name}: a target goes with a reward or alone, not with {kinds[0]}.")
    if objective.stay is not None and (kinds or objective.target is None):
        raise ValueError(f"{name}: stay goes with the probability of a target.")
    if objective.reward is None:
        return None
    use = "expected total rewards"
    return nonnegative_reward(model, objective.reward, use, f"{name}: the reward")


def _tracker(model: SparseMDP, objective: Objective, is_reward: bool) -> _ObjectiveMonitor | None:
    opposite = objective.direction == "min"
    if objective.formula is not None:
        automaton, letter = automaton_and_letters(model, objective.formula)
        yes, no = universal_states(automaton), ~live_states(automaton)
        return _ObjectiveMonitor(
            automaton.delta,
            letter,
            int(automaton.initial),
            yes | no,
            automaton.priority + opposite,
            np.where(yes, 0, 1) + opposite,
        )
    if is_reward and objective.target is None:
        return None
    if objective.avoid is not None:
        target, opposite = state_mask(model, objective.avoid, "avoid"), not opposite
    else:
        target = state_mask(model, objective.target, "target")
    letter = target.astype(np.int64)
    if objective.stay is not None:
        letter[~state_mask(model, objective.stay, "stay") & ~target] = 2
    # Open, met, missed.
    delta = np.array([[0, 1, 2], [1, 1, 1], [2, 2, 2]])
    decided = np.array([False, True, True])
    if is_reward:
        return _ObjectiveMonitor(delta, letter, 0, decided, None, None)
    return _ObjectiveMonitor(
        delta,
        letter,
        0,
        decided,
        np.where(delta == 1, 0, 1) + opposite,
        np.array([1, 0, 1]) + opposite,
    )


def _product(
    model: SparseMDP, trackers: list[_ObjectiveMonitor], all_end: bool
) -> tuple[SparseProduct, np.ndarray]:
    """The product with all monitors, and the state of each in each joint one, ``int[J, n]``."""
    letters: Integers = np.zeros((model.num_states, len(trackers)), np.int64)
    for i, x in enumerate(trackers):
        letters[:, i] = x.letter
    combinations, letter = np.unique(letters, axis=0, return_inverse=True)
    letter, words = letter.reshape(-1), combinations.tolist()
    tables = [x.delta.tolist() for x in trackers]

    def step(members: tuple[int, ...]) -> list[tuple[tuple[int, ...], int]]:
        rows = [table[q] for table, q in zip(tables, members, strict=True)]
        return [(tuple(r[x] for r, x in zip(rows, word, strict=True)), 0) for word in words]

    # The first joint state is that of before anything is read.
    order, rows, _ = explore(tuple(x.first for x in trackers), step)
    members, delta = np.array(order, np.int64).reshape(len(order), len(trackers)), np.stack(rows)
    still = np.full(len(order), all_end)
    for i, x in enumerate(trackers):
        still &= x.decided[members[:, i]]
    first = np.flatnonzero(np.asarray(model.initial) > 0)
    start = first, delta[0, letter[first]]
    return sparse_product(model.host, delta, letter, start, still=still), members


def _priorities(
    product: SparseProduct, tracker: _ObjectiveMonitor, memory: np.ndarray, still: np.ndarray
) -> np.ndarray:
    """The least priority that each row reads, ``int[R']``."""
    mdp = product.host
    assert tracker.priority is not None and tracker.verdict is not None
    read = product.entry_letter(tracker.letter, True)
    of_entry = tracker.priority[memory[mdp.state[mdp.row]], read]
    least = np.minimum.reduceat(of_entry, mdp.entry_start[:-1])
    return np.where(still[mdp.state], tracker.verdict[memory[mdp.state]], least)
