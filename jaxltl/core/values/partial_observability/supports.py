"""Almost-sure reachability and safety of a POMDP on the supports of its beliefs.

A set of supports is winning if each has actions after which all successor supports are in the set, no state
of it is left for an unsafe one, and, for reachability, from each state of each support the target is
reached with positive probability by such actions (Chatterjee, Chmelik and Tracol 2016).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.models.pomdp import POMDP, make_pomdp
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import Rewards, choice_reward, make_sparse
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.graph.components import forward_reachable
from jaxltl.core.sparse.rows import offsets_from_counts
from jaxltl.core.values.partial_observability.solve import target_states

MAX_SUPPORTS = 100_000


@brief
@dataclass(frozen=True)
class SupportShield:
    """Winning supports of beliefs, U of them that are reachable, and the actions that keep winning.

    Attributes:
      supports: the states of each support, ascending.
      winning: ``bool[U]``.
      allowed: ``bool[U, A]``, False at supports that are not winning.
      initial: the numbers of the initial supports, one for each initial observation.
      pomdp: the POMDP within the shield: a policy reads the support, and has the allowed actions alone. Its
        states are pairs of a state and its support, and target states. None if an initial support is not
        winning.

    Example:
      >>> import numpy as np
      >>> SupportShield(((0, 1),), np.ones(1, bool), np.ones((1, 2), bool), np.zeros(1, int), None).is_winning
      True
    """

    supports: tuple[tuple[int, ...], ...]
    winning: Booleans
    allowed: Booleans
    initial: Integers
    pomdp: POMDP | None

    @property
    def is_winning(self) -> bool:
        """True if the initial belief is winning."""
        return bool(self.winning[self.initial].all())


def support_shield(
    pomdp: POMDP,
    target: Array | str | None = None,
    *,
    safe: Array | str | None = None,
    max_supports: int = MAX_SUPPORTS,
) -> SupportShield:
    """Almost-sure winning supports of a POMDP: stay in safe states, until a target is reached if there is one.

    Controllers that learn on ``shield.pomdp`` never leave the safe states, and can always still reach the
    target.

    Args:
      pomdp: a concrete POMDP.
      target: ``bool[S]``, a label or a formula of labels, to be reached almost surely; default: none, for
        which safe states are kept for ever.
      safe: the states that must be kept until then; default: all.
      max_supports: largest number of supports, of which there may be exponentially many.

    Returns:
      :class:`SupportShield`.

    Raises:
      ValueError: neither a target nor safe states, or more supports.

    Example:
      >>> import jaxltl as jl
      >>> world = jl.make_sparse([0, 2, 4, 5, 6], [0, 1, 2, 3, 4, 5, 6], [2, 3, 3, 2, 2, 3], [1.0] * 6,
      ...                        initial=[0.5, 0.5, 0, 0], label={"goal": [2]})
      >>> blind, seeing = (jl.models.make_pomdp(world, o) for o in ([0, 0, 1, 1], [0, 1, 2, 2]))
      >>> support_shield(blind, "goal").is_winning, support_shield(seeing, "goal").is_winning
      (False, True)
    """
    if target is None and safe is None:
        raise ValueError("support_shield: give a target, safe states, or both.")
    size = pomdp.num_states
    none, every = np.zeros(size, bool), np.ones(size, bool)
    goal = none if target is None else target_states(pomdp, "target", target)
    kept = every if safe is None else target_states(pomdp, "safe", safe)
    graph = _explore(pomdp, goal, kept | goal, max_supports)
    winning, allowed = _winning(graph, needs_target=target is not None)
    inside = None
    if winning[graph.initial].all() and not (np.asarray(pomdp.initial)[~(kept | goal)] > 0).any():
        inside = _shielded(pomdp, graph, goal, allowed)
    elif graph.initial.size:
        winning = winning.copy()
        if (np.asarray(pomdp.initial)[~(kept | goal)] > 0).any():
            winning[graph.initial] = False
    return SupportShield(graph.supports, winning, allowed, graph.initial, inside)


@dataclass(frozen=True)
class _SupportGraph:
    """Reachable supports and the pairs of a state and its support."""

    supports: tuple[tuple[int, ...], ...]
    initial: Integers
    legal: Booleans  # bool[U, A], available actions that lead to no unsafe state
    # successors of supports: support, action, support
    step: Integers  # int[3, E]
    support: Integers  # int[P], of each pair
    state: Integers  # int[P]
    # successors of pairs: pair, action, pair or -1 - t for a target state t; and probabilities
    move: Integers  # int[3, M]
    probability: np.ndarray


def _explore(pomdp: POMDP, goal: Booleans, kept: Booleans, limit: int) -> _SupportGraph:
    host, table = pomdp.fully_observable.host, pomdp.row_of_action
    seen = np.asarray(pomdp.observation).tolist()
    ends, stays, available = goal.tolist(), kept.tolist(), pomdp.available
    number: dict[tuple[int, ...], int] = {}
    order: list[tuple[int, ...]] = []

    def place(states: set[int]) -> int:
        key = tuple(sorted(states))
        if key not in number:
            number[key] = len(order)
            order.append(key)
            if len(order) > limit:
                raise ValueError(
                    f"the POMDP has more than {limit} supports of beliefs; raise max_supports."
                )
        return number[key]

    groups: dict[int, set[int]] = {}
    for s in np.flatnonzero(np.asarray(pomdp.initial) > 0).tolist():
        if not ends[s]:
            groups.setdefault(seen[s], set()).add(s)
    initial = np.array([place(group) for group in groups.values()], np.int64)
    legal: list[np.ndarray] = []
    steps: list[tuple[int, int, int]] = []
    moves: list[tuple[int, int, int, int, int, float]] = []  # support, state, action, t, support, p
    at = 0
    while at < len(order):
        states = order[at]
        row = available[seen[states[0]]].copy()
        for action in np.flatnonzero(row).tolist():
            groups, edges = {}, []
            for s in states:
                first, last = host.entry_start[table[s, action] : table[s, action] + 2]
                after = host.successor[first:last].tolist()
                for t, p in zip(after, host.probability[first:last].tolist(), strict=True):
                    edges.append((s, t, p))
                    if not ends[t]:
                        groups.setdefault(seen[t], set()).add(t)
            if not all(stays[t] for _, t, _ in edges):
                row[action] = False
                continue
            to = {o: place(group) for o, group in groups.items()}
            steps += [(at, action, j) for j in to.values()]
            moves += [(at, s, action, t, -1 if ends[t] else to[seen[t]], p) for s, t, p in edges]
        legal.append(row)
        at += 1
    starts = offsets_from_counts(np.array([len(x) for x in order], np.int64))
    state = np.array([s for x in order for s in x], np.int64)
    support = np.arange(len(order)).repeat(np.diff(starts))
    size = pomdp.num_states
    key = support * size + state
    columns = np.array([m[:5] for m in moves], np.int64).reshape(-1, 5).T
    source = np.searchsorted(key, columns[0] * size + columns[1])
    to_target = columns[4] < 0
    after = np.searchsorted(key, np.where(to_target, 0, columns[4] * size + columns[3]))
    after = np.where(to_target, -1 - columns[3], after)
    return _SupportGraph(
        tuple(order),
        initial,
        np.array(legal, bool).reshape(len(order), pomdp.num_actions),
        np.array(steps, np.int64).reshape(-1, 3).T,
        support,
        state,
        np.stack([source, columns[2], after]),
        np.array([m[5] for m in moves]),
    )


def _winning(graph: _SupportGraph, *, needs_target: bool) -> tuple[Booleans, Booleans]:
    """The greatest winning set of supports, and its actions."""
    winning, allowed = np.ones(len(graph.supports), bool), graph.legal.copy()
    source, action, after = graph.step
    pair, taken, to = graph.move
    while True:
        leaving = ~winning[after]
        allowed[source[leaving], action[leaving]] = False
        allowed[~winning] = False
        kept = allowed.any(1)
        if needs_target and kept.any():
            used = allowed[graph.support[pair], taken]
            good = np.zeros(graph.state.size, bool)
            good[pair[used & (to < 0)]] = True
            inner = used & (to >= 0)
            good = forward_reachable(to[inner], pair[inner], good)
            kept &= np.bincount(graph.support[~good], minlength=kept.size) == 0
        if (kept == winning).all():
            return winning, allowed
        winning &= kept


def _shielded(pomdp: POMDP, graph: _SupportGraph, goal: Booleans, allowed: Booleans) -> POMDP:
    """The POMDP on pairs of winning supports, with target states of one action that stays."""
    model = pomdp.fully_observable
    pair, action, to = graph.move
    used = allowed[graph.support[pair], action]
    pair, action, to, weight = pair[used], action[used], to[used], graph.probability[used]
    some: Booleans = np.asarray(allowed.any(axis=1))
    winning = some[graph.support]
    targets = np.flatnonzero(goal)
    number = np.where(winning, winning.cumsum() - 1, -1)
    size = int(winning.sum())
    place = np.zeros(pomdp.num_states, np.int64)
    place[targets] = size + np.arange(targets.size)
    after = np.where(to < 0, place[np.where(to < 0, -1 - to, 0)], number[np.maximum(to, 0)])
    num = pomdp.num_actions
    key = number[pair] * num + action
    order = np.argsort(key, kind="stable")
    row_key, count = np.unique(key, return_counts=True)
    state = np.concatenate([row_key // num, size + np.arange(targets.size)])
    base = np.concatenate([graph.state[winning], targets])
    rows = pomdp.row_of_action[base[row_key // num], row_key % num]
    rewards = {}
    for name in model.rewards:
        earned = choice_reward(model, name)[rows]
        rewards[name] = Rewards(choice=np.append(earned, np.zeros(targets.size)))
    initial = np.zeros(base.size)
    begins = np.asarray(model.initial, np.float64)
    first = np.isin(graph.support[winning], graph.initial)
    initial[:size][first] = begins[base[:size][first]]
    initial[size:] = begins[targets]
    world = make_sparse(
        offsets_from_counts(np.bincount(state, minlength=base.size)),
        offsets_from_counts(np.append(count, np.ones(targets.size, np.int64))),
        np.concatenate([after[order], size + np.arange(targets.size)]),
        np.concatenate([weight[order], np.ones(targets.size)]),
        initial=initial,
        label=np.asarray(model.label)[base],
        propositions=model.propositions,
        rewards=rewards,
        action=np.append(row_key % num, np.zeros(targets.size, np.int64)),
        valuation={"state": base},
    )
    _, kept = np.unique(graph.support[winning], return_inverse=True)
    count_supports = int(kept.max(initial=-1)) + 1
    _, ends = np.unique(np.asarray(pomdp.observation)[targets], return_inverse=True)
    seen = np.concatenate([kept.ravel(), count_supports + ends.ravel()])
    return make_pomdp(world, seen)
