"""Expected total reward until a target is reached, or for ever, with certified bounds."""

from __future__ import annotations

from typing import Any

import chex
import numpy as np

from jaxltl.core.host import optimal
from jaxltl.core.models.concrete import is_traced
from jaxltl.core.models.convert import to_sparse
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.sparse import Rewards, SparseMDP, row_reward
from jaxltl.core.types import Solution, require_shape
from jaxltl.core.values.enclosed import (
    chain_of,
    default_tolerance,
    given_policy,
    is_sparse,
    solution_of,
)
from jaxltl.core.values.robust import refuse_nature, robust_total_reward


def total_reward(
    model: Any,
    reward: str | Rewards | chex.Array | None,
    target: chex.Array | None = None,
    *,
    policy: chex.Array | None = None,
    objective: str = "max",
    nature: str | None = None,
    tolerance: float | None = None,
) -> Solution:
    """Expected reward until a target is reached; without a target, for ever.

    The least solution of ``x = 0`` on the target, ``x = opt_a (r(s, a) + (P x)(s, a))`` elsewhere
    (Puterman 1994, chapter 7; Baier and Katoen 2008, section 10.5.1). What comes after the target
    does not count. It is infinite where the target is not reached almost surely: for ``"max"``
    under some policy, for ``"min"`` under every policy; without a target where reward is earned
    for ever. That is decided on the graph; where going round earns nothing, states are one.

    Args:
      model: a concrete MDP, DenseMDP, SparseMDP or product of one, or an IntervalMDP.
      reward: at least 0. For a sparse model as of
        :func:`~jaxltl.core.models.sparse.row_reward`: a name, a structure, or an array on states,
        choices or transitions; else ``float[S]`` or ``float[S, A]``, what a step earns.
      target: ``bool[S]``.
      policy: evaluate this policy; default: optimise.
      objective: ``"max"`` or ``"min"``; ignored when a policy is given.
      nature: of interval models only, see
        :func:`~jaxltl.core.values.robust.robust_total_reward`, which answers then.
      tolerance: the width of the enclosure asked for, as a share of the value; default 1e-6 in
        double precision, 1e-3 in single.

    Returns:
      :class:`Solution`; `value` is ``float[S]``, infinite or 0 exactly where the graph says so. An
      optimum's `policy` attains its bound on the safe side: ``int32[S]``, rows of a sparse model,
      else actions.

    Raises:
      ValueError: a shape, the objective or a policy is wrong, a reward is negative, or something
        is traced.

    Example:
      >>> from jaxltl.core.models.sparse import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> total_reward(coin, np.ones(2), np.array([False, True])).value.round(6).tolist()
      [2.0, 0.0]
    """
    if objective not in ("max", "min"):
        raise ValueError(f'objective={objective!r}; it must be "max" or "min".')
    if isinstance(model, IntervalMDP):
        if target is None:
            raise ValueError("total rewards of interval models need a target; give one.")
        return robust_total_reward(
            model, reward, target, policy=policy, objective=objective, nature=nature,
            tolerance=tolerance)
    refuse_nature(nature)
    if is_traced((model, reward, target, policy)):
        raise ValueError("total_reward reads its model, so it works on concrete arrays only; "
                         "inside jit use prepare(model, target).")
    sparse = to_sparse(model)
    earned = _earned(model, sparse, reward)
    if (earned < 0).any():
        r = int(np.flatnonzero(earned < 0)[0])
        raise ValueError(
            f"the reward of a choice of state {sparse.host.state[r]} is {earned[r]:.6g}; expected "
            "total rewards need rewards of at least 0.")
    if target is not None:
        require_shape("target", target, model.state_shape)
        target = np.asarray(target, bool).ravel()
    asked = default_tolerance(model) if tolerance is None else float(tolerance)
    host, depth, maximize = sparse.host, 0, objective == "max"
    if policy is not None:
        chain = chain_of(model, sparse, policy)
        earned = chain.mean(earned, host.row_start)
        host, depth = chain.mdp, chain.depth
    if target is None:
        found = optimal.reward_forever(
            host, earned, maximize=maximize, tolerance=asked, depth=depth)
    else:
        found = optimal.total_reward(
            host, earned, target, maximize=maximize, tolerance=asked, depth=depth)
    return given_policy(
        solution_of(model, sparse, found, asked, relative=True), policy)


def _earned(model: Any, sparse: SparseMDP, reward: Any) -> np.ndarray:
    if is_sparse(model):
        return row_reward(sparse, reward)
    if reward is None or isinstance(reward, str | Rewards):
        raise ValueError(f"reward={reward!r}; only a SparseMDP has named rewards: give an array.")
    reward = np.asarray(reward, np.float64)
    states = model.state_shape
    if reward.shape == states:
        return reward.ravel()[sparse.host.state]
    require_shape("reward", reward, (*states, model.num_actions))
    flat = reward.reshape(sparse.num_states, -1)
    return flat[sparse.host.state, np.asarray(sparse.action)]
