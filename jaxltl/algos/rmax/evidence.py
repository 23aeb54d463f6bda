"""Certificates of strategies that R-max has learned: in the true game, and from counts alone."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.algos.common import pac
from jaxltl.algos.rmax.learner import policy
from jaxltl.algos.rmax.problem import Hparams, Problem, State, reward_error
from jaxltl.core import struct
from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.models import Game, Rewards, interval_rows, restrict
from jaxltl.core.models.protocols import Array
from jaxltl.core.sparse.rows import offsets_from_counts
from jaxltl.core.statistics.confidence_sets import Method, intervals_from_counts
from jaxltl.core.types import Solution
from jaxltl.core.values import minimax_value, optimal_value, policy_value, strategy_value
from jaxltl.core.values.undiscounted.total_reward import worst_case_steps


@struct.dataclass
class DataEvidence:
    """Bounds that hold simultaneously with a confidence; NaN outside of the region.

    Attributes:
      secured: ``float64[S]``, lower bound of the strategy's worst-case value.
      optimal: ``float64[S]``, upper bound of the value of any strategy in the region.
      confidence: probability over the data that all bounds hold.
      num_samples: observed transitions.
    """

    secured: NDArray[np.float64]
    optimal: NDArray[np.float64]
    confidence: float = struct.field(pytree_node=False)
    num_samples: int = struct.field(pytree_node=False)


@struct.dataclass
class Evidence:
    """Certificates of a strategy in the true game; made by :func:`evidence`.

    Attributes:
      strategy: ``float[S, A]``, of the system.
      almost_sure: ``bool[]``, True if it wins almost surely from every state of the region.
      optimal: the optimal worst-case value of strategies in the region.
      worst_case, played: the value of this strategy against every environment, and against that of the
        problem.
      epsilon_optimal, epsilon_optimal_played: ``bool[S]``, states in which `worst_case` or `played` is
        certified to be within epsilon of `optimal`. Theorem 6 promises the second only: actions that
        the environment never takes stay unknown.
      reachable: ``bool[S]``, states of the region reachable from the initial ones.
      known_at: ``int32[S, A]``, of :class:`~jaxltl.algos.rmax.State`.
      steps: worst-case expected moves until an accepting state is entered next, in the region.
      data: the guarantee by the counts alone, or None.
    """

    strategy: jax.Array
    almost_sure: jax.Array
    optimal: Solution
    worst_case: Solution
    played: Solution
    epsilon_optimal: jax.Array
    epsilon_optimal_played: jax.Array
    reachable: jax.Array
    known_at: jax.Array
    steps: Solution
    data: DataEvidence | None = None


def evidence(
    state: State, problem: Problem, hparams: Hparams, *, confidence: float | None = None
) -> Evidence:
    """The :class:`Evidence` of a learned strategy in the true game; on the host.

    Of the `state`, `problem` and `hparams` of one run; `confidence`, in (0, 1), of ``Evidence.data``, or
    None without it.

    Raises:
      ValueError: a reward outside of [0, R_max] was observed, which voids every guarantee.
    """
    fault, game = int(state.fault), problem.game
    if fault >= 0:
        s, a = divmod(fault, game.num_actions)
        raise reward_error(s, a, float(jnp.max(problem.reward[s, a])), hparams)
    strategy = policy(state, problem, hparams)
    inside = Game(game.mdp.replace(available=problem.allowed), game.system)
    value = partial(strategy_value, inside, strategy, problem.reward, hparams.discount)
    worst_case, played = value(), value(environment=problem.environment)
    optimal = minimax_value(game, problem.reward, hparams.discount, allowed=problem.allowed)
    epsilon_optimal = partial(pac.epsilon_optimal_states, optimal, epsilon=hparams.epsilon)
    reached = restrict(game, problem.initial, allowed=problem.allowed).base_state
    data = None
    if confidence is not None:
        data = data_evidence(
            problem, state.counts, strategy, float(hparams.discount), confidence=confidence
        )
    return Evidence(
        strategy=strategy,
        almost_sure=wins_almost_surely(problem, strategy),
        optimal=optimal,
        worst_case=worst_case,
        played=played,
        epsilon_optimal=epsilon_optimal(worst_case) & problem.region,
        epsilon_optimal_played=epsilon_optimal(played) & problem.region,
        reachable=jnp.zeros(game.num_states, bool).at[reached].set(True),
        known_at=state.known_at,
        steps=worst_case_steps(game, problem.accepting, strategy),
        data=data,
    )


@jax.jit
def wins_almost_surely(problem: Problem, strategy: jax.Array) -> jax.Array:
    """``True`` if a memoryless `strategy` wins almost surely from every state of the region.

    Qualitative, by the graph of the `problem` and the support of the strategy, ``float[S, A]``: it
    never leaves the region, and from each state an accepting one is reached with positive
    probability against every environment, hence infinitely often almost surely.
    """
    game = problem.game
    used = jnp.where(game.system[:, None], strategy > 0, problem.allowed)
    moves = problem.region & used.any(-1)
    stays = jnp.all(~used | problem.allowed)
    accepting = problem.accepting & problem.region
    reached = attractor(
        game, accepting, used & problem.allowed, rule=game.system, chance="some"
    ).region
    return stays & jnp.all(moves | ~problem.region) & jnp.all(reached | ~problem.region)


def data_evidence(
    problem: Problem,
    counts: ArrayLike,
    strategy: ArrayLike,
    discount: float,
    *,
    confidence: float,
    method: Method = "anytime",
) -> DataEvidence:
    """The :class:`DataEvidence` of transition counts, for a strategy and the optimum.

    Discounted values that `counts`, ``int[S, A, K]``, guarantee, if the graph and the rewards of
    transitions are known; the probabilities in `problem` are not read. The `strategy` of the system is
    ``float[S, A]``, and `discount` in ``[0, 1)``. `confidence` and `method` are those of
    :func:`~jaxltl.core.statistics.confidence_sets.intervals_from_counts`.
    """
    region, mdp = np.asarray(problem.region), problem.game.mdp
    state = np.flatnonzero(region)
    number = np.zeros(region.size, np.int64)
    number[state] = np.arange(state.size)
    moves = np.asarray(problem.allowed) & region[:, None]
    used = moves[..., None] & (np.asarray(mdp.probability) > 0)
    s, a = np.nonzero(moves)
    start = offsets_from_counts(used.sum(-1)[s, a])
    reward = np.asarray(problem.reward, np.float64)
    earned = np.broadcast_to(reward[..., None] if reward.ndim == 2 else reward, used.shape)
    count = np.asarray(counts)[used]
    sets = intervals_from_counts(count, confidence, method=method, entry_start=start)
    model = interval_rows(
        offsets_from_counts(moves.sum(-1)[state]),
        start,
        number[np.asarray(mdp.successor)[used]],
        sets.lower,
        sets.upper,
        center=None if sets.radius is None else sets.center,
        radius=sets.radius,
        rewards={"reward": Rewards(transition=earned[used])},
    )
    system: Array = np.asarray(problem.game.system)[state]
    within = Game(model, system)
    weight = np.asarray(strategy, np.float64)[s, a]
    secured = policy_value(within, weight, "reward", discount, nature="adversarial")
    optimal = optimal_value(within, "reward", discount, nature="cooperative")
    bounds = np.full((2, region.size), np.nan)
    bounds[0, state], bounds[1, state] = secured.lower, optimal.upper
    return DataEvidence(bounds[0], bounds[1], float(confidence), int(count.sum()))
