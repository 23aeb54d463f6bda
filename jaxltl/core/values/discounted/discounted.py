"""Optimal discounted values and discounted values of policies, of every kind of model."""

from __future__ import annotations

import jax

from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import Reward
from jaxltl.core.types import Solution
from jaxltl.core.values.discounted.compiled import (
    action_value as action_value,
    expected_reward as expected_reward,
)
from jaxltl.core.values.door.question import Accuracy, DiscountedReward, Question
from jaxltl.core.values.door.table import solve
from jaxltl.core.values.engine.validated import validated

_METHODS = ("auto", "policy_iteration", "modified_policy_iteration", "value_iteration")


@validated(games=True, method=_METHODS)
def optimal_value(
    model: Model,
    reward: Reward,
    discount: jax.Array | float,
    *,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    method: str = "auto",
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int | None = None,
    evaluation_sweeps: jax.Array | int | None = None,
    throw: bool = False,
) -> Solution:
    """Largest or least expected discounted reward, ``V = opt_a R + discount * P V``.

    Certified by MacQueen's bounds. In a game the environment has the opposite objective; interval models
    and concrete games are solved by policy iteration on rows (Iyengar 2005; Hoffman and Karp 1966).

    Args:
      model: any model.
      reward: ``float[S]`` or ``float[S, A]``; of a padded model ``float[S, A, K]``; of a sparse model a name or as of
        :func:`~jaxltl.core.models.sparse.choice_reward`.
      discount: scalar in [0, 1).
      objective: ``"max"`` or ``"min"``, of the system.
      nature: of an IntervalMDP, ``"adversarial"`` (default) or ``"cooperative"``.
      environment: of a game, ``"adversarial"`` (default) or ``"cooperative"``.
      method: ``"policy_iteration"`` (Howard 1960, its systems solved to a hundredth),
        ``"modified_policy_iteration"`` (Puterman and Shin 1978: after each sweep of the
        optimality operator, `evaluation_sweeps` cheap ones under the greedy policy),
        ``"value_iteration"``, or ``"auto"``, the first up to 512 states, then the second.
      tolerance: width of the enclosure; default: as narrow as the dtype allows.
      max_steps: applications of the optimality or the linear operator at most; default 100,000.
      evaluation_sweeps: sweeps under a fixed policy, in modified policy iteration; default 24.
        Concrete sparse models are solved on the host, by policy iteration, unless `method`,
        `max_steps` or this is given.
      throw: raise NotConverged unless the solution converged; outside ``jit``.

    Returns:
      :class:`Solution`; `value` is ``float[S]``, `policy` ``int32[S]`` is greedy, with a value of
      at least `lower`. Differentiable in the reward, the discount and the probabilities, wherever
      the greedy policy is unique.

    Raises:
      ValueError: the reward has the wrong shape, or an unknown method.

    Example:
      >>> import jax.numpy as jnp
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 1.0]]])
      >>> best = optimal_value(mdp, jnp.array([[0.0, 0.0], [1.0, 1.0]]), 0.5)
      >>> [round(v, 4) for v in best.value.tolist()], best.policy.tolist()
      ([1.0, 2.0], [1, 0])
    """
    question = Question(DiscountedReward(reward, discount), objective, nature, environment)
    return solve(
        model,
        question,
        Accuracy(tolerance),
        throw=throw,
        method=None if method == "auto" else method,
        max_steps=max_steps,
        evaluation_sweeps=evaluation_sweeps,
    )


@validated(games=True)
def policy_value(
    model: Model,
    policy: Array,
    reward: Reward,
    discount: jax.Array | float,
    *,
    nature: str | None = None,
    environment: str | None = None,
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int | None = None,
    throw: bool = False,
) -> Solution:
    """Expected discounted reward of a policy, of a game in the worst case of the environment.

    ``V = r_pi + discount * P_pi V`` (dissertation, section 2.2.1). Solved by BiCGSTAB; where it
    stalls, by elimination on small models and by sweeps on others.

    Args:
      model, reward, discount, nature, environment, tolerance, throw: as in :func:`optimal_value`.
      policy: ``float[S, A]`` or ``int32[S]``.
      max_steps: sweeps at most; default 100,000. Concrete sparse models are solved on the host,
        without sweeps, unless it is given.

    Returns:
      :class:`Solution`; `value` is ``float[S]``. Differentiable in the policy, the reward, the
      discount and the probabilities.

    Raises:
      ValueError: policy or reward has the wrong shape, or a row of the policy is not a distribution
        over available actions (under ``jit``: the status INVALID).

    Example:
      >>> import jax.numpy as jnp
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[1.0]]])
      >>> round(policy_value(mdp, jnp.array([0]), jnp.ones((1, 1)), 0.5).value.item(), 4)
      2.0
    """
    question = Question(DiscountedReward(reward, discount), "max", nature, environment, policy)
    return solve(model, question, Accuracy(tolerance), throw=throw, max_steps=max_steps)
