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

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial

from jaxltl.algos.common import learner, loops, pac, splitmix
from jaxltl.algos.common.explicit_games import cumulative, draw, draw_weighted, successor_slot, take
from jaxltl.algos.common.settings import COUNT, Number, RunState, require_own, static, traced
from jaxltl.core import struct
from jaxltl.core.array_types import Key, Numeric, PyTree
from jaxltl.core.automata.translate import FormulaLike
from jaxltl.core.graphs.attractor import almost_surely_reaching, attractor
from jaxltl.core.graphs.end_components import (
    Accepting,
    accepting_bottom_components,
    accepting_end_components,
    bottom_components,
    end_components,
)
from jaxltl.core.models import to_padded, to_sparse
from jaxltl.core.models.game import as_game
from jaxltl.core.models.mdp import support
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.ops.operators import forall_successor, sample_successor
from jaxltl.core.models.product import Product, product
from jaxltl.core.models.protocols import Model
from jaxltl.core.types import Status
from jaxltl.core.validation import Range
from jaxltl.core.values.evaluation.data_guarantee import DataGuarantee, learn_guarantee
from jaxltl.core.values.interval.robust_policy_iteration import greedy_distributions


@struct.dataclass
class Problem:
    """A task in an MDP with unknown probabilities; made by :func:`make_problem`.

    Attributes:
      model: the product with the task's automaton; the learner reads the support of its
        probabilities, and samples.
      winning: ``bool[S, Q]``, the almost-sure winning region.
      losing: ``bool[S, Q]``, the states from which the task cannot be satisfied.
      allowed: ``bool[S, Q, A]``, the actions to be tried; in the winning region, actions all of
        which may be repeated for ever and satisfy the task almost surely.
      component: ``int32[S * Q]``, the maximal end component of each undecided state, or its own
        number.
      staying: ``bool[S, Q, A]``, the actions of undecided states that stay in it.
      initial_table: ``uint32[S]``, the initial distribution as cumulative weights.
      num_claims: ``int[]``, number of unknown probabilities.
    """

    model: Product
    winning: jax.Array
    losing: jax.Array
    allowed: jax.Array
    component: jax.Array
    staying: jax.Array
    initial_table: jax.Array
    num_claims: jax.Array


def make_problem(world: Model, formula: FormulaLike) -> Problem:
    """A checked :class:`Problem`: the product with the task, and its qualitative preprocessing.

    Args:
      world: an MDP or a sparse model; its labels, start and graph are known to the learner.
      formula: a formula, its text, or an automaton over the letters that occur. To make a probability
        small, negate the formula.

    Raises:
      ValueError: the world is a game or no model, or the formula has unknown labels.

    >>> from jaxltl import from_dense
    >>> world = from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 1.0]]], initial=[1, 0],
    ...                    label=[[0], [1]], propositions=["home"])
    >>> make_problem(world, "F home").winning[0].tolist()
    [True, True]
    """
    system = np.asarray(as_game(world).system)
    if hasattr(world, "system") and not system.all():
        raise ValueError(
            "interval_learning plays alone; of a game with an environment learn by "
            "jaxltl.algos.rmax, whose evidence(confidence=) bounds what counts say."
        )
    # The sparse form lists each successor of an action once, as it is observed.
    padded = to_padded(to_sparse(getattr(world, "mdp", world) if system.all() else world))
    model = product(padded, formula, label_on="exit")
    accepting = accepting_end_components(model)
    sure = almost_surely_reaching(model, accepting.region).region
    winning, losing = np.asarray(sure), ~np.asarray(attractor(model, sure).region)
    between = end_components(model, ~winning & ~losing)
    outcomes = support(padded).sum(-1)
    claims = np.where(outcomes > 2, outcomes, outcomes > 1).sum()
    return Problem(
        model=model,
        winning=to_jax(winning),
        losing=to_jax(losing),
        allowed=_allowed(model, winning, accepting),
        component=to_jax(np.asarray(between.component, np.int32).reshape(-1)),
        staying=to_jax(between.inside),
        initial_table=to_jax(np.asarray(cumulative(np.asarray(padded.initial, float)))),
        num_claims=to_jax(np.int32(max(int(claims), 1))),
    )


@jax.jit
def _allowed(model: Product, winning: jax.Array, accepting: Accepting) -> jax.Array:
    """In the winning region, actions inside accepting end components, or else those that stay."""
    safe = forall_successor(model, winning) & model.available & winning[..., None]
    safe = jnp.where(accepting.region[..., None], accepting.inside, safe)
    return jnp.where(winning[..., None], safe, model.available)


