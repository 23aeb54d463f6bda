"""State reduction of finite-memory policies that read observations, and their Mealy machines."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans, Floats
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.protocols import Array
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.graph.components import forward_reachable
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.values.partial_observability.chains import controlled_chain, machine_of

START = -1  # stands for the memory before the first observation
MAX_REDUCED = 300  # memory states whose pairs are compared


@brief
class MealyTransition(NamedTuple):
    """A transition of a controller: it enters an observation and chooses actions there.

    Attributes:
      source, target: memory states; a source of -1 is before the first observation.
      observation: the observation that is entered.
      action: ``float[A]``, the distribution of the action that follows.

    >>> MealyTransition(-1, 0, 3, np.ones(1)).observation
    3
    """

    source: int
    target: int
    observation: int
    action: Floats


def mealy_machine(
    pomdp: POMDP, policy: FiniteMemoryPolicy, *, decided: Array | None = None
) -> list[MealyTransition]:
    """The reachable transitions of a finite-memory policy in a POMDP, as a Mealy machine.

    Args:
      pomdp: the model.
      policy: over its observations, with memory updates on entry.
      decided: ``bool[S]``, states from which actions no longer matter; transitions into them are left
        out. Default: none.

    Returns:
      Transitions ``(source, target, observation, action)``, ordered; those of source -1 read the first
      observation.

    Raises:
      ValueError: a policy of other observations, or with updates on exit.

    Example:
      >>> import jaxltl as jl
      >>> world = jl.from_dense([[[0, 1.0], [1.0, 0]], [[1.0, 0], [0, 1.0]]], initial=[1, 0])
      >>> pomdp = jl.models.make_pomdp(world, [0, 0])
      >>> alternate = jl.FiniteMemoryPolicy(np.array([[0, 1]]), np.array([0]), np.array([[1, 0]]))
      >>> [x[:3] for x in mealy_machine(pomdp, alternate)]
      [(-1, 0, 0), (0, 1, 0), (1, 0, 0)]
    """
    if policy.label_on != "entry":
        raise ValueError(
            f"the policy's label_on is {policy.label_on!r}; give one that updates its memory by the "
            "observation that is entered, 'entry'."
        )
    chain, machine = controlled_chain(pomdp, policy), machine_of(pomdp, policy)
    memory, seen = (
        chain.valuation["memory"],
        np.asarray(pomdp.observation)[chain.valuation["state"]],
    )
    host = chain.host
    matters = np.ones(pomdp.num_states, bool) if decided is None else ~np.asarray(decided, bool)
    open_pair = matters[chain.valuation["state"]]
    before = np.repeat(np.arange(host.num_states), np.diff(host.entry_start))
    kept = open_pair[before] & open_pair[host.successor]
    before, after = before[kept], host.successor[kept]
    begins = (np.asarray(chain.initial) > 0) & open_pair
    kept = forward_reachable(before, after, begins)[before]
    source, after, first = memory[before[kept]], after[kept], np.flatnonzero(begins)
    rows = [
        np.stack([np.full(first.size, START), memory[first], seen[first]], 1),
        np.stack([source, memory[after], seen[after]], 1),
    ]
    distinct = np.unique(np.concatenate(rows), axis=0)
    action = machine.act(distinct[:, 1], distinct[:, 2])
    return [
        MealyTransition(source, target, observation, chosen)
        for (source, target, observation), chosen in zip(distinct.tolist(), action, strict=True)
    ]


def reduced_controller(
    pomdp: POMDP, policy: FiniteMemoryPolicy, *, decided: Array | None = None
) -> FiniteMemoryPolicy:
    """State reduction of a controller: memory states that act alike wherever both can be are merged.

    Merging is greedy (state reduction of incompletely specified machines is NP-hard, Pfleeger 1973):
    two states are merged if their actions agree in every observation that both reach, and so do, in
    turn, the states that follow. The induced chain stays the same up to names of memory states, until
    a decided state is entered.

    Args:
      pomdp: the model.
      policy: over its observations, with memory updates on entry.
      decided: ``bool[S]``, states from which actions no longer matter. Default: none.

    Returns:
      :class:`~jaxltl.core.policies.finite_memory.FiniteMemoryPolicy`; it begins in memory
      state 0, which the first observation updates. Where the chain does not come, it chooses uniformly
      and keeps its memory state.

    Raises:
      ValueError: a policy of other observations, or with updates on exit.

    Example:
      >>> import jaxltl as jl
      >>> world = jl.from_dense([[[0, 1.0], [1.0, 0]], [[1.0, 0], [0, 1.0]]], initial=[1, 0])
      >>> pomdp = jl.models.make_pomdp(world, [0, 0])
      >>> redundant = jl.FiniteMemoryPolicy(np.zeros((1, 3), int), np.array([1]), np.array([[0, 2, 1]]))
      >>> reduced_controller(pomdp, redundant).action.tolist()
      [[[1.0, 0.0]]]
    """
    transitions = mealy_machine(pomdp, policy, decided=decided)
    states = sorted({t.target for t in transitions}) or [0]
    after = {(t.source, t.observation): t.target for t in transitions}
    acts = {(t.target, t.observation): tuple(t.action.tolist()) for t in transitions}
    merged = _merged(states, after, acts)
    number: dict[int, int] = {}
    for state in [START, *states]:  # the class of the start is memory state 0
        number.setdefault(merged[state], len(number))
    count, available = pomdp.num_observations, pomdp.available
    uniform = available / np.maximum(available.sum(1, keepdims=True), 1)
    uniform[~available.any(1)] = 1 / pomdp.num_actions  # observations that do not occur
    action = np.repeat(uniform[:, None], len(number), 1)
    update = np.tile(np.arange(len(number), dtype=np.int32), (count, 1))
    for (state, o), row in acts.items():
        action[o, number[merged[state]]] = row
    for (state, o), target in after.items():
        update[o, number[merged[state]]] = number[merged[target]]
    return FiniteMemoryPolicy(action, update[:, 0].copy(), update, actions=policy.actions)


def _merged(
    states: list[int],
    after: dict[tuple[int, int], int],
    acts: dict[tuple[int, int], tuple[float, ...]],
) -> dict[int, int]:
    """The class of each memory state and of the start, named by one of its members."""
    every = [START, *states]
    root = {state: state for state in every}
    moves: dict[int, dict[int, int]] = {state: {} for state in every}
    chosen: dict[int, dict[int, tuple[float, ...]]] = {state: {} for state in every}
    for (state, o), target in after.items():
        moves[state][o] = target
    for (state, o), row in acts.items():
        chosen[state][o] = row
    if len(states) > MAX_REDUCED:
        return root

    def find(names: dict[int, int], state: int) -> int:
        while names[state] != state:
            state = names[state]
        return state

    def fold(pairs: Iterable[tuple[int, int]]) -> bool:
        """Merges pairs and all that follow, or changes nothing."""
        names, waiting = dict(root), list(pairs)
        new_moves: dict[int, dict[int, int]] = {}
        new_chosen: dict[int, dict[int, tuple[float, ...]]] = {}
        while waiting:
            one, other = (find(names, x) for x in waiting.pop())
            if one == other:
                continue
            mine, its = (new_chosen.get(x, chosen[x]) for x in (one, other))
            if any(its[o] != row for o, row in mine.items() if o in its):
                return False
            to_one, to_other = (new_moves.get(x, moves[x]) for x in (one, other))
            waiting += [(target, to_other[o]) for o, target in to_one.items() if o in to_other]
            names[other] = one
            new_chosen[one], new_moves[one] = its | mine, to_other | to_one
        root.update(names)
        moves.update(new_moves)
        chosen.update(new_chosen)
        return True

    classes: list[int] = []
    for state in every:
        if find(root, state) == state and not any(fold([(c, state)]) for c in classes):
            classes.append(state)
        classes = [c for c in classes if find(root, c) == c]
    return {state: find(root, state) for state in every}


def without_rare_actions(policy: FiniteMemoryPolicy, least: float) -> FiniteMemoryPolicy:
    """The policy without the actions of at most a probability, but for the likeliest ones of each distribution.

    In the long run a rare action that violates a formula is taken almost surely.

    Args:
      policy: a finite-memory policy. One that chooses single actions is returned as it is.
      least: the probability, at least 0 and below 1.

    Returns:
      The policy, with distributions that sum to one; on the host.

    Raises:
      ValueError: `least` out of range, or numbers that are no distribution.

    >>> policy = FiniteMemoryPolicy(np.array([[[0.9, 0.1]]]), np.zeros(1, int), np.zeros((1, 1), int))
    >>> without_rare_actions(policy, 0.2).action.tolist()
    [[[1.0, 0.0]]]
    """
    validation.require_in_range("least", least, validation.Range(0, 1, open_above=True))
    action: Floats = np.asarray(policy.action)
    if not np.issubdtype(action.dtype, np.floating):
        return policy
    wrong = ~((action >= 0).all(-1) & (np.abs(action.sum(-1) - 1) < 1e-3))
    if wrong.any():
        at = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise ValueError(
            f"policy: the actions at {at} have the probabilities {action[at].tolist()}; give a distribution, "
            "at least 0 with sum 1."
        )
    kept: Booleans = (action > least) | (action == action.max(-1, keepdims=True))
    weight: Floats = np.where(kept, action, 0.0)
    return policy.replace(action=weight / weight.sum(-1, keepdims=True))
