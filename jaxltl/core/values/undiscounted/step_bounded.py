"""Step-bounded and reward-bounded probabilities and rewards, of concrete models.

Solved in double precision; bounds include all rounding.
"""

from __future__ import annotations

from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import Reward
from jaxltl.core.types import Solution
from jaxltl.core.values.door.question import (
    Accuracy,
    NextStep,
    Question,
    ReachAtCost,
    ReachWithin,
    RewardAfterSteps,
    RewardOfSteps,
)
from jaxltl.core.values.door.table import solve
from jaxltl.core.values.engine.validated import validated


@validated(games=True)
def next_probability(
    model: Model,
    target: Array | str,
    *,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    policy: Array | None = None,
) -> Solution:
    """Probability that the next state is in a set: ``opt_a P(target | s, a)``.

    Args:
      model, target, objective, nature, environment, policy: as for :func:`bounded_reachability`.

    Returns:
      :class:`Solution`, as of :func:`bounded_reachability`. Solved on the host, inside ``jit`` too; not
      differentiable.

    Raises:
      ValueError: the shape of the target, the objective, the policy, or `nature` of a model without
        intervals.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3], [0, 2, 3, 4], [0, 1, 0, 1], [0.75, 0.25, 1, 1])
      >>> found = next_probability(model, [False, True])
      >>> found.value.tolist(), found.policy.tolist()
      ([0.25, 1.0], [0, 0])
    """
    question = Question(NextStep(target), objective, nature, environment, policy)
    return solve(model, question, Accuracy())


@validated(games=True)
def bounded_reachability(
    model: Model,
    target: Array | str,
    num_steps: int,
    *,
    stay: Array | str | None = None,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    policy: Array | None = None,
    by_step: bool = False,
) -> Solution:
    """Step-bounded reachability probability, within n steps through the states of `stay`.

    ``x_0 = [s in target]``, and ``x_{k+1}(s) = 1`` in the target, ``opt_a (P x_k)(s, a)`` in
    `stay`, else 0 (Baier and Katoen 2008, section 10.1.1); in models with intervals nature picks P
    anew in each step (Givan, Leach and Dean 2000). For large n the iteration ends once the effect of
    further steps is bounded.

    Args:
      model: any concrete model. In a game the environment has the opposite objective.
      target: ``bool[S]``, a label's name, or a Boolean formula of labels.
      num_steps: n.
      stay: in the same forms, what must hold before the target is reached; default everywhere.
      objective: ``"max"`` or ``"min"``, of the system; irrelevant for chains.
      nature: of models with intervals: ``"adversarial"`` (default), against the objective, or
        ``"cooperative"``.
      environment: of games, in the same words.
      policy: evaluate this policy, of a game the system's: actions ``int32[S]`` or ``float[S, A]``, of
        sparse models also weights of rows ``float[R]``. Default: optimise.
      by_step: return the choices of all steps.

    Returns:
      :class:`Solution`; `value` is ``float64`` in the shape of the states, exactly 0 or 1 where the
      graph decides. `policy` is the first action of each state;
      with `by_step` the choices of all steps in order, with an axis ``[n]`` in front. `num_steps` is
      the number of computed steps, `nature` has the distributions of the first step. Solved on the host,
      inside ``jit`` too; not differentiable.

    Raises:
      ValueError: a shape, the objective, a negative number of steps, the policy, or `nature` of a
        model without intervals.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> bounded_reachability(model, [False, True], 3).value.tolist()
      [0.875, 1.0]
    """
    question = Question(
        ReachWithin(target, num_steps, stay), objective, nature, environment, policy
    )
    return solve(model, question, Accuracy(), by_step=by_step or None)


@validated(games=True)
def cumulative_reward(
    model: Model,
    reward: Reward,
    num_steps: int,
    *,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    policy: Array | None = None,
    by_step: bool = False,
) -> Solution:
    """Expected reward of the next n steps.

    ``x_{k+1}(s) = opt_a r(s, a) + (P x_k)(s, a)`` from ``x_0 = 0`` (Puterman 1994, section 4.3).

    Args:
      model, num_steps, objective, nature, environment, policy, by_step: as for :func:`bounded_reachability`.
      reward: as for :func:`~jaxltl.core.models.sparse.choice_reward`; finite, of any sign.

    Returns:
      :class:`Solution`, as of :func:`bounded_reachability`. Solved on the host, inside ``jit`` too; not
      differentiable.

    Raises:
      ValueError: the reward, or as for :func:`bounded_reachability`.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> cumulative_reward(model, [1.0, 0.0], 3).value.tolist()
      [1.75, 0.0]
    """
    question = Question(RewardOfSteps(reward, num_steps), objective, nature, environment, policy)
    return solve(model, question, Accuracy(), by_step=by_step or None)


@validated(games=True)
def instantaneous_reward(
    model: Model,
    reward: Reward,
    num_step: int,
    *,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    policy: Array | None = None,
    by_step: bool = False,
) -> Solution:
    """Expected reward of the state after n steps.

    ``x_{k+1}(s) = opt_a (P x_k)(s, a)`` from the rewards of states ``x_0 = r``.

    Args:
      model, objective, nature, environment, policy, by_step: as for :func:`bounded_reachability`.
      reward: the name of a reward, a structure, of which only the rewards of states count, or an
        array ``[S]``. None is the only reward of the model.
      num_step: n.

    Returns:
      :class:`Solution`, as of :func:`bounded_reachability`. Solved on the host, inside ``jit`` too; not
      differentiable.

    Raises:
      ValueError: the reward has no part on states, or as for :func:`bounded_reachability`.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> instantaneous_reward(model, [1.0, 0.0], 3).value.tolist()
      [0.125, 0.0]
    """
    question = Question(RewardAfterSteps(reward, num_step), objective, nature, environment, policy)
    return solve(model, question, Accuracy(), by_step=by_step or None)


@validated(games=True)
def reward_bounded_reachability(
    model: Model,
    target: Array | str,
    reward: Reward,
    bound: float,
    *,
    stay: Array | str | None = None,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    policy: Array | None = None,
    by_level: bool = False,
) -> Solution:
    """Probability of reaching a set before more than a bound of reward is earned.

    With l units left, ``x_l(s) = 1`` in the target, and the least solution of
    ``x_l(s) = opt_a sum_t P(t | s, a) x_{l - c(s, a, t)}(t)`` elsewhere, zero below level 0
    (Andova, Hermanns and Katoen 2003). Rewards in the target do not count.

    Args:
      model, target, stay, objective, nature, environment, policy: as for :func:`bounded_reachability`.
      reward: as for :func:`~jaxltl.core.models.sparse.choice_reward`, not negative, multiples of one
        unit; numbers are read as the simplest fractions that round to them.
      bound: the largest reward.
      by_level: return the choices for all amounts left.

    Returns:
      :class:`Solution`, as of :func:`bounded_reachability`; with `by_level`, row l of the policy has
      the choices with l units left, ``[L + 1]`` in front. `num_steps` is the number of levels, L + 1.
      Games and models with intervals are unfolded over the levels. Solved on the host, inside ``jit`` too; not
      differentiable.

    Raises:
      ValueError: a negative reward, rewards without a common unit of which the bound has at most
        10^7, a game or a model with intervals that is too large on all levels, or as for
        :func:`bounded_reachability`.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> reward_bounded_reachability(model, [False, True], [0.1, 0], 0.3).value.tolist()
      [0.875, 1.0]
    """
    question = Question(
        ReachAtCost(target, reward, bound, stay), objective, nature, environment, policy
    )
    return solve(model, question, Accuracy(), by_level=by_level or None)