# --- settings, state and metrics ---------------------------------------------------------------


INTERVALS = ("linear", "confidence")


@struct.dataclass
class Hparams:
    """Settings; numbers are traced.

    Attributes:
      intervals: ``"linear"``: linearly updating intervals, which narrow fast and forget a wrong
        prior; ``"confidence"``: intervals that contain all true probabilities at all times with
        probability `confidence`; static; default ``"linear"``.
      confidence: in (0, 1); of ``"confidence"`` only; default 0.9.
      least: positive; assumed lower bound of each transition probability; default 1e-4.
      strength, most_strength: prior strengths in samples of linear intervals where data contradict
        them and where they agree, 0 < strength <= most_strength; default 5.0 and 10.0.
      exploration: in (0, 1], probability of any allowed action; default 0.1.
      restart: probability of restarting before a move in the almost-sure winning region; in the
        losing region 1; default 0.05.
      discount: in (0, 1), prefers actions that win soonest among those of equal value; default 0.99.
      sweeps: of value iteration in a step; at least the moves to the winning region; default 40.
      tolerance: change of the last sweep at which values count as converged; default 1e-4.
      num_runs, length: episodes in a step, and moves of each; static; default 4 and 64.
    """

    intervals: str = static(INTERVALS, default="linear")
    confidence: Number = traced("confidence", default=0.9)
    least: Number = traced(Range(0, 1, open_below=True), default=1e-4)
    strength: Number = traced(Range(0, open_below=True, open_above=True), default=5.0)
    most_strength: Number = traced(Range(0, open_below=True, open_above=True), default=10.0)
    exploration: Number = traced(Range(0, 1, open_below=True), default=0.1)
    restart: Number = traced(Range(0, 1), default=0.05)
    discount: Number = traced("positive_discount", default=0.99)
    sweeps: Number = traced(Range(1), default=40)
    tolerance: Number = traced("tolerance", default=1e-4)
    num_runs: int = static(COUNT, default=4)
    length: int = static(COUNT, default=64)


@struct.dataclass
class State(RunState):
    """Counts, intervals and values.

    Attributes:
      samples: ``int32[]``, observed transitions; near 2^31 further steps sample none.
      counts: ``int32[S, A, K]``, observations of each transition.
      lower, upper: ``float[S, A, K]``, intervals; 0 in padding.
      pessimistic, optimistic: ``float[S, Q]``, optimal satisfaction probability with adversarial
        and with cooperative nature, as far as value iteration has converged.
      best: ``bool[S, Q, A]``, preferred actions.
      residual: ``float[]``, largest change of the last sweep.
    """

    samples: jax.Array
    counts: jax.Array
    lower: jax.Array
    upper: jax.Array
    pessimistic: jax.Array
    optimistic: jax.Array
    best: jax.Array
    residual: jax.Array


@struct.dataclass
class Metrics:
    """Figures after a step; scalars, of a run ``[T]``.

    Attributes:
      samples: observed transitions.
      lower, upper: pessimistic and optimistic value, mean over the initial distribution.
      residual: of :class:`State`.
      status: COMPLETED if the residual is at most the tolerance; MAX_STEPS if not, or if all
        samples that can be counted were observed.
    """

    samples: jax.Array
    lower: jax.Array
    upper: jax.Array
    residual: jax.Array
    status: jax.Array


@jax.jit
def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """No samples: every transition may have nearly all of its action's probability."""
    world = problem.model.mdp
    used = world.successor_probability > 0
    single = used.sum(-1, keepdims=True) == 1
    least = jnp.asarray(hparams.least, world.dtype)
    lower = jnp.where(single, 1, least) * used
    upper = jnp.where(single, 1, 1 - least) * used
    lower, upper = _consistent(lower, upper)
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
    new = _sampled_counts(state, problem, hparams) * more
    state = replace(
        state, step=state.step + 1, samples=state.samples + size * more, counts=state.counts + new
    )
    if hparams.intervals == "linear":
        lower, upper = _linear_intervals(state, new, hparams)
    else:
        lower, upper = _confidence_intervals(state, problem.num_claims, hparams)
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


