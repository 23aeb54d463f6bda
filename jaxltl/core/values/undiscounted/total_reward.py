"""Expected total reward until a target is reached, or for ever, with certified bounds."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import chex
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Floats
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.mdp import MDP, DenseMDP
from jaxltl.core.models.mesh.sharded import ShardedMDP, is_sharded
from jaxltl.core.models.refusals import of_one_player
from jaxltl.core.models.ops.array_namespace import jit, is_traced, to_jax
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import ActionModel, Array, Model
from jaxltl.core.models.sparse import Reward, Rewards, SparseMDP, choice_reward, make_sparse
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.types import Solution, require_shape, require_states
from jaxltl.core.values.engine.host_solution import (
    induced_chain,
    default_tolerance,
    with_given_policy,
    is_sparse,
    solution_from_enclosure,
)
from jaxltl.core.values.engine.state_quantities import row_reward
from jaxltl.core.values.engine.validated import validated
from jaxltl.core.values.interval.robust import refuse_nature, robust_total_reward
from jaxltl.core.values.undiscounted.reachability import on_rows, rows_of_model
from jaxltl.core.values.undiscounted.traced_total_reward import total_reward_by_sweeps


_SIX_DIGITS = 1e-6
World = MDP | DenseMDP | ShardedMDP


@validated()
def total_reward(
    model: Model,
    reward: str | Rewards | chex.Array | None,
    target: chex.Array | None = None,
    *,
    policy: chex.Array | None = None,
    objective: str = "max",
    nature: str | None = None,
    tolerance: jax.Array | float | None = None,
) -> Solution:
    """Total expected reward until a target is reached, or for ever.

    The least solution of ``x = 0`` on the target, ``x = opt_a (r(s, a) + (P x)(s, a))`` elsewhere
    (Puterman 1994, chapter 7; Baier and Katoen 2008, section 10.5.1). It is infinite where the
    target is not reached almost surely: for ``"max"`` under some policy, for ``"min"`` under every
    policy; without a target, where reward is earned for ever.

    Args:
      model: an MDP, DenseMDP, SparseMDP or product of one, or an IntervalMDP; inside ``jit`` an
        MDP, DenseMDP, ShardedMDP or product of one.
      reward: at least 0. For a sparse model as of
        :func:`~jaxltl.core.models.sparse.choice_reward`; else ``float[S]`` or ``float[S, A]``, the
        reward of a step, or of a ShardedMDP the name of one.
      target: ``bool[S]``; required inside ``jit`` and over a mesh.
      policy: evaluate this policy; default: optimise.
      objective: ``"max"`` or ``"min"``; ignored when a policy is given.
      nature: for interval models only, see :func:`robust_total_reward`.
      tolerance: relative width of the enclosure; default 1e-6 in double precision, 1e-3 in single.

    Returns:
      :class:`Solution`; `value` is ``float[S]``, infinite or 0 exactly where the graph decides. An
      optimum's `policy` attains its bound on the safe side: ``int32[S]``, rows of a sparse model,
      else actions. Inside ``jit`` bad rewards give the status ``NONFINITE``, a bad policy
      ``INVALID``. Inside ``jit`` and over a mesh differentiable in the reward, the probabilities
      and the policy, where the value is finite.

    Raises:
      ValueError: a shape, the objective or a policy is wrong, a reward is negative, or inside
        ``jit`` the model is sparse or there is no target.

    Example:
      >>> from jaxltl import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> total_reward(coin, np.ones(2), np.array([False, True])).value.round(6).tolist()
      [2.0, 0.0]
    """
    if isinstance(model, IntervalMDP):
        if target is None:
            raise ValueError("total rewards of interval models need a target; give one.")
        return robust_total_reward(
            model,
            reward,
            target,
            policy=policy,
            objective=objective,
            nature=nature,
            tolerance=tolerance,
        )
    refuse_nature(nature)
    if is_sharded(model) or is_traced((model, reward, target, policy, tolerance)):
        return _by_sweeps(model, reward, target, policy, objective, tolerance)
    sparse = to_sparse(model)
    earned = _earned(model, sparse, reward)
    if not (earned >= 0).all():  # or NaN
        r = int(np.flatnonzero(~(earned >= 0))[0])
        raise _negative(sparse.host.state[r], earned[r])
    if target is not None:
        require_states("target", target, model.state_shape)
        target = np.asarray(target, bool).ravel()
    requested = default_tolerance(model) if tolerance is None else float(tolerance)
    host, depth, maximize = sparse.host, 0, objective == "max"
    if policy is not None:
        chain = induced_chain(model, sparse, policy)
        earned = chain.mean(earned, host.row_start)
        host, depth = chain.mdp, chain.depth
    if target is None:
        enclosure = optimal.reward_forever(
            host, earned, maximize=maximize, tolerance=requested, depth=depth
        )
    else:
        enclosure = optimal.total_reward(
            host, earned, target, maximize=maximize, tolerance=requested, depth=depth
        )
    return with_given_policy(
        solution_from_enclosure(model, sparse, enclosure, requested, relative=True), policy
    )


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
    require_states("target", target, model.state_shape)
    chain = induced_chain(model, to_sparse(model), policy)
    goal = np.asarray(target, bool).ravel()
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


def _earned(model: Model, sparse: SparseMDP, reward: Reward) -> Floats:
    if not is_sparse(model) and (reward is None or isinstance(reward, str | Rewards)):
        raise ValueError(f"reward={reward!r}; only a SparseMDP has named rewards: give an array.")
    return choice_reward(sparse, row_reward(model, sparse, reward))


# --- inside jit and over a mesh -------------------------------------------------------------------


def _by_sweeps(
    model: Model,
    reward: Reward,
    target: Array | None,
    policy: Array | None,
    objective: str,
    tolerance: Array | float | None,
) -> Solution:
    world = model.mdp if isinstance(model, Product) else model
    if not isinstance(world, MDP | DenseMDP | ShardedMDP):
        raise ValueError(
            f"inside jit, or over a mesh, total_reward needs an MDP, a DenseMDP, a ShardedMDP or a "
            f"product of one, not {type(world).__name__}; inside jit use prepare(model, target)."
        )
    if target is None:
        raise ValueError(
            "total rewards for ever are found on the host; inside jit, or over a mesh, give a "
            "target."
        )
    require_states("target", target, model.state_shape)
    padded = cast(ActionModel, model)
    earned = _on_choices(padded, world, reward)
    _require_rewards(padded, world, earned)
    requested = default_tolerance(model) if tolerance is None else tolerance
    return total_reward_by_sweeps(padded, earned, target, policy, requested, objective=objective)


def _on_choices(model: ActionModel, world: World, reward: Reward) -> Array:
    """A reward as one on actions: ``float[S, A]``."""
    actions = (*model.state_shape, model.num_actions)
    if reward is None or isinstance(reward, str | Rewards):
        named = world.rewards if isinstance(world, ShardedMDP) else {}
        if reward not in named:
            known = f"; it has {', '.join(named)}" if named else ": give an array"
            raise ValueError(
                f"reward={reward!r} is no reward of this {type(world).__name__}{known}."
            )
        earned = named[reward]
        return earned if world is model else jnp.broadcast_to(earned[:, None], actions)
    if np.shape(reward) == model.state_shape:
        return jnp.broadcast_to(jnp.asarray(reward)[..., None], actions)
    require_shape("reward", reward, actions)
    return reward


def _require_rewards(model: ActionModel, world: World, reward: Array) -> None:
    least, state = _least_reward(model, world, reward)
    # Inside jit the status is NONFINITE.
    if not isinstance(least, jax.core.Tracer) and not least >= 0:
        raise _negative(state, least)


def _negative(state: Array | int, reward: Array | float) -> ValueError:
    return ValueError(
        f"the reward of a choice of state {state} is {reward:.6g}; expected total rewards need "
        "rewards of at least 0."
    )


@jit()
def _least_reward(model: ActionModel, world: World, reward: Array) -> tuple[jax.Array, jax.Array]:
    """The least reward of an available action, and its state; NaN if one is NaN."""
    least = jnp.min(jnp.where(model.available, reward, jnp.inf), axis=-1)
    least = least.reshape(world.num_states, -1).min(-1)
    if isinstance(world, ShardedMDP):
        least = jnp.where(world.number >= 0, least, jnp.inf)
        number = world.number
    else:
        number = jnp.arange(world.num_states)
    return jnp.min(least), number[jnp.argmin(least)]


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
    host = rows_of_model(game).host
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
    weight = np.append(on_rows(rows_of_model(game), table / np.where(total > 0, total, 1)), 1.0)
    cost, end = np.ones(weight.size), np.arange(size + 1) == size
    solution = robust_total_reward(Game(model, moves), cost, end, policy=weight, objective="min")
    return replace(
        solution,
        value=solution.value[:size],
        lower=solution.lower[:size],
        upper=solution.upper[:size],
        policy=to_jax(table),
        nature=None,
    )
