"""Robust anytime learning: a task in an unknown world, by intervals that follow the data.

The graph of a Markov decision process is known, its probabilities are not (Suilen, Simao, Parker
and Jansen 2022). Every choice has intervals, which each step's samples update; between them nature
picks against the task and for it, which gives a pessimistic and an optimistic value. Sampled is
what is best for the optimistic one, and with a small probability any move; where the task can be
done almost surely, every policy on the way does it, by the graph.

What the graph decides is decided once (:func:`make_problem`): where the task is won almost surely,
where it is lost, and the end components between, in which a run may stay but wins nothing. Their
states share the value of the best way out. So both values are the only solutions of their
equations, and sweeps may go on from the last values however the intervals have moved.

The world is touched through ``sample_successor`` only. Values have shape ``[S, Q]``: S states of
the world, Q of the task's automaton, which reads the label of the state that is left.

Example: to come to the goal ``g`` and never to ``r``, where nobody knows the probabilities.

  >>> import jax, jax.numpy as jnp
  >>> import jaxltl as jl
  >>> from jaxltl.algos import interval_learning
  >>> world = jl.make_mdp(  # a start, from where one gets to a goal or into a trap
  ...     [[[1, 2], [0, 1]], [[1, 0], [0, 0]], [[2, 0], [0, 0]]],
  ...     [[[0.8, 0.2], [0.5, 0.5]], [[1, 0], [0, 0]], [[1, 0], [0, 0]]],
  ...     available=[[True, True], [True, False], [True, False]], initial=[1, 0, 0],
  ...     label=[[0, 0], [1, 0], [0, 1]], propositions=["g", "r"])
  >>> problem = interval_learning.make_problem(world, "!r U g")
  >>> hparams = interval_learning.Hparams(num_runs=2, length=5)
  >>> state, metrics = interval_learning.train(jax.random.key(0), problem, hparams, num_steps=2)
  >>> metrics.samples.tolist(), bool((metrics.lower <= metrics.upper).all())
  ([10, 20], True)
  >>> interval_learning.policy(state, problem, hparams).shape  # [S, Q, A]
  (3, 3, 2)
  >>> sure = interval_learning.guarantee(state, problem, 0.9)
  >>> 0 <= sure.bound <= sure.optimistic <= 1
  True

A run is made of steps, goes on from a state, and may end early:

  >>> state = interval_learning.init(jax.random.key(0), problem, hparams)  # train is init and run
  >>> state, metrics = interval_learning.run(state, problem, hparams, num_steps=2)  # by step
  >>> until = interval_learning.known_within(0.01)  # for run_until and train_until
  >>> state.step.item()
  2
  >>> play = interval_learning.behavior(state, problem, hparams)
  >>> interval_learning.wins_almost_surely(problem, play)  # always
  True
  >>> interval_learning.measure(state, problem, hparams).samples.item()
  20

Many seeds are ``jax.vmap(lambda key: train(key, problem, hparams, num_steps=...))(keys)``; so are
many settings, by ``vmap`` over the numbers of ``Hparams``. End when
enough is known by ``train_until(..., until=known_within(0.01))``.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jax.tree_util import Partial

from jaxltl.algos.common import learner, pac
from jaxltl.algos.common.play import cumulative, take
from jaxltl.algos.interval_learning._interval_data import confident, linear, sampled, with_room
from jaxltl.core.automata.translate import Task
from jaxltl.core.graphs.acceptance import accepting_bottom_components, accepting_end_components
from jaxltl.core.graphs.attractor import almost_surely_reaching, attractor
from jaxltl.core.graphs.end_components import bottom_components, end_components
from jaxltl.core.models.construct.convert import to_padded, to_sparse
from jaxltl.core.models.game import as_game
from jaxltl.core.models.mdp import support
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.ops.operators import forall_successor
from jaxltl.core.models.product import Product, product
from jaxltl.core.pretty_print import brief, history
from jaxltl.core.types import Status, status_code
from jaxltl.core.values.evaluation.data_guarantee import DataGuarantee, learn_guarantee
from jaxltl.core.values.interval.contest import chances

__all__ = [
    "INTERVALS",
    "Hparams",
    "Metrics",
    "Problem",
    "State",
    "behavior",
    "guarantee",
    "init",
    "known_within",
    "make_problem",
    "measure",
    "policy",
    "run",
    "run_until",
    "step",
    "train",
    "train_until",
    "wins_almost_surely",
]

INTERVALS = ("linear", "confidence")


@brief
@struct.dataclass
class Problem:
    """A world with a task; made by :func:`make_problem`.

    Attributes:
      model: the world beside the task's automaton; of its probabilities the learner uses which are
        positive, and samples.
      won: ``bool[S, Q]``, from where the task can be done almost surely.
      lost: ``bool[S, Q]``, from where it cannot be done at all.
      allowed: ``bool[S, Q, A]``, the moves that are tried; where the task is won, those of which
        all may be made for ever, and it is done almost surely.
      component: ``int32[S * Q]``, the end component of each undecided state, or its own number.
      staying: ``bool[S, Q, A]``, the moves of undecided states that stay in it.
      start_table: ``uint32[S]``, where runs start, for drawing.
      num_claims: ``int[]``, how many probabilities have to be known at once.
    """

    model: Product
    won: jax.Array
    lost: jax.Array
    allowed: jax.Array
    component: jax.Array
    staying: jax.Array
    start_table: jax.Array
    num_claims: jax.Array


@brief
@struct.dataclass
class Hparams:
    """How to learn. Numbers are traced.

    Attributes:
      intervals: ``"linear"``: linearly updating intervals, which come together soon and forget a
        wrong prior; ``"confidence"``: intervals that hold all true probabilities at all times with
        a chance of `confidence`, by which the pessimistic value never exceeds the truth, and the
        optimistic one is never below; static; default ``"linear"``.
      confidence: in (0, 1); for ``"confidence"``; default 0.9.
      least: the smallest probability that a transition of the graph is taken to have, positive;
        default 1e-4.
      strength, most_strength: as how many samples the first linear intervals count, at least where
        data contradict them, and where they do not; positive, the second not below the first;
        default 5.0 and 10.0.
      exploration: the probability of making any allowed move, in (0, 1]; default 0.1.
      restart: the probability with which a run starts anew before a move where the task is won;
        where it is lost, it always does; default 0.05.
      discount: in (0, 1); among moves of one optimistic value those are made that lead soonest to
        where the task is won; default 0.99.
      sweeps: of each value in a step; as many as it takes moves to where the task is won, or more;
        default 40.
      tolerance: the change by the last sweep up to which values count as settled; default 1e-4.
      num_runs: that a step samples; static; default 4.
      length: moves of each; static; default 64.
    """

    intervals: str = struct.field(pytree_node=False, default="linear")
    confidence: jax.Array | float = 0.9
    least: jax.Array | float = 1e-4
    strength: jax.Array | float = 5.0
    most_strength: jax.Array | float = 10.0
    exploration: jax.Array | float = 0.1
    restart: jax.Array | float = 0.05
    discount: jax.Array | float = 0.99
    sweeps: jax.Array | int = 40
    tolerance: jax.Array | float = 1e-4
    num_runs: int = struct.field(pytree_node=False, default=4)
    length: int = struct.field(pytree_node=False, default=64)


@brief
@struct.dataclass
class State:
    """What has been seen, and what is made of it.

    Attributes:
      key: of the whole run.
      step: ``int32[]``, steps made.
      samples: ``int32[]``, transitions seen; near 2^31 a run is over, and steps see no more.
      counts: ``int32[S, A, K]``, how often each was.
      lower, upper: ``float[S, A, K]``, the intervals; 0 at what is no transition.
      pessimistic, optimistic: ``float[S, Q]``, the largest probability of the task with nature
        against it and for it, as far as sweeps have come.
      best: ``bool[S, Q, A]``, the moves that are preferred.
      residual: ``float[]``, the largest change by the last sweep.
    """

    key: jax.Array
    step: jax.Array
    samples: jax.Array
    counts: jax.Array
    lower: jax.Array
    upper: jax.Array
    pessimistic: jax.Array
    optimistic: jax.Array
    best: jax.Array
    residual: jax.Array


@brief(facts=partial(history, codes={"status": Status}))
@struct.dataclass
class Metrics:
    """Figures after a step; scalars, of a run ``[T]``.

    Attributes:
      samples: so far.
      lower, upper: the pessimistic and the optimistic value at the start.
      residual: see :class:`State`.
      status: CONVERGED where values have settled; MAX_STEPS if not, or if all samples that can be
        counted have been seen.
    """

    samples: jax.Array
    lower: jax.Array
    upper: jax.Array
    residual: jax.Array
    status: jax.Array


# --- problems, on the host ------------------------------------------------------------------


def make_problem(world: Any, task: Task) -> Problem:
    """A checked :class:`Problem`: the product with the task, and what its graph decides.

    Args:
      world: an MDP or a sparse model; its labels, start and graph are known to the learner.
      task: any formula, its text, or an automaton over the letters that occur. For a probability
        to be made small, negate the formula.

    Returns:
      :class:`Problem`.

    Raises:
      ValueError: the world is a game or no model, or the formula has unknown labels.

    Example:
      >>> from jaxltl import make_mdp
      >>> world = make_mdp([[[1, 2], [0, 1]], [[1, 0], [1, 0]], [[2, 0], [2, 0]]],
      ...                  [[[.7, .3], [.5, .5]], [[1, 0], [1, 0]], [[1, 0], [1, 0]]],
      ...                  initial=[1, 0, 0], label=[[0], [1], [0]], propositions=["home"])
      >>> problem = make_problem(world, "F home")
      >>> problem.won[0].tolist()  # by trying the second move again and again
      [True, True]
      >>> problem.allowed[0, 0].tolist()
      [False, True]
    """
    system = np.asarray(as_game(world).system)
    if hasattr(world, "system") and not system.all():
        raise ValueError(
            "interval_learning plays alone; of a game with an environment learn by "
            "jaxltl.algos.rmax, whose evidence(confidence=) bounds what counts say."
        )
    # Through the sparse form a successor stands once in each choice, as it is seen.
    world = to_padded(to_sparse(getattr(world, "mdp", world) if system.all() else world))
    model = product(world, task, label_on="exit")
    accepting = accepting_end_components(model)
    sure = almost_surely_reaching(model, accepting.region).region
    won, lost = np.asarray(sure), ~np.asarray(attractor(model, sure).region)
    between = end_components(model, ~won & ~lost)
    outcomes = support(world).sum(-1)
    claims = np.where(outcomes > 2, outcomes, outcomes > 1).sum()
    return Problem(
        model=model,
        won=to_jax(won),
        lost=to_jax(lost),
        allowed=_allowed(model, won, accepting.region, accepting.inside),
        component=to_jax(np.asarray(between.component, np.int32).reshape(-1)),
        staying=to_jax(between.inside),
        start_table=to_jax(np.asarray(cumulative(np.asarray(world.initial, float)))),
        num_claims=to_jax(np.int32(max(int(claims), 1))),
    )


@jax.jit
def _allowed(model: Product, won: jax.Array, region: jax.Array, inside: jax.Array) -> jax.Array:
    """Where the task is won, the moves in an accepting end component, or else those that stay."""
    safe = forall_successor(model, won) & model.available & won[..., None]
    safe = jnp.where(region[..., None], inside, safe)
    return jnp.where(won[..., None], safe, model.available)


# --- the learner ----------------------------------------------------------------------------


@jax.jit
def init(key: chex.PRNGKey, problem: Problem, hparams: Hparams) -> State:
    """Nothing seen: every transition of a choice may have nearly all of its probability.

    Args:
      key: a PRNG key, which the state keeps; ``vmap`` over keys for many seeds.
      problem: of :func:`make_problem`.
      hparams: :class:`Hparams`.

    Returns:
      :class:`State`, no step made.

    Raises:
      ValueError: unknown `intervals`, or runs without moves.
    """
    _check(hparams)
    world = problem.model.mdp
    used = world.successor_probability > 0
    alone = used.sum(-1, keepdims=True) == 1
    least = jnp.asarray(hparams.least, world.dtype)
    lower = jnp.where(alone, 1, least) * used
    upper = jnp.where(alone, 1, 1 - least) * used
    lower, upper = with_room(lower, upper)
    won = problem.won.astype(world.dtype)
    return State(
        key=key,
        step=jnp.int32(0),
        samples=jnp.int32(0),
        counts=jnp.zeros(used.shape, jnp.int32),
        lower=lower,
        upper=upper,
        pessimistic=won,
        optimistic=1 - problem.lost.astype(world.dtype),
        best=problem.allowed,
        residual=jnp.asarray(jnp.inf, world.dtype),
    )


def step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """Some runs from the start, the intervals after them, and sweeps from the last values.

    Args:
      state: of :func:`init` or of an earlier step; unchanged.
      problem, hparams: as of :func:`init`.

    Returns:
      The next :class:`State`, and :class:`Metrics`, figures after the step.
    """
    _check(hparams)
    size = hparams.num_runs * hparams.length
    more = state.samples <= learner.MOST - size
    new = sampled(state, problem, hparams) * more
    counts = state.counts + new
    update = linear if hparams.intervals == "linear" else confident
    lower, upper = update(state, counts, new, problem, hparams)
    seen = jnp.any(new > 0, axis=-1, keepdims=True)
    seen &= jnp.sum(problem.model.mdp.successor_probability > 0, -1, keepdims=True) > 1
    state = replace(
        state,
        step=state.step + 1,
        samples=state.samples + size * more,
        counts=counts,
        lower=jnp.where(seen, lower, state.lower),
        upper=jnp.where(seen, upper, state.upper),
    )
    state = _solved(state, problem, hparams)
    return state, measure(state, problem, hparams)


run, train, run_until, train_until = learner.bind(init, step)


def measure(state: State, problem: Problem, hparams: Hparams) -> Metrics:
    """The :class:`Metrics` of a state.

    Args:
      state, problem, hparams: of a run.

    Returns:
      :class:`Metrics`, scalars.
    """
    model = problem.model
    more = state.samples <= learner.MOST - hparams.num_runs * hparams.length
    settled = (state.residual <= hparams.tolerance) & more
    return Metrics(
        samples=state.samples,
        lower=jnp.sum(model.initial * state.pessimistic),
        upper=jnp.sum(model.initial * state.optimistic),
        residual=state.residual,
        status=status_code(settled, jnp.isfinite(state.residual)),
    )


def known_within(width: chex.Numeric) -> learner.Until:
    """A condition for :func:`run_until`: the values have settled, so close to each other.

    Args:
      width: of optimistic minus pessimistic value at the start, in [0, 1]; traced.

    Returns:
      A condition, for ``until``.
    """
    return Partial(_known_within, width)


def _known_within(width: Any, before: State, after: State, metrics: Metrics) -> jax.Array:
    return (metrics.upper - metrics.lower <= width) & (metrics.status == Status.CONVERGED)


@jax.jit
def behavior(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """What is sampled, ``float[S, Q, A]``: preferred moves, and now and then any allowed one.

    Args:
      state: of one run; ``vmap`` over several.
      problem, hparams: of the run.

    Returns:
      ``float[S, Q, A]``, positive at every allowed action.
    """
    dtype = problem.model.dtype
    return pac.hat_strategy(state.best, problem.allowed, hparams.exploration).astype(dtype)


@jax.jit
def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """What was learned, ``float[S, Q, A]``: best with nature against it.

    Where the task is won almost surely it makes all allowed moves alike, and so wins almost surely.
    In an end component between it makes the best moves out, and those that stay.

    Args:
      state: of one run; ``vmap`` over several.
      problem, hparams: of the run.

    Returns:
      ``float[S, Q, A]``.
    """
    nature = jnp.full(1, -1, state.lower.dtype)
    ends = state.lower[None], state.upper[None]
    moves = _moves(problem, state.pessimistic[None], *ends, nature)[0]
    best = _backed_up(problem, moves)[..., None]
    out = problem.allowed & ~problem.staying & (moves >= best)
    used = jnp.where(problem.won[..., None], problem.allowed, out | problem.staying)
    used = jnp.where(problem.lost[..., None], problem.allowed, used)
    return used / jnp.maximum(used.sum(-1, keepdims=True), 1).astype(moves.dtype)


def guarantee(state: State, problem: Problem, confidence: float, **options: Any) -> DataGuarantee:
    """What the counts guarantee of the task, certified, on the host; however they were sampled.

    Of the graph, and of nothing else that the learner assumes. Each look has the confidence, and
    so do all looks at once.

    Args:
      state: one of them; of vmapped seeds, ``jax.tree.map(itemgetter(i), states)``.
      problem: of it.
      confidence: in (0, 1).
      options: `tolerance` and the like of
        :func:`~jaxltl.core.values.evaluation.data_guarantee.learn_guarantee`.

    Returns:
      :class:`~jaxltl.core.values.evaluation.data_guarantee.DataGuarantee`, by anytime intervals.

    Raises:
      ValueError: the confidence.
    """
    if not isinstance(problem, Problem) or not isinstance(state, State):
        raise ValueError(
            "guarantee takes a state, as init and train return it, and the problem "
            "that make_problem returned."
        )
    world = problem.model.mdp
    counts = np.asarray(state.counts)[support(world)]
    return learn_guarantee(
        world, counts, problem.model.automaton, confidence, method="anytime", **options
    )


def wins_almost_surely(problem: Problem, play: jax.Array) -> bool:
    """Whether a memoryless policy does the task almost surely wherever that is possible.

    On the graph: it stays where the task is won, and all components in which it can end there
    are accepting.

    Args:
      problem: the problem.
      play: ``float[S, Q, A]``; only what is positive counts.

    Returns:
      A truth value; on the host.
    """
    return bool(_wins(problem, play))


@jax.jit
def _wins(problem: Problem, play: jax.Array) -> jax.Array:
    model, used = problem.model, play > 0
    kept = used.any(-1) & (~used | forall_successor(model, problem.won)).all(-1)
    ends = bottom_components(model, used).inside.any(-1)
    good = kept & (~ends | accepting_bottom_components(model, used.astype(model.dtype)))
    return jnp.all(good | ~problem.won)


# --- values -------------------------------------------------------------------------------------


def _solved(state: State, problem: Problem, hparams: Hparams) -> State:
    """The values after some sweeps, and the moves that are preferred by the last of them."""
    nature = jnp.asarray([-1, 1, 1], state.lower.dtype)
    used = problem.model.mdp.successor_probability > 0
    seen = state.counts.astype(nature.dtype) + used
    share = seen / jnp.maximum(jnp.sum(seen, -1, keepdims=True), 1)
    lower = jnp.stack([state.lower, state.lower, share])
    upper = jnp.stack([state.upper, state.upper, share])

    def sweep(_: Any, now: Any) -> Any:
        values, _, _ = now
        moves = _moves(problem, values, lower, upper, nature)
        known = jax.vmap(partial(_backed_up, problem))(moves[:2])
        pace, best = _soonest(problem, hparams, moves[1], known[1], moves[2])
        change = jnp.max(jnp.abs(known - values[:2]))
        return jnp.concatenate([known, pace[None]]), best, change

    # The pace begins anew: what was hoped for once would fade slowly where runs may stay.
    begin = problem.won.astype(nature.dtype)
    values = jnp.stack([state.pessimistic, state.optimistic, begin])
    values, best, change = lax.fori_loop(
        0, hparams.sweeps, sweep, (values, state.best, state.residual)
    )
    return replace(
        state,
        pessimistic=values[0],
        optimistic=values[1],
        best=best,
        residual=change,
    )


def _moves(
    problem: Problem, values: jax.Array, lower: jax.Array, upper: jax.Array, nature: jax.Array
) -> jax.Array:
    """Each move's expectation of V values, ``float[V, S, Q, A]``.

    Args:
      problem: whose graph it is.
      values: ``float[V, S, Q]``.
      lower, upper: ``float[V, S, A, K]``.
      nature: ``float[V]``, 1 where it makes a value large, -1 where small.
    """
    world: Any = problem.model.mdp
    next_memory = problem.model.next_memory[:, :, None, None]
    reached = values[:, world.successor[:, None], next_memory]
    shape, width = reached.shape, reached.shape[-1]
    low, high = (jnp.broadcast_to(x[:, :, None], shape).reshape(-1, width) for x in (lower, upper))
    key = -nature[:, None, None, None, None] * reached
    share = chances(low, high, key.reshape(-1, width))
    return jnp.sum(share.reshape(shape) * reached, axis=-1)


def _backed_up(problem: Problem, moves: jax.Array) -> jax.Array:
    """The best move's value; that of the best way out of a component; 1 and 0 where decided."""
    out = problem.allowed & ~problem.staying
    best = jnp.max(jnp.where(out, moves, 0), axis=-1).reshape(-1)
    best = jnp.zeros_like(best).at[problem.component].max(best)
    best = jnp.minimum(take(best, problem.component), 1).reshape(problem.won.shape)
    return _decided(problem, best)


