"""Models that given policies induce, and the certificates' arrays of the policies."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np

from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import make_interval
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.sparse.rows import concatenated_ranges
from jaxltl.core.types import Solution
from jaxltl.core.values.discounted.discounted import optimal_value
from jaxltl.core.values.engine.row_form import row_form
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.step_bounded import bounded_reachability, cumulative_reward
from jaxltl.core.values.undiscounted.total_reward import total_reward
from jaxltl.io.certificate.inductive_bounds import Certified, Floats, Integers

Arrays = dict[str, tuple[Floats | Integers, tuple[int, ...]]]


def induced_problem(
    problem: Certified, policy: FiniteMemoryPolicy | Array
) -> tuple[Certified, Arrays, dict[str, object]]:
    """The question about the model that a policy of the system induces, on states with memory.

    The arrays of the policy, and their names in a question or in a claim, follow. Its memory reads a state
    when it is left, and its first memory state is that before the initial state.
    """
    form, host = row_form(problem.model), problem.host
    states = np.arange(host.num_states)
    if isinstance(policy, FiniteMemoryPolicy):
        if policy.has_horizon or policy.num_states != states.size:
            raise ValueError(
                f"policy has {policy.num_states} states, or an axis of time; expected a policy of "
                f"the model's {states.size} states without one."
            )
        after = np.asarray(policy.next_memory)
        is_exit = policy.label_on == "exit"
        later = np.broadcast_to(np.arange(after.shape[1]), after.shape) if is_exit else after
        now = np.concatenate([np.asarray(policy.initial_memory)[:, None], later], axis=1)
        following = 1 + (after[states[:, None], now] if is_exit else now)
        table = np.asarray(policy.action)[states[:, None], now]
    else:
        table, following = np.asarray(policy)[:, None], np.zeros((states.size, 1), np.int64)
    count = following.shape[1]
    # Weights float64[R, M]; of the environment's rows 1.
    weights = np.stack([form.weights(table[:, m]) for m in range(count)], axis=1)
    weights = np.where(problem.system[host.state][:, None], weights, 1.0)
    row, memory = (x.ravel() for x in np.indices(weights.shape))
    order = np.lexsort((row, memory, host.state[row]))
    order = order[weights.ravel()[order] > 0]
    row, memory, weight = row[order], memory[order], weights.ravel()[order]
    node = host.state[row].astype(np.int64) * count + memory
    is_first = np.r_[True, node[1:] != node[:-1]]
    if problem.uncertain is not None and (~is_first & problem.system[host.state[row]]).any():
        raise ValueError(
            "policy is randomised; certificates of interval models are written for policies of one "
            "action in each state."
        )
    begins = is_first | ~problem.system[host.state[row]]  # of rows of the induced model
    size = np.diff(host.entry_start)[row]
    entry = concatenated_ranges(host.entry_start[row].astype(np.int64), size)
    start = np.r_[0, np.cumsum(size)]
    place = np.repeat(following[host.state[row], memory], size)
    first = np.zeros(states.size * count)
    first[::count] = np.asarray(problem.sparse.initial)
    label = np.repeat(np.asarray(problem.sparse.label), count, axis=0)
    name = str(problem.path.get("reward"))
    sparse = make_sparse(
        np.searchsorted(node[begins], np.arange(states.size * count + 1)),
        np.r_[start[:-1][begins], start[-1]],
        host.successor[entry] * count + place,
        host.probability[entry] * np.repeat(weight, size),
        initial=first,
        label=label,
        propositions=problem.sparse.propositions,
        rewards={name: Rewards(transition=problem.gain[entry])},
    )
    model: Model = sparse
    uncertain = problem.uncertain
    if uncertain is not None:
        model = make_interval(sparse, uncertain.lower[entry], uncertain.upper[entry])
        uncertain = model.host
    system = np.repeat(problem.system, count)
    if isinstance(problem.model, Game):
        model = Game(model, cast(Array, system))
    shape: tuple[int, ...] = (states.size, count) if count > 1 else (states.size,)
    rule: dict[str, object] = {"policy": "policy"}
    arrays: Arrays = {}
    if count > 1:
        rule |= {"memory": count, "next": "next"}
        arrays["next"] = following, shape
    is_sure = bool(np.isin(weights, (0, 1)).all())
    if is_sure:
        chosen = np.zeros(states.size * count, np.int64)
        chosen[node[is_first]] = (row - host.row_start[host.state[row]])[is_first]
        arrays["policy"] = chosen, shape
    else:
        arrays["policy"] = weights, (host.num_rows, *shape[1:])
    induced = replace(
        problem,
        model=model,
        sparse=sparse,
        uncertain=uncertain,
        system=system,
        target=np.repeat(problem.target, count),
        stay=np.repeat(problem.stay, count),
        gain=np.asarray(sparse.rewards[name].transition, np.float64),
        node=np.arange(states.size * count),
        shape=shape,
    )
    return induced, arrays, rule


def solved(problem: Certified) -> Solution:
    """The solution of a question of reachability or rewards, with a policy of all players."""
    path, model, nature, objective = problem.path, problem.model, problem.nature, problem.objective
    reward, steps = str(path.get("reward")), cast(int, path.get("steps"))
    target, stay = cast(Array, problem.target), cast(Array, problem.stay)
    if "steps" in path and problem.is_probability:
        return bounded_reachability(
            model, target, steps, stay=stay, objective=objective, nature=nature
        )
    if "steps" in path:
        return cumulative_reward(model, reward, steps, objective=objective, nature=nature)
    if problem.is_probability:
        return reachability_probability(
            model, target, stay=stay, objective=objective, nature=nature
        )
    if "discount" in path:
        return optimal_value(model, reward, problem.discount, objective=objective, nature=nature)
    until = target if path["kind"] == "reward" else None
    return total_reward(model, reward, until, objective=objective, nature=nature)
