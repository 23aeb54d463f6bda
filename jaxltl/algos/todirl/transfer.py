"""Rewards learned in training worlds and evaluated in test worlds, under a guarantee in each of them.

A required probability is attained in each world by the mixture of the learned reward's policy with the
least share of one of optimal actions, for the reward of most likelihood over some weights of the
probability (2.6).

Example: a reward learned in one world, evaluated there and in another one.
  >>> import numpy as np, jaxltl as jl
  >>> from jaxltl.algos import todirl
  >>> maps = "s . g", ". s g"
  >>> mdps = [jl.gridworld(x, legend={"s": [], ".": [], "g": ["g"]}) for x in maps]
  >>> seen = [np.asarray(mdp.label, float) for mdp in mdps]
  >>> task = jl.to_automaton("F g")
  >>> worlds = todirl.make_worlds(mdps, seen, task, names=["train", "test"], num_training=1)
  >>> shown = jl.make_trajectories(mdps[0], [[(0, 3), (1, 3)]])
  >>> demands = todirl.make_demands(worlds, [shown], "best")
  >>> learned = todirl.train_in_worlds(
  ...     demands, todirl.Hparams(discount=0.9), network=todirl.RewardNetwork(()), num_steps=2)
  >>> learned.performance["learned"].mean.round(6).tolist()
  [1.0, 1.0]
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.algos.common.chunks import ChunkOptions
from jaxltl.algos.common.guarantees import (
    StepBound,
    is_weighable,
    neg_log_likelihood,
)
from jaxltl.algos.common.learner import has_stopped
from jaxltl.algos.common.networks import NetworkLike
from jaxltl.algos.common.seeds import ONE_SEED, Training, one_seed, run_seeds
from jaxltl.algos.todirl import learner
from jaxltl.algos.todirl.learner import Hparams, Problem, RewardNetwork
from jaxltl.core.array_types import PyTree
from jaxltl.core.models import (
    Product,
    lift_memory_policy,
    stack_products,
)
from jaxltl.core.values import (
    Performance,
    task_performances,
)
from jaxltl.core.values.undiscounted.mixture import (
    WINDOW,
    Mixture,
    attained,
    reaching,
)
from jaxltl.core.values.undiscounted.performance import step_bounded_performances
from jaxltl.core.values.undiscounted.satisfaction_steps import StepAnalysis

from jaxltl.algos.todirl.worlds import WorldDemands, Worlds, part_of

_BATCH = 64  # worlds in a batch of planning
_AIM = WINDOW / 4  # margin of the certified probability over the required one
_WEIGHTS = 10.0 ** np.arange(-1, 5.5, 0.5)  # of the satisfaction probability, in this order
_HALVINGS = 5  # few bisections of the weight, since the mixture closes the gap


@dataclass(frozen=True)
class LearnedRewards:
    """Reward networks of N seeds.

    Attributes:
      parameters: of the network, leading axis N.
      held_out: ``float[N]``, negative log-likelihood of the average held-out pair.
      best_step: ``int[N]``, after which the parameters were reached.
      stopped: ``bool[N]``, whether learning ended by patience.
      num_steps: until all seeds ended.
      history: metrics ``[T, N]`` and step ``[T]``.
      weight: mu, if a probability is required.
    """

    parameters: PyTree
    held_out: np.ndarray
    best_step: np.ndarray
    stopped: np.ndarray
    num_steps: int
    history: Mapping[str, np.ndarray]
    weight: float | None = None

    @property
    def best_seed(self) -> int:
        """The seed of greatest held-out likelihood, or of least loss."""
        last = self.history["loss"][-1]
        score = np.where(np.isfinite(self.held_out), self.held_out, np.inf)
        loss = np.where(np.isfinite(last), last, np.inf)
        return int(np.argmin(score if np.isfinite(score).any() else loss))


@dataclass(frozen=True)
class TransferredReward:
    """Reward networks of all seeds, and the policies of the kept one in all worlds.

    Attributes:
      learned: the rewards.
      chosen: index of the kept seed, by held-out likelihood or loss.
      policy: ``float[W, S, Q, A]`` with the learner's memory, of the kept seed; with a horizon
        ``[W, T, S, Q, A]``.
      status: ``int32[W]``, of its solver.
      performance: satisfaction probabilities of the learned and the random policy and of the
        references, leading axis W.
      seeds: ``float[N, W]``, mean satisfaction probability of each seed.
      share, attained: ``float[W]``, share of optimal actions and certified probability, if one is
        required.
      steps, quick_share: ``float[W, 3]``, expected steps with bounds, and ``float[W]``, the share of the
        quickest policy, if steps are bounded.
    """

    learned: LearnedRewards
    chosen: int
    policy: np.ndarray
    status: np.ndarray
    performance: dict[str, Performance]
    seeds: np.ndarray
    share: np.ndarray | None = None
    attained: np.ndarray | None = None
    steps: np.ndarray | None = None
    quick_share: np.ndarray | None = None


def train_in_worlds(
    demands: WorldDemands,
    hparams: Hparams,
    training: Training = ONE_SEED,
    *,
    network: RewardNetwork | None = None,
    num_steps: int = 300,
    held_out: float = 0.2,
    references: Mapping[str, jax.Array] | None = None,
) -> TransferredReward:
    """Rewards learned in the training worlds with N seeds, of which one is evaluated in all worlds.

    The seed is kept without looking at test worlds.

    Args:
      demands: worlds, demonstrations and guarantee, of :func:`make_demands`.
      hparams: of the learner.
      training: seeds, reports and checkpoint; default one seed.
      network: the reward; default :class:`~jaxltl.algos.todirl.RewardNetwork`.
      num_steps: largest number of steps.
      held_out: share of the demonstrations that is held out.
      references: other policies of the products with memory and formula by name.

    Returns:
      :class:`TransferredReward`; not differentiable.
    """
    worlds, count = demands.worlds, demands.worlds.num_training
    network = RewardNetwork() if network is None else network
    # Stacked again, without the padding of larger test worlds.
    model = stack_products(worlds.mdps[:count], worlds.memory, label_on=worlds.model.label_on)
    masks, size = worlds.model.allowed, model.mdp.num_states
    problem = learner.make_problem(
        model,
        worlds.observation[:count, :size],
        demands.demonstrations,
        held_out=held_out,
        network=network,
        horizon=hparams.horizon,
        allowed=masks if masks is None else masks[:count, :size],
    )
    weighable = demands.is_probability and any(
        is_weighable(part_of(worlds.model, w)) for w in range(count)
    )
    if weighable:
        hparams = replace(hparams, mu=0.0)  # not None, so that one program serves all weights
    learned = _train(problem, hparams, training, num_steps)
    chosen = learned.best_seed
    if demands.is_probability:
        parameters = part_of(learned.parameters, slice(chosen, chosen + 1))
        lane = replace(one_seed(learned, chosen), parameters=parameters)
        again = Training(training.seed)

        def train(mu: float) -> LearnedRewards:
            return _train(problem, replace(hparams, mu=mu), again, num_steps)

        counts = np.asarray(problem.counts + problem.held_out)
        plans = partial(_plans, demands, network, replace(hparams, mu=None))
        learned = _likeliest(demands, counts, lane, train if weighable else None, plans)
        chosen = 0
    training.stage("checking")
    return _evaluated(demands, learned, chosen, network, hparams, references or {})


def _train(
    problem: Problem, hparams: Hparams, training: Training, num_steps: int
) -> LearnedRewards:
    """Reward networks of N seeds."""
    options = ChunkOptions(until=has_stopped)
    chunks, history = run_seeds(
        learner, problem, hparams, training, num_steps=num_steps, options=options
    )
    states, best = chunks.state, chunks.state.best
    score = np.asarray(best.neg_log_likelihood)
    best_step = np.minimum(np.asarray(best.step), len(history["held_out"]) - 1)
    held_out = history["held_out"][best_step, np.arange(len(best_step))]
    return LearnedRewards(
        parameters=best.parameters,
        held_out=score if hparams.mu is None else np.where(np.isfinite(score), held_out, score),
        best_step=np.asarray(best.step),
        stopped=np.asarray(states.stopped),
        num_steps=int(np.max(states.step)),
        history=history,
    )


# --- a required probability -----------------------------------------------------------------------


class _Weighed(NamedTuple):
    """A learned reward with the likelihood of its mixtures, and its least certified probability."""

    learned: LearnedRewards
    neg_log_likelihood: float
    attained: float


Plans = Callable[[PyTree, int], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _likeliest(
    demands: WorldDemands,
    counts: np.ndarray,
    free: LearnedRewards,
    train: Callable[[float], LearnedRewards] | None,
    plans: Plans,
) -> LearnedRewards:
    """The reward of greatest likelihood over some weights of the probability."""
    count, requested = demands.worlds.num_training, float(demands.requested)
    models = [part_of(demands.worlds.model, w) for w in range(count)]

    def weighed(learned: LearnedRewards, weight: float) -> _Weighed:
        policy, inside, _ = plans(part_of(learned.parameters, 0), count)
        mixed = np.stack([one.policy for one in _mixtures(demands, policy, inside)])
        loss = neg_log_likelihood(mixed[:, : counts.shape[1]], counts)
        each = [attained(m, p, demands.over) for m, p in zip(models, policy, strict=True)]
        # The least certified probability over the training worlds, before mixing.
        return _Weighed(replace(learned, weight=weight), loss, min(each))

    tried = [weighed(free, 0.0)]
    if tried[0].attained < requested and train is not None:
        tried += _bracket(lambda mu: weighed(train(mu), mu), requested)
    losses = [np.nan_to_num(one.neg_log_likelihood, nan=np.inf) for one in tried]
    return tried[int(np.argmin(losses))].learned


def _bracket(tried: Callable[[float], _Weighed], requested: float) -> Iterator[_Weighed]:
    """Yields rewards with increasing weights until one suffices, then by bisection."""
    # The likelihood has several maxima, and those found from too large a weight are lower.
    low = 0.0
    for high in map(float, _WEIGHTS):
        last = tried(high)
        yield last
        if last.attained >= requested:
            break
        low = high
    else:
        return
    low = low or high * 1e-3
    for _ in range(_HALVINGS):
        if requested <= last.attained <= requested + _AIM:
            return
        middle = float(np.sqrt(low * high))
        last = tried(middle)
        yield last
        low, high = (low, middle) if last.attained >= requested else (middle, high)


def _mixtures(demands: WorldDemands, policy: np.ndarray, inside: np.ndarray) -> list[Mixture]:
    """Mixes plans ``[W, S, Q, A]`` of all actions and of optimal ones, in the first W worlds."""
    requested, over, models = float(demands.requested), demands.over, demands.worlds.model
    return [
        reaching(part_of(models, w), policy[w], inside[w], optimal.best, requested, over=over)
        for w, optimal in enumerate((demands.optimal or [])[: len(policy)])
    ]


# --- evaluation -----------------------------------------------------------------------------------


def _evaluated(
    demands: WorldDemands,
    learned: LearnedRewards,
    chosen: int,
    network: RewardNetwork,
    hparams: Hparams,
    references: Mapping[str, jax.Array],
) -> TransferredReward:
    """The policies of all seeds in all worlds, with their satisfaction probabilities."""
    worlds, horizon = demands.worlds, hparams.horizon
    performances, kept = [], {}
    for i in range(len(learned.held_out)):
        parameters = part_of(learned.parameters, i)
        details = dict[str, np.ndarray]()
        if demands.is_probability:
            plain = replace(hparams, mu=None)
            free, inside, status = _plans(demands, network, plain, parameters, len(worlds.mdps))
            mixtures = _mixtures(demands, free, inside)
            policy = jnp.asarray(np.stack([one.policy for one in mixtures]))
            for name in ("share", "attained"):
                details[name] = np.array([getattr(one, name) for one in mixtures])
        else:
            planned = _plan(network, parameters, worlds.model, worlds.observation, hparams)
            policy, status = planned[0], np.asarray(planned[1])
        if demands.bounds is not None:
            quick = _within_steps(worlds, demands.bounds, np.asarray(policy))
            policy = jnp.asarray(np.stack([one.policy for one in quick]))
            times = [one.steps[:3] for one in quick if one.steps is not None]
            details["steps"] = np.array(times)
            details["quick_share"] = np.array([one.share for one in quick])
        lifted = policy
        if worlds.memory is not worlds.automaton:
            lifted = lift_memory_policy(policy, worlds.automaton)
        performances.append(world_performances(worlds.task_model, lifted, horizon))
        if i == chosen:
            kept = {"policy": np.asarray(policy), "status": status, **details}
    model = worlds.task_model
    available = model.mdp.available[:, :, None]
    blind = available / jnp.sum(available, axis=-1, keepdims=True)
    blind = jnp.broadcast_to(blind, (*blind.shape[:2], model.num_memory, blind.shape[-1]))
    others = {**references, "random": blind.astype(model.dtype)}
    return TransferredReward(
        learned,
        chosen,
        performance={
            "learned": performances[chosen],
            **{name: world_performances(model, x, horizon) for name, x in others.items()},
        },
        seeds=np.stack([np.asarray(performance.mean) for performance in performances]),
        **kept,
    )


def _plans(
    demands: WorldDemands, network: NetworkLike, hparams: Hparams, parameters: PyTree, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Plans of all and of optimal actions in the first worlds, one at a time, and statuses."""
    worlds, masks = demands.worlds, np.stack([x.allowed for x in demands.optimal or ()])
    plans, codes = [], np.zeros(count, np.int32)
    for mask in (np.asarray(jax.vmap(lambda model: model.available)(worlds.model)), masks):
        each = []
        for w in range(count):
            only = slice(w, w + 1)
            model, seen, allowed = part_of((worlds.model, worlds.observation, mask), only)
            policy, status = _plan(
                network, parameters, replace(model, allowed=allowed), seen, hparams
            )
            each.append(np.asarray(policy)[0])
            codes[w] = max(codes[w], int(status[0]))
        plans.append(np.stack(each))
    return plans[0], plans[1], codes


