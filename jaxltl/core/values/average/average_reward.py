"""Long-run average rewards of every kind of model."""

from __future__ import annotations

from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import Reward
from jaxltl.core.types import Solution
from jaxltl.core.values.door.question import Accuracy, AverageReward, Question
from jaxltl.core.values.door.table import solve
from jaxltl.core.values.engine.validated import validated


@validated(games=True)
def average_reward(
    model: Model,
    reward: Reward,
    *,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    policy: Array | None = None,
    tolerance: float | None = None,
    max_steps: int | None = None,
    throw: bool = False,
) -> Solution:
    """Expected long-run average reward per step, ``lim 1/n E[r_1 + ... + r_n]``: optimal, or of a policy.

    For multichain models too (Puterman 1994, chapter 9): the best expected gain of the end
    component in which a trajectory ends. Gains are enclosed by the span of ``T v - v`` and are the
    terminal rewards of an optimal stopping problem. In games and interval models the optimum of each
    side against a strategy of the other one is such a problem, and bounds the value; strategies are
    those for discounts near 1 (Blackwell 1962). :func:`mean_payoff` is exact, for deterministic games.

    Args:
      model: any concrete model. In a game the environment has the opposite objective.
      reward: ``float[S]`` or ``float[S, A]``, and of sparse models as of
        :func:`~jaxltl.core.models.sparse.choice_reward`; finite.
      objective, nature, environment, policy, throw: as of :func:`reachability_probability`.
      tolerance: default 1e-6; width of the enclosure, relative to the value; for small values relative to a
        millionth of the largest reward (a thousandth, if some are negative).
      max_steps: sweeps of value iteration at most; default 10^6.

    Returns:
      :class:`Solution`; `value` is ``float64`` in the shape of the states. `policy` attains the bound on
      the safe side (`lower` of a maximum), for both players of a game and with `nature` of interval
      models: actions ``int32[S]``. `residual` is half the width of the gain's
      widest enclosure. PRECISION where bounds are valid and wider than the tolerance. Solved on the
      host, inside ``jit`` too; not differentiable.

    Raises:
      ValueError: the reward, the objective, the policy, or `nature` of a model without intervals.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 2, 3, 4, 5], [1, 2, 0, 1, 2],
      ...                     [0.25, 0.75, 1, 1, 1])
      >>> found = average_reward(model, [3.0, 8.0, 4.0])
      >>> found.value.round(9).tolist(), found.policy.tolist()
      ([5.0, 8.0, 4.0], [0, 0, 0])
    """
    question = Question(AverageReward(reward), objective, nature, environment, policy)
    return solve(model, question, Accuracy(tolerance), throw=throw, max_steps=max_steps)
