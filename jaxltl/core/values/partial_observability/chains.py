"""Markov chains of a POMDP under controllers that read its observations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Floats, Integers, SparseMatrix
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.sparse import Rewards, SparseMDP, choice_reward, make_sparse
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import offsets_from_counts, row_entries
from jaxltl.core.models.protocols import Array
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure
from jaxltl.core.types import Solution, Status, describe_row, row_tolerance

Act = Callable[[Integers, Integers], Floats]  # weights [n, A] of memory states and observations
# the memory state after a step, of memory states and the observations that are left and entered
Next = Callable[[Integers, Integers, Integers], Integers]
MAX_PAIRS = 20_000_000  # pairs of a state and a memory state


class Machine(NamedTuple):
    """A controller: a memory state for each initial observation, actions, and updates."""

    start: Integers  # int[O]
    act: Act
    next: Next


@dataclass(frozen=True)
class JointChain:
    """The chain of pairs of a state and a memory state that are reachable, initial ones first."""

    state: Integers  # int[P]
    memory: Integers  # int[P]
    matrix: SparseMatrix  # float64[P, P], without what leaves the states
    mean: Callable[[Floats], Floats]  # of quantities of states and actions [A, N], those of pairs
    num_terms: int  # of each probability, a sum of products


def joint_chain(
    machine: Machine,
    transition: Sequence[SparseMatrix],
    observation: Integers,
    initial: Integers,
) -> JointChain:
    """The reachable pairs from initial states ``int[I]``, by levels."""
    from scipy.sparse import csr_array

    states, size = np.array(initial, np.int64), observation.size
    memory = machine.start[observation[states]].astype(np.int64)
    known = np.sort(memory * size + states)
    order, place = known, np.arange(known.size)
    pairs: list[Integers] = [order]
    blocks: list[tuple[Integers, Integers, Floats]] = []
    weights: list[Floats] = []
    number, count = place, known.size
    level = order
    while level.size:
        states, memory = level % size, level // size
        weight = machine.act(memory, observation[states])
        weights.append(weight)
        source, key, by = [], [], []
        for action, matrix in enumerate(transition):
            chosen = np.flatnonzero(weight[:, action] > 0)
            entry, width = row_entries(matrix.indptr, states[chosen])
            of = chosen.repeat(width)
            after = matrix.indices[entry]
            kept = machine.next(memory[of], observation[states[of]], observation[after])
            source.append(of)
            key.append(kept.astype(np.int64) * size + after)
            by.append(weight[of, action] * matrix.data[entry])
        joint = np.concatenate(key)
        fresh = np.setdiff1d(joint, known, assume_unique=False)
        blocks.append((np.concatenate(source) + (count - level.size), joint, np.concatenate(by)))
        number = np.concatenate([number, count + np.arange(fresh.size)])
        known = np.concatenate([known, fresh])
        order = np.argsort(known, kind="stable")
        known, number = known[order], number[order]
        pairs.append(fresh)
        count += fresh.size
        if count > MAX_PAIRS:
            raise ValueError(
                f"the controller and the POMDP have more than {MAX_PAIRS} pairs of states; give a "
                "controller of less memory."
            )
        level = fresh
    reached = np.concatenate(pairs)
    row, after, data = (np.concatenate(x) for x in zip(*blocks, strict=True))
    column = number[np.searchsorted(known, after)]
    matrix = csr_array((data, (row, column)), shape=(count, count))
    matrix.sum_duplicates()
    matrix.sort_indices()
    ends: Integers = reached % size
    table = np.concatenate(weights).T

    def mean(quantity: Floats) -> Floats:
        total: Floats = np.where(table > 0, table * quantity[:, ends], 0).sum(0)
        return total

    return JointChain(ends, reached // size, matrix, mean, 2 * len(transition) + 4)


def chain_with_ends(chain: SparseMatrix, gain: Floats) -> tuple[HostMDP, np.ndarray]:
    """The chain with two more states, entered with probability `gain` and with the rest; the first one."""
    from scipy.sparse import csr_array, eye_array, hstack, vstack

    size = chain.shape[0]
    rest = np.maximum(1 - (np.asarray(chain.sum(1)).ravel() + gain), 0)
    rest[rest < 1e-14] = 0  # rounding
    ends = csr_array(np.stack([gain, rest], 1))
    ends.eliminate_zeros()
    stay = hstack([csr_array((2, size)), eye_array(2)])
    whole = csr_array(vstack([hstack([chain, ends]), stay]))
    whole.sort_indices()
    target = np.zeros(size + 2, bool)
    target[size] = True
    start = np.arange(size + 3)
    return HostMDP(start, whole.indptr, whole.indices, whole.data), target


def machine_of(pomdp: POMDP, policy: FiniteMemoryPolicy) -> Machine:
    """The controller of a finite-memory policy over observations; ValueError for one that does not fit."""
    if not isinstance(policy, FiniteMemoryPolicy):
        raise ValueError(
            f"policy is {type(policy).__name__}; give a FiniteMemoryPolicy whose states are the "
            f"{pomdp.num_observations} observations."
        )
    table = policy.on_host()
    count, available = pomdp.num_observations, pomdp.available
    available = available | ~available.any(1, keepdims=True)  # observations that do not occur
    if table.num_states != count or policy.has_horizon or table.num_actions > pomdp.num_actions:
        raise ValueError(
            f"the policy has {table.num_states} observations and {table.num_actions} actions"
            f"{', by time step' if policy.has_horizon else ''}; the POMDP has {count} and "
            f"{pomdp.num_actions}."
        )
    action, update = np.asarray(table.action), np.asarray(table.next_memory)
    if policy.is_random:
        action = np.asarray(action, np.float64)
        weight = np.zeros((*action.shape[:-1], pomdp.num_actions))
        weight[..., : action.shape[-1]] = action
        bad = ~(weight >= 0).all(-1) | ~(abs(weight.sum(-1) - 1) <= row_tolerance(np.float32))
        bad |= ((weight > 0) & ~available[:, None]).any(-1)
        for o, q in np.argwhere(bad)[:1]:
            row = np.where(available[o] | (weight[o, q] == 0), weight[o, q], np.nan)
            raise ValueError(f"{describe_row(row, (int(o), int(q)))}.")
        weight = weight / weight.sum(-1, keepdims=True)
    else:
        legal = (action >= 0) & (action < pomdp.num_actions)
        legal &= available[np.arange(count)[:, None], np.where(legal, action, 0)]
        for o, q in np.argwhere(~legal)[:1]:
            raise ValueError(
                f"the policy takes action {action[o, q]} at observation {o} with memory {q}; available "
                f"are {np.flatnonzero(available[o]).tolist()}."
            )
        weight = np.eye(pomdp.num_actions)[action]
    on_entry = policy.label_on == "entry"

    def after(memory: Integers, before: Integers, seen: Integers) -> Integers:
        return update[seen if on_entry else before, memory]

    return Machine(np.asarray(table.initial_memory), lambda q, o: weight[o, q], after)


def controlled_chain(pomdp: POMDP, policy: FiniteMemoryPolicy) -> SparseMDP:
    """Markov chain that a controller of observations induces in a POMDP.

    Its states are the reachable pairs of a state and a memory state, with the labels and the rewards of
    the POMDP; every solver of chains answers questions about the controller by it, with certified bounds.

    Args:
      pomdp: the model.
      policy: a finite-memory policy whose states are the observations: ``action`` is ``float[O, Q, A]``
        or ``int[O, Q]``, ``next_memory`` ``int[O, Q]``.

    Returns:
      :class:`~jaxltl.core.models.sparse.SparseMDP`, a chain; its valuation has the variables of the POMDP,
      and ``"state"`` and ``"memory"``.

    Raises:
      ValueError: a policy of other observations or actions.

    Example:
      >>> import numpy as np, jaxltl as jl
      >>> world = jl.from_dense([[[0, 1.0], [1.0, 0]], [[1.0, 0], [0, 1.0]]], label={"b": [1]},
      ...                       initial=[1, 0])
      >>> pomdp = jl.models.make_pomdp(world, [0, 0])
      >>> alternate = jl.FiniteMemoryPolicy(np.array([[0, 1]]), np.array([0]), np.array([[1, 0]]))
      >>> chain = controlled_chain(pomdp, alternate)
      >>> jl.solve_property(chain, 'P=? [ G F "b" ]').value.tolist()
      [1.0]
    """
    from scipy.sparse import csr_array

    model = pomdp.fully_observable
    host, table = model.host, pomdp.row_of_action
    size, seen = model.num_states, np.asarray(pomdp.observation)
    transition = []
    for action in range(pomdp.num_actions):
        some = np.flatnonzero(table[:, action] >= 0)
        inner = host.matrix[table[some, action]].tocoo()
        place = some[inner.coords[0]]
        transition.append(csr_array((inner.data, (place, inner.coords[1])), shape=(size, size)))
    initial = np.asarray(model.initial, np.float64)
    first = np.flatnonzero(initial > 0)
    chain = joint_chain(machine_of(pomdp, policy), transition, seen, first)
    rewards = {}
    for name in model.rewards:
        of_row = choice_reward(model, name)
        by_action = np.where(table >= 0, of_row[table], 0).T
        rewards[name] = Rewards(choice=chain.mean(by_action))
    begins = np.zeros(chain.state.size)
    begins[: first.size] = initial[chain.state[: first.size]]
    valuation = {name: np.asarray(x)[chain.state] for name, x in model.valuation.items()}
    return make_sparse(
        None,
        offsets_from_counts(np.diff(chain.matrix.indptr)),
        chain.matrix.indices,
        chain.matrix.data,
        initial=begins,
        label=np.asarray(model.label)[chain.state],
        propositions=model.propositions,
        rewards=rewards,
        valuation=valuation | {"state": chain.state, "memory": chain.memory},
    )


def chain_solution(bounds: Enclosure, initial: Floats) -> Solution:
    """The solution of a chain, whose ``at_initial`` has the bounds from the initial belief."""
    parts: dict[str, Array] = {
        "value": bounds.value,
        "policy": bounds.row,
        "lower": bounds.lower,
        "upper": bounds.upper,
        "residual": np.float64(bounds.residual),
        "num_steps": np.int32(bounds.rounds),
        "status": np.int32(Status.CONVERGED),
        "initial": initial,
    }
    return Solution(**parts, method=bounds.method)
