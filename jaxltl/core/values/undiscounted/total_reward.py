"""Expected total reward until a target is reached, or for ever, with certified bounds."""

from __future__ import annotations

from dataclasses import replace

import chex
import jax
import numpy as np
from numpy.typing import NDArray

from jaxltl.core import validation
from jaxltl.core.models.game import Game
from jaxltl.core.models.ops.array_namespace import is_traced, to_jax
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.refusals import of_one_player
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.types import Solution, require_shape
from jaxltl.core.values.door.question import Accuracy, Question, TotalReward
from jaxltl.core.values.door.table import solve
from jaxltl.core.values.engine.host_solution import policy_chain
from jaxltl.core.values.engine.row_form import on_rows, row_form, rows_of
from jaxltl.core.values.engine.validated import validated

_SIX_DIGITS = 1e-6


@validated(games=True)
def total_reward(
    model: Model,
    reward: str | Rewards | chex.Array | None,
    target: chex.Array | str | None = None,
    *,
    policy: chex.Array | None = None,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    unreached: str = "infinite",
    tolerance: jax.Array | float | None = None,
    throw: bool = False,
) -> Solution:
    """Total expected reward until a target is reached, or for ever.

    The least solution of ``x = 0`` on the target, ``x = opt_a (r(s, a) + (P x)(s, a))`` elsewhere
    (Puterman 1994, chapter 7; Baier and Katoen 2008, section 10.5.1). It is infinite where the
    target is not reached almost surely: for ``"max"`` under some policy, for ``"min"`` under every
    policy; without a target, where reward is earned for ever. With ``unreached="sum"`` a run that never
    reaches the target is worth the sum of its rewards, and the value is infinite where reward is
    earned for ever; with ``unreached="zero"`` such a run is worth 0 (the semantics ``F``, ``Fc`` and
    ``F0`` of Chen, Forejt, Kwiatkowska, Parker and Simaitis 2013).

    Args:
      model: any model.
      reward: at least 0: ``float[S]`` or ``float[S, A]``, the reward of a step; of sparse models
        also as of :func:`~jaxltl.core.models.sparse.choice_reward`, of a ShardedMDP the name of one.
        Rewards of transitions must not differ within a row of intervals.
      target: ``bool[S]``, a label's name, or a Boolean formula of labels; required inside ``jit``, over
        a mesh; without one an interval model needs positive lower ends.
      unreached: the reward of a run that never reaches the target, ``"infinite"``, ``"sum"`` or ``"zero"``;
        the last two on the host, ``"sum"`` under intervals with positive lower ends, and ``"zero"`` without
        intervals and, as both in games, without a policy.
      policy, objective, nature, environment, throw: as of :func:`reachability_probability`.
      tolerance: relative width of the enclosure; default 1e-6 in double precision, 1e-3 in single.

    Returns:
      :class:`Solution`; `value` is ``float[S]``, infinite or 0 exactly where the graph decides. An
      optimum's `policy` attains its bound on the safe side: actions ``int32[S]``. Inside ``jit`` bad
      rewards give the status ``NONFINITE``, a bad policy ``INVALID``. Inside ``jit`` and over a mesh
      differentiable in the reward, the probabilities and the policy of padded models, where the value is
      finite; other models are solved on the host there too, without derivatives.

    Raises:
      ValueError: a shape, the objective or a policy is wrong, a reward is negative, or there is
        no target where one is required.

    Example:
      >>> from jaxltl import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> total_reward(coin, np.ones(2), np.array([False, True])).value.round(6).tolist()
      [2.0, 0.0]
    """
    validation.choice("unreached", unreached, ("infinite", "sum", "zero"))
    path = TotalReward(reward, target, unreached)
    question = Question(path, objective, nature, environment, policy)
    return solve(model, question, Accuracy(tolerance), throw=throw)


@of_one_player
def hitting_time(model: Model, policy: Array, target: Array) -> NDArray[np.float64]:
    """Expected number of steps of a policy until a set is reached, on the host.

    The total reward ``h = 1 + P_pi h`` where the set is reached almost surely, which the graph
    decides; infinite elsewhere, 0 in the set.

    Args:
      model: a concrete model.
      policy: as for :func:`total_reward`.
      target: ``bool[S]`` (``[S, Q]``).

    Returns:
      ``float64[S]``; NaN where six digits could not be certified. Concrete arrays only; not
      differentiable.

    Raises:
      ValueError: something is traced, or the policy is invalid.

    Example:
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[0.5, 0.5]], [[0.0, 1.0]]])
      >>> hitting_time(mdp, np.array([0, 0]), np.array([False, True])).tolist()
      [2.0, 0.0]
    """
    if is_traced((model, policy, target)):
        raise ValueError("hitting_time works on the host; call it outside jit and vmap.")
    form = row_form(model)
    chain = policy_chain(form.host, form.weights(policy))
    goal = form.states("target", target)
    enclosure = optimal.total_reward(
        chain.mdp,
        np.ones(chain.mdp.num_rows),
        goal,
        maximize=False,
        tolerance=_SIX_DIGITS / 100,
        depth=chain.depth,
    )
    with np.errstate(invalid="ignore"):
        narrow = enclosure.upper - enclosure.lower <= _SIX_DIGITS * enclosure.upper
    time = np.where(narrow | np.isinf(enclosure.value), enclosure.value, np.nan)
    return time.reshape(model.state_shape)


@validated(games=True)
def worst_case_steps(game: Game, goal: Array, strategy: Array) -> Solution:
    """Worst-case expected number of moves until a goal state ``bool[S]`` is entered next.

    ``x(s) = opt_a sum_t P(t | s, a) (1 + [t not in goal] x(t))``: the mean over the system's strategy
    ``float[S, A]``, which is normalised; elsewhere, also where that is 0, the maximum (the total
    reward of the environment's decision process, Puterman 1994, chapter 7).

    Returns a :class:`Solution`, infinite where some environment prevents the goal with positive
    probability. Concrete arrays only; not differentiable. Raises ValueError for a wrong shape.

    Example:
      >>> from jaxltl import from_dense, make_game
      >>> world = from_dense([[[0.5, 0.5], [0.75, 0.25]], [[0, 1.0], [0, 1.0]]])
      >>> game = make_game(world, [False, True])  # the environment moves in the first state
      >>> worst_case_steps(game, [False, True], np.full((2, 2), 0.5)).value.round(6).tolist()
      [4.0, 1.0]
    """
    goal, table, size = np.asarray(goal), np.asarray(strategy, float), game.num_states
    require_shape("goal", goal, (size,))
    require_shape("strategy", table, (size, game.num_actions))
    sparse = rows_of(game.mdp)
    host = sparse.host
    # Goal states are entered as a state of their own.
    target = np.append(np.where(goal[host.successor], size, host.successor), size)
    model = make_sparse(
        np.append(host.row_start, host.num_rows + 1),
        np.append(host.entry_start, target.size),
        target,
        np.append(host.probability, 1.0),
    )
    total = table.sum(-1, keepdims=True)
    moves = to_jax(np.append(np.asarray(game.system) & (total[:, 0] > 0), False))
    weight = np.append(on_rows(sparse, table / np.where(total > 0, total, 1)), 1.0)
    cost, end = np.ones(weight.size), np.arange(size + 1) == size
    solution = total_reward(Game(model, moves), cost, end, policy=weight, objective="min")
    return replace(
        solution,
        value=solution.value[:size],
        lower=solution.lower[:size],
        upper=solution.upper[:size],
        policy=to_jax(table),
        nature=None,
    )