def guarantee(
    state: State,
    problem: Problem,
    confidence: float,
    *,
    objective: str = "max",
    tolerance: float | None = None,
) -> DataGuarantee:
    """The certified satisfaction probability that the counts guarantee, however sampled; on the host.

    By anytime intervals at a `confidence` in (0, 1), of the `state` and `problem` of one run. It assumes
    the graph only, and holds with that confidence for all looks at once. `objective` and `tolerance`
    are as for :func:`~jaxltl.core.values.evaluation.data_guarantee.learn_guarantee`.

    Raises:
      ValueError: the confidence is out of range, or an argument is of another type.
    """
    require_own((state, State), (problem, Problem))
    world = problem.model.mdp
    return learn_guarantee(
        world,
        np.asarray(state.counts)[support(world)],
        problem.model.automaton,
        confidence,
        graph="given",
        method="anytime",
        objective=objective,
        tolerance=tolerance,
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
    stays = used.any(-1) & (~used | forall_successor(model, problem.winning)).all(-1)
    bottom = bottom_components(model, used).inside.any(-1)
    accepting = accepting_bottom_components(model, used.astype(model.dtype))
    return jnp.all((stays & (~bottom | accepting)) | ~problem.winning)


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
    optimal = problem.allowed & (problem.staying | (moves >= value[..., None] - slack))
    optimal = jnp.where((problem.winning | problem.losing)[..., None], problem.allowed, optimal)
    ahead = jnp.where(optimal, ahead, -1)
    highest = jnp.max(ahead, axis=-1)
    best = optimal & (ahead >= (highest * (1 - slack))[..., None])
    best = jnp.where(problem.winning[..., None], problem.allowed, best)
    speed = jnp.asarray(hparams.discount, moves.dtype) * jnp.maximum(highest, 0)
    return _with_decided(problem, speed), best


# --- intervals ---------------------------------------------------------------------------------


def _linear_intervals(
    state: State, new: jax.Array, hparams: Hparams
) -> tuple[jax.Array, jax.Array]:
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
    return _consistent(lower, end(state.upper, share <= state.upper))


def _confidence_intervals(
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
    lower, upper = _kl_lower_end(share, c), 1 - _kl_lower_end(1 - share, c)
    floor = jnp.minimum(jnp.asarray(hparams.least, dtype), upper)
    lower = jnp.where(used, jnp.maximum(jnp.maximum(lower, floor), state.lower), 0)
    upper = jnp.where(used, jnp.minimum(upper, state.upper), 0)
    return _consistent(lower, upper)


def _kl_lower_end(a: jax.Array, c: jax.Array) -> jax.Array:
    """A lower bound of all b with ``kl(a, b) <= c``."""
    a = jnp.clip(a, 0, 1)  # rounding may leave [0, 1]
    other = 1 - a
    below = jnp.minimum(jnp.sqrt(c / 2), jnp.sqrt(2 * c * a))
    return jnp.maximum(a - jnp.minimum(below, c + jnp.sqrt(c * c + 2 * c * other)), 0)


def _consistent(lower: jax.Array, upper: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The ends, widened or scaled so that they contain a distribution in spite of rounding."""
    lower = lower / jnp.maximum(jnp.sum(lower, -1, keepdims=True), 1)
    upper = jnp.maximum(upper, lower)
    total = jnp.sum(upper, -1, keepdims=True)
    short = (total > 0) & (total < 1)
    return lower, jnp.minimum(jnp.where(short, upper / jnp.where(short, total, 1), upper), 1)


# --- episodes ----------------------------------------------------------------------------------


def _sampled_counts(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
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
        s = jnp.where(restarts, draw(problem.initial_table, words[1]), s)
        q = jnp.where(restarts, start, q)
        explores = (splitmix.uniform(words[2], dtype) < explore)[:, None]
        moves = jnp.where(explores, take(problem.allowed, (s, q)), take(state.best, (s, q)))
        a = draw_weighted(moves.astype(dtype), words[3])
        keys = jax.random.split(key, num_runs)
        t = jax.vmap(sample_successor, (None, 0, 0, 0))(world, keys, s, a)
        return (t, take(next_memory, (s, q))), (s, a, successor_slot(as_game(world), s, a, t))

    first = draw(problem.initial_table, splitmix.words(stream, jnp.uint32(0)))
    keys = jax.random.split(jax.random.fold_in(key, 1), hparams.length)
    number = jnp.arange(hparams.length, dtype=jnp.uint32)
    states = first, jnp.broadcast_to(start, (num_runs,))
    _, (s, a, k) = lax.scan(move, states, (number, keys))
    return jnp.zeros(state.counts.shape, jnp.int32).at[s, a, k].add(1)
