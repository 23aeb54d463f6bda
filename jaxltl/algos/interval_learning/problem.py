"""Problems of robust anytime learning: a product and its preprocessing; settings and state."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos.common.play import cumulative
from jaxltl.algos.common.settings import COUNT, Number, RunState, static, traced
from jaxltl.core import struct
from jaxltl.core.automata.translate import Task
from jaxltl.core.graphs.attractor import almost_surely_reaching, attractor
from jaxltl.core.graphs.end_components import Accepting, accepting_end_components, end_components
from jaxltl.core.models import forall_successor, to_padded, to_sparse
from jaxltl.core.models.game import as_game
from jaxltl.core.models.mdp import support
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.product import Product, product
from jaxltl.core.models.protocols import Model
from jaxltl.core.validation import Range


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
      start_table: ``uint32[S]``, the initial distribution as cumulative weights.
      num_claims: ``int[]``, number of unknown probabilities.
    """

    model: Product
    winning: jax.Array
    losing: jax.Array
    allowed: jax.Array
    component: jax.Array
    staying: jax.Array
    start_table: jax.Array
    num_claims: jax.Array


def make_problem(world: Model, task: Task) -> Problem:
    """A checked :class:`Problem`: the product with the task, and its qualitative preprocessing.

    Args:
      world: an MDP or a sparse model; its labels, start and graph are known to the learner.
      task: a formula, its text, or an automaton over the letters that occur. To make a probability
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
    model = product(padded, task, label_on="exit")
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
        start_table=to_jax(np.asarray(cumulative(np.asarray(padded.initial, float)))),
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
    confidence: Number = traced(Range(0, 1, open_below=True, open_above=True), default=0.9)
    least: Number = traced(Range(0, 1, open_below=True), default=1e-4)
    strength: Number = traced(Range(0, open_below=True, open_above=True), default=5.0)
    most_strength: Number = traced(Range(0, open_below=True, open_above=True), default=10.0)
    exploration: Number = traced(Range(0, 1, open_below=True), default=0.1)
    restart: Number = traced(Range(0, 1), default=0.05)
    discount: Number = traced(Range(0, 1, open_below=True, open_above=True), default=0.99)
    sweeps: Number = traced(Range(1), default=40)
    tolerance: Number = traced(Range(0, open_above=True), default=1e-4)
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


@struct.metrics
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