@partial(jax.jit, static_argnames=("network",))
def _plan(
    network: NetworkLike,
    parameters: PyTree,
    model: Product,
    observation: jax.Array,
    hparams: Hparams,
) -> tuple[jax.Array, jax.Array]:
    """Policies ``float[W, S, Q, A]``, with a horizon ``[W, T, S, Q, A]``, and statuses."""

    def one(world: tuple[Product, jax.Array]) -> tuple[jax.Array, jax.Array]:
        solution = learner.plan(network, parameters, *world, hparams)
        return solution.policy, solution.status

    return lax.map(one, (model, observation), batch_size=_BATCH)


def _within_steps(worlds: Worlds, bounds: Sequence[StepBound], policy: np.ndarray) -> list[Mixture]:
    """The policies ``[W, S, Q, A]`` of all worlds with their expected steps within the bounds."""
    mixtures = []
    for w, bound in enumerate(bounds):
        model = part_of(worlds.model, w)
        mixture = bound.keep(model, policy[w])
        steps = mixture.steps or StepAnalysis(model).steps(mixture.policy)
        mixtures.append(mixture._replace(steps=steps))
    return mixtures


def world_performances(model: Product, policy: jax.Array, horizon: int | None) -> Performance:
    """Satisfaction probabilities of a policy ``float[W, S, Q, A]`` in products stacked over W worlds.

    With a horizon of T steps, of a policy ``float[W, S, Q, A]`` or ``[W, T, S, Q, A]``.
    """
    if horizon is None:
        return task_performances(model, policy)
    if policy.ndim == 4:
        shape = (policy.shape[0], horizon, *policy.shape[1:])
        policy = jnp.broadcast_to(policy[:, None], shape)
    return step_bounded_performances(model, policy)