def _decided(problem: Problem, value: jax.Array) -> jax.Array:
    return jnp.where(problem.won, 1, jnp.where(problem.lost, 0, value))


def _soonest(
    problem: Problem, hparams: Hparams, moves: jax.Array, value: jax.Array, ahead: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """How soon the task may be won by moves of the best optimistic value, and which are soonest.

    By the frequencies: how to get to where there is something to hope for needs no hope itself.
    """
    slack = 64 * jnp.finfo(moves.dtype).eps
    near = problem.allowed & (problem.staying | (moves >= value[..., None] - slack))
    near = jnp.where((problem.won | problem.lost)[..., None], problem.allowed, near)
    ahead = jnp.where(near, ahead, -1)
    most = jnp.max(ahead, axis=-1)
    best = near & (ahead >= (most * (1 - slack))[..., None])
    best = jnp.where(problem.won[..., None], problem.allowed, best)
    pace = jnp.asarray(hparams.discount, moves.dtype) * jnp.maximum(most, 0)
    return _decided(problem, pace), best


def _check(hparams: Hparams) -> None:
    if hparams.intervals not in INTERVALS:
        raise ValueError(f'intervals={hparams.intervals!r}; choose "linear" or "confidence".')
    for name in ("num_runs", "length"):
        if getattr(hparams, name) < 1:
            raise ValueError(f"{name}={getattr(hparams, name)}; it must be at least 1.")
