"""Robust anytime learning of a temporal-logic task in an MDP with unknown probabilities.

The graph is known, the probabilities are not (Suilen, Simao, Parker and Jansen 2022). Every
transition has an interval, updated by the samples of each step. Adversarial and cooperative nature
give a pessimistic and an optimistic value of the task. The sampled policy is optimal for the
optimistic one, and explores with a small probability; where the task can be satisfied almost
surely, every policy on the way satisfies it, by the graph.

Qualitative preprocessing (:func:`make_problem`) finds the almost-sure winning region, the losing
region, and the maximal end components between them; the states of each share the value of its best
exit. Hence both values are the unique solutions of their Bellman equations, and value iteration may
continue from the last values.

The world is read through ``sample_successor`` only. Values have shape ``[S, Q]``: S states of the
world, Q of the task's automaton, which reads the label of a state on exit.

Example: to reach the goal ``g`` and never ``r``.
  >>> import jax
  >>> import jaxltl as jl
  >>> from jaxltl.algos import interval_learning
  >>> world = jl.make_mdp(  # an initial state, a goal and a trap
  ...     [[[1, 2], [0, 1]], [[1, 0], [0, 0]], [[2, 0], [0, 0]]],
  ...     [[[0.8, 0.2], [0.5, 0.5]], [[1, 0], [0, 0]], [[1, 0], [0, 0]]],
  ...     available=[[True, True], [True, False], [True, False]], initial=[1, 0, 0],
  ...     label=[[0, 0], [1, 0], [0, 1]], propositions=["g", "r"])
  >>> problem = interval_learning.make_problem(world, "!r U g")
  >>> hparams = interval_learning.Hparams(num_runs=2, length=5)
  >>> learned = interval_learning.train_until(jax.random.key(0), problem, hparams, num_steps=100,
  ...                                         until=interval_learning.bounds_within(0.1))
  >>> state = learned.state
  >>> interval_learning.policy(state, problem, hparams).shape  # [S, Q, A]
  (3, 3, 2)
  >>> exploring = interval_learning.behavior(state, problem, hparams)
  >>> interval_learning.wins_almost_surely(problem, exploring)
  True
  >>> found = interval_learning.guarantee(state, problem, 0.9)
  >>> 0 <= found.bound <= found.optimistic <= 1
  True
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial

from jaxltl.algos.common import learner, loops, pac, splitmix
from jaxltl.algos.common.play import draw, successor_slot, take
from jaxltl.algos.interval_learning.problem import Hparams, Metrics, Problem, State
from jaxltl.core.array_types import Key, Numeric, PyTree
from jaxltl.core.graphs.end_components import accepting_bottom_components, bottom_components
from jaxltl.core.models.game import as_game
from jaxltl.core.models.mdp import support
from jaxltl.core.models.ops.operators import forall_successor, sample_successor
from jaxltl.core.types import Status
from jaxltl.core.values.evaluation.data_guarantee import DataGuarantee, learn_guarantee
from jaxltl.core.values.interval.contest import greedy_distributions


@jax.jit
def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """No samples: every transition may have nearly all of its action's probability."""
    world = problem.model.mdp
    used = world.successor_probability > 0
    single = used.sum(-1, keepdims=True) == 1
    least = jnp.asarray(hparams.least, world.dtype)
    lower = jnp.where(single, 1, least) * used
    upper = jnp.where(single, 1, 1 - least) * used
    lower, upper = consistent(lower, upper)
    return State(
        key=key,
        step=jnp.int32(0),
        samples=jnp.int32(0),
        counts=jnp.zeros(used.shape, jnp.int32),
        lower=lower,
        upper=upper,
        pessimistic=problem.winning.astype(world.dtype),
        optimistic=1 - problem.losing.astype(world.dtype),
        best=problem.allowed,
        residual=jnp.asarray(jnp.inf, world.dtype),
    )


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """Episodes, the update of the intervals, and value iteration from the last values."""
    size = hparams.num_runs * hparams.length
    more = state.samples <= loops.MAX_STEPS - size
    new = sampled_counts(state, problem, hparams) * more
    state = replace(
        state, step=state.step + 1, samples=state.samples + size * more, counts=state.counts + new
    )
    if hparams.intervals == "linear":
        lower, upper = linear_intervals(state, new, hparams)
    else:
        lower, upper = confidence_intervals(state, problem.num_claims, hparams)
    random = jnp.sum(problem.model.mdp.successor_probability > 0, -1, keepdims=True) > 1
    updated = jnp.any(new > 0, axis=-1, keepdims=True) & random
    lower, upper = jnp.where(updated, lower, state.lower), jnp.where(updated, upper, state.upper)
    state = _value_iteration(replace(state, lower=lower, upper=upper), problem, hparams)
    return state, measure(state, problem, hparams)


