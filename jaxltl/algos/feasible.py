"""Parameters for which a model has a property, by gradients from many starts (Heck et al. 2022).

Given a model whose probabilities and rewards are functions of parameters in a box, is there a point
at which a reachability probability or an expected reward is on the right side of a threshold? From
each start the value climbs (or falls) along its gradient, which is the implicit derivative of a
prepared solve, and stays in the box by projection. Values are measured by their logarithms, those
of probabilities by that of the odds, and coordinates are shares of the box, so that a rate means
the same everywhere. A run ends when it is past the threshold.

What floats say there is no proof: :func:`feasible` has each point that is claimed certified by the
host engine, on the model at that point, with bounds of both sides. Gradients find local optima;
that nothing was found says nothing.

Example: a head, then a tail of one coin, of which the bias is sought.

  >>> import jax, jax.numpy as jnp, numpy as np
  >>> import jaxltl as jl
  >>> from jaxltl.algos import feasible as search
  >>> chain = jl.make_sparse(None, [0, 2, 4, 5, 6], [1, 3, 2, 3, 2, 3], [0.5] * 4 + [1, 1],
  ...                        initial=[1, 0, 0, 0], label={"both": [2]})
  >>> def numbers(x):  # of each transition
  ...     p, q = x
  ...     return jnp.array([p, 1 - p, 1 - q, q, 1, 1])
  >>> model = jl.make_parametric(chain, numbers, [0.1, 0.2], [0.9, 0.8], parameters=["p", "q"])
  >>> problem = search.make_problem(model, "both", bound=">=")
  >>> hparams = search.Hparams()
  >>> state, metrics = search.train(jax.random.key(0), problem, hparams, num_steps=2)
  >>> metrics.value.shape, bool(metrics.best_value[1] > metrics.best_value[0])
  ((2,), True)
  >>> point = search.policy(state, problem, hparams)  # float[D], the best so far
  >>> low, high = search.certify(problem, point)
  >>> low <= float(state.best.value) + 1e-6 <= high + 2e-6
  True

A run is made of steps, begins where one likes, goes on from a state, and may end early:

  >>> state = search.start_at(jnp.array([0.5, 0.5]), jax.random.key(0), problem, hparams)
  >>> value, status = search.evaluate(state.parameters, problem, hparams)
  >>> value.item(), search.within(problem, 0.25, 0.5).low.tolist()
  (0.25, [0.25, 0.25])
  >>> state, metrics = search.run(state, problem, hparams, num_steps=2)  # step after step
  >>> until = lambda before, after, metrics: metrics.best_value > 0.3  # for run_until, train_until
  >>> state.step.item()  # init begins anywhere in the box
  2

Many seeds are ``jax.vmap(lambda key: train(key, problem, hparams, num_steps=...))(keys)``;
:func:`feasible` does it, and proves what it finds.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax import lax
from jax.tree_util import Partial

from jaxltl.algos.common import learner
from jaxltl.algos.common.schedules import Schedule, at
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.parametric.parametric import Ends, ParametricMDP
from jaxltl.core.models.sparse import row_reward
from jaxltl.core.pretty_print import brief, history
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.types import Status, require_shape
from jaxltl.core.validation import number, one_of, shown, whole
from jaxltl.core.values.interval.robust import width_asked
from jaxltl.core.values.prepared.prepared import Prepared, prepare, solve_prepared
from jaxltl.core.values.prepared.prepared_chain import evaluate_prepared, is_direct
from jaxltl.core.values.undiscounted.mixture import safe_ends

_FINEST = 1e-12  # the width asked for where the one that was asked for does not tell


@brief
@struct.dataclass
class Problem:
    """A question about a parametric model; made by :func:`make_problem`.

    Attributes:
      model: the model; its box may be made smaller by :func:`within`.
      prepared: the question, put in order.
      weight: ``float[S]``, the initial distribution, over which values are averaged.
      low, high, inside: ``float[D]``, the box and a point of it, in the precision of the search.
      target, stay: ``bool[S]``, where to get, and what may be passed or None.
      reward: the name of the reward, or None for a probability; static.
      objective: ``"max"`` or ``"min"``, over policies; static.
      bound: ``">="`` or ``"<="``, which side of the threshold is asked for; static.
    """

    model: ParametricMDP
    prepared: Prepared
    weight: Any
    low: Any
    high: Any
    inside: Any
    target: Any
    stay: Any
    reward: str | None = struct.field(pytree_node=False)
    objective: str = struct.field(pytree_node=False)
    bound: str = struct.field(pytree_node=False)

    @property
    def sign(self) -> float:
        """What makes the side that is asked for the larger one."""
        return 1.0 if self.bound == ">=" else -1.0


@brief
@struct.dataclass
class Hparams:
    """How to search. Numbers are traced, so new values do not recompile.

    Attributes:
      learning_rate: in shares of the box; a schedule; default 0.1.
      optimizer: ``"adam"``, ``"rmsprop"``, ``"sgd"``, or ``"sign"``, which takes the signs of the
        gradient alone; static; default ``"adam"``.
      tolerance: of the solves of decision processes, see
        :func:`~jaxltl.core.values.prepared.prepared.solve_prepared`, also for what None stands for; default
        None.
    """

    learning_rate: Schedule = 0.1
    optimizer: str = struct.field(pytree_node=False, default="adam")
    tolerance: jax.Array | float | None = None


@brief
@struct.dataclass
class Best:
    """The best point so far; NaN before there is one.

    Attributes:
      parameters: ``float[D]``.
      value: ``float[]``, a probability, or in units of the reward.

    Example:
      >>> Best(jnp.full(2, jnp.nan), jnp.array(jnp.nan)).parameters.shape
      (2,)
    """

    parameters: jax.Array
    value: jax.Array


@brief
@struct.dataclass
class State:
    """A search on its way.

    Attributes:
      key, step: the root key, and the steps made, ``int32[]``.
      parameters: ``float[D]``, where the next step looks.
      inside: ``float[D]``, the newest point at which the functions were a model.
      best: of all points seen, :class:`Best`.
      optimizer: optax's state.
    """

    key: jax.Array
    step: jax.Array
    parameters: jax.Array
    inside: jax.Array
    best: Best
    optimizer: Any


@brief(facts=partial(history, codes={"status": Status}))
@struct.dataclass
class Metrics:
    """Figures of the point before a step; scalars, of a run ``[T]``.

    Attributes:
      value: there.
      best_value: of all points seen, this one included.
      gradient_norm: of the logarithm of the value, of probabilities of the odds, with respect to
        shares of the box; Euclidean.
      status: of the solve; INVALID where the functions are no model.
    """

    value: jax.Array
    best_value: jax.Array
    gradient_norm: jax.Array
    status: jax.Array


# --- problems, on the host ------------------------------------------------------------------


def make_problem(
    model: ParametricMDP,
    target: str | chex.Array,
    *,
    bound: str,
    reward: str | None = None,
    stay: chex.Array | None = None,
    objective: str = "max",
) -> Problem:
    """A checked :class:`Problem`, on the host: for which parameters is a value past a threshold?

    Args:
      model: made by :func:`~jaxltl.core.models.parametric.parametric.make_parametric`, or by
        ``read_parametric(path).over(low, high)``.
      target: ``bool[S]``, or a label.
      bound: ``">="`` or ``"<="``: the value shall be at least or at most the threshold.
      reward: the name of a reward asks for its expected total until the target; default: for the
        probability of reaching it.
      stay: ``bool[S]``, the states that may be passed before, of probabilities.
      objective: ``"max"`` or ``"min"`` over the policies of a decision process: with ``"max"``,
        ``">="`` asks for some policy and ``"<="`` for all of them. Of no effect on a chain.

    Returns:
      :class:`Problem`.

    Raises:
      ValueError: an unknown bound, objective, reward or label, or a shape that does not fit; or
        the reward is infinite at every point, as the target is not reached almost surely.
    """
    if not isinstance(bound, str) or bound not in (">=", "<="):
        raise ValueError(f'bound={shown(bound)}; it must be ">=" or "<=".')
    one_of("objective", objective, ("max", "min"))
    if reward is not None and not isinstance(reward, str):
        raise ValueError(f"reward is {shown(reward)}; give the name of a reward of the model.")
    if not isinstance(model, ParametricMDP):
        raise ValueError(
            f"{type(model).__name__} has no box of parameters; give what "
            "make_parametric makes, or read_parametric(path).over(low, high)."
        )
    here = model.model
    target = here.states_where(target) if isinstance(target, str) else np.asarray(target)
    require_shape("target", target, (here.num_states,))
    target = target.astype(bool)
    if here.is_chain:
        objective = "max"  # with it a reward may become zero
    if reward is not None:
        row_reward(here, reward)  # refuses an unknown name
    prepared = prepare(here, target, stay=stay, reward=reward, objective=objective)
    stay = None if stay is None else np.asarray(stay, bool)
    weight, box = np.asarray(here.initial, np.float64), (model.low, model.high, model.inside)
    found = Problem(model, prepared, weight, *box, target, stay, reward, objective, bound)
    if reward is not None:
        value = _bounds(found, here, 1e-3)[1]
        if np.isinf(value):
            raise ValueError(
                "the expected reward is infinite at every point: from some initial state the "
                "target is not reached almost surely"
                + ("." if here.is_chain else f' (objective="{objective}").')
            )
    return _rounded_inward(found)


def within(problem: Problem, low: Ends, high: Ends) -> Problem:
    """The same question over a smaller box; nothing is compiled anew.

    Args:
      problem: the question.
      low, high: as of :func:`~jaxltl.core.models.parametric.parametric.make_parametric`.

    Returns:
      :class:`Problem`.

    Raises:
      ValueError: the box is none, or reaches out of the problem's.
    """
    require_problem(problem)
    return _rounded_inward(replace(problem, model=problem.model.within(low, high)))


def require_problem(problem: Any) -> None:
    """Raises ValueError unless a problem is one.

    Args:
      problem: anything.

    Raises:
      ValueError: it is none of :func:`make_problem`.

    Example:
      >>> require_problem(0.5)
      Traceback (most recent call last):
        ...
      ValueError: problem is 0.5; give what make_problem returns.
    """
    if not isinstance(problem, Problem):
        raise ValueError(f"problem is {shown(problem)}; give what make_problem returns.")


def _rounded_inward(problem: Problem) -> Problem:
    """The box in the precision of the search."""
    dtype = np.dtype(jnp.zeros(()).dtype)
    model = problem.model
    low, high, inside = (x.astype(dtype) for x in (model.low, model.high, model.inside))
    low = np.where(low < model.low, np.nextafter(low, dtype.type(np.inf)), low)
    high = np.where(high > model.high, np.nextafter(high, dtype.type(-np.inf)), high)
    if not (low < high).all():
        d = int(np.flatnonzero(~(low < high))[0])
        raise ValueError(
            f"the interval of {model.parameters[d]} has no two numbers in {dtype}; widen it, or "
            "use float64."
        )
    inside = np.clip(inside, low, high)
    low, high, inside, weight = to_jax(
        (low, high, inside, np.asarray(problem.weight).astype(dtype))
    )
    return replace(problem, low=low, high=high, inside=inside, weight=weight)


# --- the search -----------------------------------------------------------------------------


def evaluate(parameters: jax.Array, problem: Problem, hparams: Hparams) -> Any:
    """The value at a point: the mean over the initial distribution.

    Args:
      parameters: ``float[D]``.
      problem, hparams: what and how.

    Returns:
      The value ``float[]`` and a status ``int32[]``, ``INVALID`` where the functions are no model;
      of decision processes the solves have bounds of their own, of chains they have none
      (``UNCERTIFIED``). Differentiable in the parameters; for an optimum over policies with the
      optimal policy held fixed.
    """
    probability, rewards = problem.model.numbers(parameters)
    prepared = problem.prepared
    given = {
        "probability": probability,
        "reward": None if problem.reward is None else rewards.get(problem.reward),
    }
    if _is_chain(prepared):
        value, status = evaluate_prepared(prepared, **given)
    else:
        found = solve_prepared(prepared, tolerance=hparams.tolerance, **given)
        value, status = found.value, found.status
    start = problem.weight > 0
    return jnp.sum(problem.weight * jnp.where(start, value, 0)), status


def _is_chain(prepared: Prepared) -> bool:
    return prepared.num_rows == prepared.num_states


def _takes_turns(prepared: Prepared) -> bool:
    """Whether how much work a solve is depends on the numbers."""
    return not is_direct(prepared) if _is_chain(prepared) else prepared.cyclic


def init(key: chex.PRNGKey, problem: Problem, hparams: Hparams) -> State:
    """A point drawn uniformly from the box.

    Args:
      key: a PRNG key, which the state keeps; ``vmap`` over keys for many seeds.
      problem: of :func:`make_problem`.
      hparams: :class:`Hparams`.

    Returns:
      :class:`State`, no step made.
    """
    share = jax.random.uniform(learner.init_key(key), problem.low.shape, problem.low.dtype)
    return start_at(problem.low + share * (problem.high - problem.low), key, problem, hparams)


def start_at(parameters: jax.Array, key: chex.PRNGKey, problem: Problem, hparams: Hparams) -> State:
    """A search that starts at a point, ``float[D]``, or at the nearest of the box.

    Args:
      parameters: ``float[D]``.
      key, problem, hparams: as of :func:`init`.

    Returns:
      :class:`State`, no step made.
    """
    point = jnp.clip(jnp.asarray(parameters, problem.low.dtype), problem.low, problem.high)
    best = Best(jnp.full_like(point, jnp.nan), jnp.full((), jnp.nan, point.dtype))
    optimizer = learner.strong(_optimizer(hparams, 0).init(point))
    return State(key, jnp.int32(0), point, problem.inside, best, optimizer)


def _optimizer(hparams: Hparams, step: Any) -> optax.GradientTransformationExtraArgs:
    rate = at(hparams.learning_rate, step)
    if hparams.optimizer == "sign":
        return optax.with_extra_args_support(
            optax.chain(optax.scale_by_sign(), optax.scale_by_learning_rate(rate))
        )
    if hparams.optimizer == "lbfgs":
        raise ValueError('optimizer="lbfgs" leaves the box; choose adam, rmsprop, sgd or sign.')
    return learner.optimizer(hparams.optimizer, rate)


def step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """One step along the gradient, projected to the box; back half the way from where no model is.

    Points where a solve failed count as such too.

    Args:
      state: of :func:`init` or of an earlier step; unchanged.
      problem, hparams: as of :func:`init`.

    Returns:
      The next :class:`State`, and :class:`Metrics`, figures of the point before the step.
    """
    x = state.parameters
    size = problem.high - problem.low

    def loss(x: jax.Array) -> tuple[jax.Array, Any]:
        value, status = evaluate(x, problem, hparams)
        return -problem.sign * value, (value, status)

    slope, (value, status) = jax.grad(loss, has_aux=True)(x)
    slope = slope * size / _unit(problem, value)
    good = (status < Status.NONFINITE) & jnp.isfinite(value) & jnp.all(jnp.isfinite(slope))
    updates, optimizer = _optimizer(hparams, state.step).update(
        jnp.where(good, slope, 0), state.optimizer, x
    )
    moved = jnp.clip(x + updates * size, problem.low, problem.high)
    back = x + (state.inside - x) / 2
    gain = problem.sign * (value - state.best.value)
    better = good & ~(gain <= 0)  # also if there was none
    best = learner.choose(better, Best(x, value), state.best)
    after = State(
        state.key,
        state.step + 1,
        jnp.where(good, moved, back),
        jnp.where(good, x, state.inside),
        best,
        learner.choose(good, optimizer, state.optimizer),
    )
    status = jnp.where(good | (status >= Status.NONFINITE), status, Status.NONFINITE)
    return after, Metrics(value, best.value, optax.tree.norm(slope), status.astype(jnp.int32))


def _unit(problem: Problem, value: jax.Array) -> jax.Array:
    """What the value is measured in: a gradient by it is that of the logarithm of the value.

    Of probabilities, of the odds. So where values are 1e-30, or 1 - 1e-9, steps are of a size.
    """
    limits = jnp.finfo(value.dtype)
    unit = jnp.abs(value)
    if problem.reward is None:
        unit = unit * jnp.maximum(1 - value, 1e3 * limits.eps)
    return jnp.maximum(unit, limits.tiny)


run, train, run_until, train_until = learner.bind(init, step)


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """What was found: the parameters ``float[D]`` of the best value; NaN before there is one.

    Args:
      state: of one run; ``vmap`` over several.
      problem, hparams: of the run.

    Returns:
      ``float[D]``, in the order of ``problem.model.parameters``.
    """
    del problem, hparams
    return state.best.parameters


# --- many starts, and what is proven ----------------------------------------------------------


@brief(codes={"status": Status})
@struct.dataclass
class Feasible:
    """What searches from N starts found.

    Attributes:
      parameters: ``float64[N, D]``, the best point of each; NaN if the functions were a model
        nowhere.
      value: ``float64[N]``, there, as the search found it.
      lower, upper: ``float64[N]``, certified bounds of the value of the model at that point, where
        the threshold is claimed to be met; else what is known of any value, 0 and 1 or infinity.
      feasible: ``bool[N]``, whether these bounds prove it.
      num_steps: ``int32[N]``, of the searches.
      status: ``int32[N]``: CONVERGED if it is proven; UNCERTIFIED if it seems met and enough others
        were proven; PRECISION if it seems met and the bounds do not tell; MAX_STEPS if the search
        was stopped; INVALID or NONFINITE if nothing was found.
      names: of the parameters, static.
    """

    parameters: np.ndarray
    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    feasible: np.ndarray
    num_steps: np.ndarray
    status: np.ndarray
    names: tuple[str, ...] = struct.field(pytree_node=False)

    def valuation(self, i: int | None = None) -> dict[str, float]:
        """The parameters of one start by name; default the first that is feasible.

        Raises:
          ValueError: none is.
        """
        if i is None:
            if not self.feasible.any():
                raise ValueError("no parameters were proven feasible; read value and status.")
            i = int(np.argmax(self.feasible))
        return dict(zip(self.names, self.parameters[i].tolist(), strict=True))


def feasible(
    problem: Problem,
    threshold: float,
    *,
    starts: int | chex.Array = 100,
    key: chex.PRNGKey | None = None,
    hparams: Hparams | None = None,
    num_steps: int = 200,
    tolerance: float = 1e-6,
    enough: int | None = None,
) -> Feasible:
    """Parameters for which a value is past a threshold, from many starts, proven.

    Is there a point x of the box with ``V(x) >= threshold`` (or ``<=``)? All starts are one
    compiled program, in which each ends for itself; new thresholds, boxes and numbers of steps
    do not recompile it. Then each point at which the search saw the threshold met is certified by
    the host engine, on the model at exactly that point where the model is read from a file.

    Args:
      problem: the question.
      threshold: finite.
      starts: how many random starts, or where to start, ``float[N, D]``.
      key: of the random starts; default ``jax.random.key(0)``.
      hparams: how to search.
      num_steps: steps at most of each.
      tolerance: the width of the certified bounds, of rewards as a share.
      enough: how many to prove, those first whose values are the best; default all.

    Returns:
      :class:`Feasible`; `feasible` only where the certified bound meets the threshold.

    Raises:
      ValueError: the threshold is not finite, or starts are none or not in the box.

    Example:
      >>> from jaxltl import make_parametric, make_sparse
      >>> twice = make_sparse(None, [0, 2, 4, 5, 6], [1, 3, 2, 3, 2, 3], [0.5] * 4 + [1, 1],
      ...                     initial=[1, 0, 0, 0])
      >>> def numbers(x):  # head, then tail
      ...     p = x[0]
      ...     return jnp.array([p, 1 - p, 1 - p, p, 1, 1])
      >>> model = make_parametric(twice, numbers, [0.01], [0.99], parameters=["p"])
      >>> problem = make_problem(model, np.arange(4) == 2, bound=">=")
      >>> found = feasible(problem, 0.2499, starts=4)
      >>> found.feasible.all().item(), round(found.valuation()["p"], 1)
      (True, 0.5)
      >>> feasible(problem, 0.2501, starts=4).feasible.any().item()
      False
    """
    require_problem(problem)
    threshold = number("threshold", threshold)
    tolerance = width_asked(tolerance)
    hparams = Hparams() if hparams is None else hparams
    if not isinstance(hparams, Hparams):
        raise ValueError(f"hparams is {shown(hparams)}; give Hparams.")
    key = jax.random.key(0) if key is None else key
    # A little further, so that rounding does not decide.
    beyond = 1e3 * float(jnp.finfo(problem.low.dtype).eps) * abs(threshold)
    goal = np.asarray(threshold + problem.sign * beyond, problem.low.dtype)
    most = np.int32(whole("num_steps", num_steps, least=1, most=learner.MOST))
    enough = None if enough is None else whole("enough", enough, least=1)
    points = None
    if np.ndim(starts) == 0:
        keys = jax.random.split(key, whole("starts", starts, least=1, most=learner.MOST))
    else:
        points = problem.model.inside_of("start", starts).astype(problem.low.dtype)
        keys = jax.random.split(key, len(points))
    # Which model is proven is of no concern to the search.
    numbers = ParametricMDP(None, problem.model.numbers, None, None, None, ())
    lean = replace(problem, target=None, stay=None, model=numbers)
    found = _search(keys, points, lean, hparams, goal, most)
    return _proven(problem, float(threshold), found, tolerance, enough)


@jax.jit
def _search(
    keys: Any, points: Any, problem: Problem, hparams: Hparams, goal: jax.Array, most: jax.Array
) -> learner.Learned:
    """All starts: side by side, or in turn where the amount of work depends on the start."""

    until = Partial(_met, problem.sign * goal, problem.sign)

    def one(key: Any, point: Any) -> learner.Learned:
        state = init(key, problem, hparams)
        if point is not None:
            state = start_at(point, key, problem, hparams)
        return run_until(state, problem, hparams, until=until, num_steps=most)

    if _takes_turns(problem.prepared):
        return lax.map(lambda given: one(*given), (keys, points))
    return jax.vmap(one)(keys, points)


def _met(goal: Any, sign: Any, before: Any, after: Any, metrics: Any) -> jax.Array:
    return sign * metrics.best_value >= goal


def _proven(
    problem: Problem,
    threshold: float,
    found: learner.Learned,
    tolerance: float,
    enough: int | None = None,
) -> Feasible:
    """Certified bounds of what was claimed."""
    state = found.state
    dtype = state.best.value.dtype
    points, value, steps, last = (
        np.asarray(x)
        for x in (state.best.parameters, state.best.value, found.num_steps, found.metrics.status)
    )
    points, value = points.astype(np.float64), value.astype(np.float64)
    slack = max(1e-6, 1e4 * float(jnp.finfo(dtype).eps))
    if problem.reward is None:
        value = np.clip(value, 0, 1)
    off = problem.sign * (threshold - value)
    claimed = np.flatnonzero(off <= slack * max(abs(threshold), slack))
    claimed = claimed[np.argsort(off[claimed], kind="stable")]
    lower = np.zeros(value.size)
    upper = np.full(value.size, 1.0 if problem.reward is None else np.inf)
    status = np.full(value.size, Status.MAX_STEPS, np.int32)
    status = np.where(np.isnan(value), np.maximum(last, Status.NONFINITE), status)
    status[claimed] = Status.UNCERTIFIED
    certain = np.zeros(value.size, bool)
    for i in claimed:
        if enough is not None and certain.sum() >= enough:
            break
        try:
            bounds = certify(problem, points[i], tolerance=tolerance)
            if bounds[0] < threshold < bounds[1]:
                bounds = certify(problem, points[i], tolerance=_FINEST)
        except ValueError:  # not what it seemed in the precision of the search
            status[i] = Status.INVALID
            continue
        lower[i], upper[i] = bounds
        certain[i] = bounds[0] >= threshold if problem.sign > 0 else bounds[1] <= threshold
        between = bounds[0] < threshold < bounds[1]
        status[i] = Status.PRECISION if between else Status.MAX_STEPS
    status = np.where(certain, Status.CONVERGED, status).astype(np.int32)
    return Feasible(points, value, lower, upper, certain, steps, status, problem.model.parameters)


def certify(
    problem: Problem, parameters: chex.Array, *, tolerance: float = 1e-6
) -> tuple[float, float]:
    """Bounds of the value at a point of the box, proven by the host engine, rounding included.

    Of a model that is read from a file they hold for its functions at exactly this point; of one
    whose numbers a JAX function computes, for the model with these numbers.

    Args:
      problem: the question.
      parameters: ``float[D]``, or a number for each name.
      tolerance: the width asked for, of rewards as a share of the value.

    Returns:
      The lower and the upper bound.

    Raises:
      ValueError: the point is not in the box, or the functions are no model there.
    """
    require_problem(problem)
    return _bounds(problem, problem.model.at(parameters), width_asked(tolerance))


def _bounds(problem: Problem, model: Any, tolerance: float) -> tuple[float, float]:
    """Bounds of the mean over the initial distribution of a model."""
    given: dict[str, Any] = {
        "maximize": problem.objective == "max",
        "tolerance": tolerance,
        "depth": problem.model.roundings,
    }
    if problem.reward is None:
        found = optimal.reachability(model.host, problem.target, stay=problem.stay, **given)
    else:
        earned = row_reward(model, problem.reward)
        found = optimal.total_reward(model.host, earned, problem.target, **given)
    return safe_ends(model, found, highest=1.0 if problem.reward is None else np.inf)