init, step, run, train, run_until, train_until = learner.bind(_init, _step)


def measure(state: State, problem: Problem, hparams: Hparams) -> Metrics:
    """The :class:`Metrics` of a state."""
    model = problem.model
    more = state.samples <= loops.MAX_STEPS - hparams.num_runs * hparams.length
    settled = (state.residual <= hparams.tolerance) & more
    return Metrics(
        samples=state.samples,
        lower=jnp.sum(model.initial * state.pessimistic),
        upper=jnp.sum(model.initial * state.optimistic),
        residual=state.residual,
        status=learner.completion_status(settled, jnp.isfinite(state.residual)),
    )


def bounds_within(width: Numeric) -> loops.Until:
    """A condition for ``run_until``: optimistic minus pessimistic value at most `width`, converged."""
    return Partial(_bounds_within, width)


def _bounds_within(width: jax.Array, before: State, after: State, metrics: Metrics) -> jax.Array:
    return (metrics.upper - metrics.lower <= width) & (metrics.status == Status.COMPLETED)


@jax.jit
def behavior(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The sampled policy ``float[S, Q, A]`` of a `state`: optimistic and exploring.

    Positive on every allowed action of the `problem`, by ``exploration`` of `hparams`.
    """
    dtype = problem.model.dtype
    return pac.hat_strategy(state.best, problem.allowed, hparams.exploration).astype(dtype)


@jax.jit
def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The robust policy ``float[S, Q, A]``: optimal with adversarial nature.

    Uniform over the allowed actions in the winning region, and so almost surely winning; in an end
    component between, uniform over its best exits and the actions that stay.
    """
    nature = jnp.full(1, -1, state.lower.dtype)
    ends = state.lower[None], state.upper[None]
    moves = _expectations(problem, state.pessimistic[None], *ends, nature)[0]
    out = problem.allowed & ~problem.staying & (moves >= _backup(problem, moves)[..., None])
    used = jnp.where(problem.winning[..., None], problem.allowed, out | problem.staying)
    used = jnp.where(problem.losing[..., None], problem.allowed, used)
    return used / jnp.maximum(used.sum(-1, keepdims=True), 1).astype(moves.dtype)


def guarantee(state: State, problem: Problem, confidence: float, **options: Any) -> DataGuarantee:
    """The certified satisfaction probability that the counts guarantee, however sampled; on the host.

    By anytime intervals at a `confidence` in (0, 1), of the `state` and `problem` of one run. It assumes
    the graph only, and holds with that confidence for all looks at once. `options` are those of
    :func:`~jaxltl.core.values.evaluation.data_guarantee.learn_guarantee`.

    Raises:
      ValueError: the confidence is out of range, or an argument is of another type.
    """
    if not isinstance(problem, Problem) or not isinstance(state, State):
        raise ValueError(
            "guarantee takes a state, as init and train return it, and the problem "
            "that make_problem returned."
        )
    world = problem.model.mdp
    return learn_guarantee(
        world,
        np.asarray(state.counts)[support(world)],
        problem.model.automaton,
        confidence,
        graph="given",
        method="anytime",
        **options,
    )


def wins_almost_surely(problem: Problem, policy: jax.Array) -> bool:
    """``True`` if a memoryless `policy` satisfies the task almost surely wherever that is possible.

    Qualitative, on the host, by the graph of the `problem` and the support of the policy,
    ``float[S, Q, A]``: it stays in the winning region, and all its bottom strongly connected
    components there are accepting.
    """
    return bool(_wins(problem, policy))


@jax.jit
def _wins(problem: Problem, policy: jax.Array) -> jax.Array:
    model, used = problem.model, policy > 0
    kept = used.any(-1) & (~used | forall_successor(model, problem.winning)).all(-1)
    bottom = bottom_components(model, used).inside.any(-1)
    accepting = accepting_bottom_components(model, used.astype(model.dtype))
    return jnp.all((kept & (~bottom | accepting)) | ~problem.winning)


# --- value iteration ----------------------------------------------------------------------------


def _value_iteration(state: State, problem: Problem, hparams: Hparams) -> State:
    """Sweeps of both values, and the actions that the last sweep prefers."""
    nature = jnp.asarray([-1, 1, 1], state.lower.dtype)
    seen = state.counts.astype(nature.dtype) + (problem.model.mdp.successor_probability > 0)
    share = seen / jnp.maximum(jnp.sum(seen, -1, keepdims=True), 1)
    lower = jnp.stack([state.lower, state.lower, share])
    upper = jnp.stack([state.upper, state.upper, share])

    def sweep(_: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        values, _, _ = carry
        moves = _expectations(problem, values, lower, upper, nature)
        bounds = jax.vmap(partial(_backup, problem))(moves[:2])
        speed, best = _soonest(problem, hparams, moves[1], bounds[1], moves[2])
        return jnp.concatenate([bounds, speed[None]]), best, jnp.max(jnp.abs(bounds - values[:2]))

    # The speed restarts from zero: a value that was too high would decay slowly in end components.
    values = jnp.stack([state.pessimistic, state.optimistic, problem.winning.astype(nature.dtype)])
    values, best, change = lax.fori_loop(
        0, hparams.sweeps, sweep, (values, state.best, state.residual)
    )
    return replace(state, pessimistic=values[0], optimistic=values[1], best=best, residual=change)


def _expectations(
    problem: Problem, values: jax.Array, lower: jax.Array, upper: jax.Array, nature: jax.Array
) -> jax.Array:
    """Expectations of V values under intervals; `nature` is 1 to maximise, -1 to minimise."""
    next_memory = problem.model.next_memory[:, :, None, None]
    reached = values[:, problem.model.mdp.successor[:, None], next_memory]
    shape, width = reached.shape, reached.shape[-1]
    low, high = (jnp.broadcast_to(x[:, :, None], shape).reshape(-1, width) for x in (lower, upper))
    key = -nature[:, None, None, None, None] * reached
    share = greedy_distributions(low, high, key.reshape(-1, width))
    return jnp.sum(share.reshape(shape) * reached, axis=-1)


def _backup(problem: Problem, moves: jax.Array) -> jax.Array:
    """The value of the best action, or of the best exit of an end component."""
    best = jnp.max(jnp.where(problem.allowed & ~problem.staying, moves, 0), axis=-1).reshape(-1)
    best = jnp.zeros_like(best).at[problem.component].max(best)
    best = jnp.minimum(take(best, problem.component), 1).reshape(problem.winning.shape)
    return _with_decided(problem, best)


def _with_decided(problem: Problem, value: jax.Array) -> jax.Array:
    return jnp.where(problem.winning, 1, jnp.where(problem.losing, 0, value))


def _soonest(
    problem: Problem, hparams: Hparams, moves: jax.Array, value: jax.Array, ahead: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Discounted probability of winning by optimistic actions and frequencies; its best ones."""
    slack = 64 * jnp.finfo(moves.dtype).eps
    near = problem.allowed & (problem.staying | (moves >= value[..., None] - slack))
    near = jnp.where((problem.winning | problem.losing)[..., None], problem.allowed, near)
    ahead = jnp.where(near, ahead, -1)
    most = jnp.max(ahead, axis=-1)
    best = near & (ahead >= (most * (1 - slack))[..., None])
    best = jnp.where(problem.winning[..., None], problem.allowed, best)
    speed = jnp.asarray(hparams.discount, moves.dtype) * jnp.maximum(most, 0)
    return _with_decided(problem, speed), best


# --- intervals ---------------------------------------------------------------------------------


def linear_intervals(state: State, new: jax.Array, hparams: Hparams) -> tuple[jax.Array, jax.Array]:
    """Linearly updating intervals (Suilen et al. 2022, definition 4; Walter and Augustin 2009).

    ``(n P + k) / (n + N)`` for both ends P and N `new` observations, k of them of the transition.
    The strength n is the larger one if all frequencies ``k / N`` of the action are on the inner
    side of P, else the smaller one. Strengths grow by N.
    """
    dtype = state.lower.dtype
    before = jnp.sum(state.counts - new, -1, keepdims=True).astype(dtype)
    weak, strong = before + hparams.strength, before + hparams.most_strength
    number = jnp.sum(new, -1, keepdims=True).astype(dtype)
    share = new / jnp.maximum(number, 1)

    def end(prior: jax.Array, agrees: jax.Array) -> jax.Array:
        n = jnp.where(jnp.all(agrees, -1, keepdims=True), strong, weak)
        return (n * prior + new) / (n + number)

    lower = end(state.lower, share >= state.lower)
    return consistent(lower, end(state.upper, share <= state.upper))


def confidence_intervals(
    state: State, num_claims: jax.Array, hparams: Hparams
) -> tuple[jax.Array, jax.Array]:
    """Anytime-valid confidence intervals of all probabilities at once, in closed form.

    The set of :func:`~jaxltl.core.statistics.binomial.anytime` is contained in ``n kl(k / n, p) <=
    log(2 sqrt(n) / failure)``, since Jeffreys' mixture is at least ``1 / (2 sqrt(n))`` of any
    likelihood (Willems, Shtarkov and Tjalkens 1995). An enclosure follows from ``kl(a, b) >= 2 (a -
    b)^2`` and ``kl(a, b) >= (a - b)^2 / (2 max(a, b))``, for a probability and for its complement.
    All these sets hold simultaneously, hence so does their intersection over time.
    """
    dtype = state.lower.dtype
    used = state.upper > 0
    failure = (1 - jnp.asarray(hparams.confidence, dtype)) / num_claims.astype(dtype)
    n = jnp.maximum(jnp.sum(state.counts, -1, keepdims=True).astype(dtype), 1)
    share, c = state.counts / n, (jnp.log(2 * jnp.sqrt(n)) - jnp.log(failure)) / n
    lower, upper = kl_lower_end(share, c), 1 - kl_lower_end(1 - share, c)
    floor = jnp.minimum(jnp.asarray(hparams.least, dtype), upper)
    lower = jnp.where(used, jnp.maximum(jnp.maximum(lower, floor), state.lower), 0)
    upper = jnp.where(used, jnp.minimum(upper, state.upper), 0)
    return consistent(lower, upper)


def kl_lower_end(a: jax.Array, c: jax.Array) -> jax.Array:
    """A lower bound of all b with ``kl(a, b) <= c``."""
    a = jnp.clip(a, 0, 1)  # rounding may leave [0, 1]
    other = 1 - a
    below = jnp.minimum(jnp.sqrt(c / 2), jnp.sqrt(2 * c * a))
    return jnp.maximum(a - jnp.minimum(below, c + jnp.sqrt(c * c + 2 * c * other)), 0)


def consistent(lower: jax.Array, upper: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The ends, widened or scaled so that they contain a distribution in spite of rounding."""
    lower = lower / jnp.maximum(jnp.sum(lower, -1, keepdims=True), 1)
    upper = jnp.maximum(upper, lower)
    total = jnp.sum(upper, -1, keepdims=True)
    short = (total > 0) & (total < 1)
    return lower, jnp.minimum(jnp.where(short, upper / jnp.where(short, total, 1), upper), 1)


# --- episodes ----------------------------------------------------------------------------------


def sampled_counts(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """Transition counts of a step's episodes, ``int32[S, A, K]``."""
    world, dtype, num_runs = problem.model.mdp, problem.model.dtype, hparams.num_runs
    explore, restart = (jnp.asarray(x, dtype) for x in (hparams.exploration, hparams.restart))
    start = jnp.asarray(problem.model.automaton.initial, jnp.int32)
    next_memory, key = problem.model.next_memory, learner.step_key(state)
    stream = splitmix.streams(jax.random.fold_in(key, 0), (num_runs,))

    def move(states: PyTree, x: tuple[jax.Array, jax.Array]) -> tuple[PyTree, PyTree]:
        (s, q), (number, key) = states, x
        words = [splitmix.words(stream, 4 * number + i) for i in range(1, 5)]
        ends = splitmix.uniform(words[0], dtype) < restart
        restarts = take(problem.losing, (s, q)) | (take(problem.winning, (s, q)) & ends)
        s = jnp.where(restarts, draw(problem.start_table, words[1]), s)
        q = jnp.where(restarts, start, q)
        explores = (splitmix.uniform(words[2], dtype) < explore)[:, None]
        moves = jnp.where(explores, take(problem.allowed, (s, q)), take(state.best, (s, q)))
        total = jnp.cumsum(moves.astype(dtype), axis=-1)
        drawn = splitmix.uniform(words[3], dtype)[:, None] * total[:, -1:]
        a = jnp.argmax(total > drawn, axis=-1).astype(jnp.int32)
        keys = jax.random.split(key, num_runs)
        t = jax.vmap(sample_successor, (None, 0, 0, 0))(world, keys, s, a)
        return (t, take(next_memory, (s, q))), (s, a, successor_slot(as_game(world), s, a, t))

    first = draw(problem.start_table, splitmix.words(stream, jnp.uint32(0)))
    keys = jax.random.split(jax.random.fold_in(key, 1), hparams.length)
    number = jnp.arange(hparams.length, dtype=jnp.uint32)
    states = first, jnp.broadcast_to(start, (num_runs,))
    _, (s, a, k) = lax.scan(move, states, (number, keys))
    return jnp.zeros(state.counts.shape, jnp.int32).at[s, a, k].add(1)
