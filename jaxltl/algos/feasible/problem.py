"""Threshold questions about parametric Markov models, and certified values at points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxltl.core import struct, validation
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.parametric.parametric import Ends, ParametricMDP
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import SparseMDP, choice_reward
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.types import require_states
from jaxltl.core.values.engine.state_quantities import safe_ends
from jaxltl.core.values.interval.robust import width_asked
from jaxltl.core.values.prepared.prepared import Prepared, prepare


@struct.dataclass
class Problem:
    """A threshold question about a parametric model; made by :func:`make_problem`.

    Attributes:
      model: the model, with its box.
      prepared: the preprocessed question.
      weight: ``float[S]``, the initial distribution.
      low, high, inside: ``float[D]``, the box and a point in it, in the precision of the search.
      target, stay: ``bool[S]``, the target states, and the states allowed before them or None.
      reward: name of the reward, or None for a probability; static.
      objective: ``"max"`` or ``"min"``, over policies; static.
      bound: ``">="`` or ``"<="``, how the value is compared with the threshold; static.
    """

    model: ParametricMDP
    prepared: Prepared
    weight: Array
    low: Array
    high: Array
    inside: Array
    target: Array
    stay: Array
    reward: str | None = struct.field(pytree_node=False)
    objective: str = struct.field(pytree_node=False)
    bound: str = struct.field(pytree_node=False)

    @property
    def sign(self) -> float:
        """1 if the value is to be large, -1 if small."""
        return 1.0 if self.bound == ">=" else -1.0

    @property
    def highest(self) -> float:
        """The trivial upper bound: 1 of a probability, infinity of a reward."""
        return 1.0 if self.reward is None else np.inf


def make_problem(
    model: ParametricMDP,
    target: str | ArrayLike,
    *,
    bound: str,
    reward: str | None = None,
    stay: ArrayLike | None = None,
    objective: str = "max",
) -> Problem:
    """A checked :class:`Problem`.

    Args:
      model: of ``make_parametric``, or ``read_parametric(path).over(low, high)``.
      target: ``bool[S]``, or a label.
      bound: ``">="`` or ``"<="``: the value is to be at least or at most the threshold.
      reward: name of the reward, for its expected total until the target; default: the probability of
        reaching the target.
      stay: ``bool[S]``, the states allowed before the target, of probabilities only.
      objective: ``"max"`` or ``"min"`` over policies; ``">="`` with ``"max"`` asks for some policy,
        ``"<="`` for all.

    Raises:
      ValueError: an unknown bound, objective, reward or label, a wrong shape, or a reward that is
        infinite at every point because the target is not reached almost surely.
    """
    if not isinstance(bound, str) or bound not in (">=", "<="):
        raise ValueError(f'bound={validation.shorten(bound)}; it must be ">=" or "<=".')
    validation.choice("objective", objective, ("max", "min"))
    if reward is not None and not isinstance(reward, str):
        raise ValueError(
            f"reward is {validation.shorten(reward)}; give the name of a reward of the model."
        )
    if not isinstance(model, ParametricMDP):
        raise ValueError(
            f"{type(model).__name__} has no box of parameters; give what "
            "make_parametric makes, or read_parametric(path).over(low, high)."
        )
    here = model.model
    target = here.states_with_label(target) if isinstance(target, str) else np.asarray(target)
    require_states("target", target, (here.num_states,))
    target = target.astype(bool)
    if here.is_chain:
        objective = "max"  # which allows rewards that become zero
    if reward is not None:
        choice_reward(here, reward)  # raises for an unknown name
    problem = Problem(
        model=model,
        prepared=cast(
            Prepared, prepare(here, target, stay=stay, reward=reward, objective=objective)
        ),
        weight=np.asarray(here.initial, np.float64),
        low=model.low,
        high=model.high,
        inside=model.inside,
        target=target,
        stay=None if stay is None else np.asarray(stay, bool),
        reward=reward,
        objective=objective,
        bound=bound,
    )
    if reward is not None and np.isinf(_bounds(problem, here, 1e-3)[1]):
        raise ValueError(
            "the expected reward is infinite at every point: from some initial state the "
            "target is not reached almost surely"
            + ("." if here.is_chain else f' (objective="{objective}").')
        )
    return _in_search_precision(problem)


def within(problem: Problem, low: Ends, high: Ends) -> Problem:
    """The `problem` over a smaller box, from `low` to `high`, without recompilation.

    Raises:
      ValueError: the box is empty, or not contained in the problem's.
    """
    require_problem(problem)
    return _in_search_precision(replace(problem, model=problem.model.within(low, high)))


def require_problem(problem: object) -> None:
    """Raises ValueError unless `problem` is a :class:`Problem`.

    Raises:
      ValueError: it is something else.

    >>> require_problem(0.5)
    Traceback (most recent call last):
    ValueError: problem is 0.5; give what make_problem returns.
    """
    if not isinstance(problem, Problem):
        raise ValueError(
            f"problem is {validation.shorten(problem)}; give what make_problem returns."
        )


def _in_search_precision(problem: Problem) -> Problem:
    """The box rounded inward to JAX's default precision."""
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
    inside, weight = np.clip(inside, low, high), np.asarray(problem.weight).astype(dtype)
    low, high, inside, weight = to_jax((low, high, inside, weight))
    return replace(problem, low=low, high=high, inside=inside, weight=weight)


def certify(
    problem: Problem, parameters: ArrayLike | Mapping[str, float], *, tolerance: float = 1e-6
) -> tuple[float, float]:
    """The certified lower and upper bound of the value of a `problem` at `parameters` of the box.

    Rounding is included. For a model read from a file they bound the value of its functions at
    exactly this point, for a JAX function that of the model with the computed numbers. The
    `tolerance` is the width of the bounds, for rewards relative to the value.

    Raises:
      ValueError: the point is outside of the box, or the functions give no model there.
    """
    require_problem(problem)
    return _bounds(problem, problem.model.at(parameters), width_asked(tolerance))


def _bounds(problem: Problem, model: SparseMDP, tolerance: float) -> tuple[float, float]:
    """Certified bounds of the mean over the initial distribution of a model."""
    options: dict[str, Any] = {
        "maximize": problem.objective == "max",
        "tolerance": tolerance,
        "depth": problem.model.roundings,
    }
    if problem.reward is None:
        found = optimal.reachability(model.host, problem.target, stay=problem.stay, **options)
    else:
        earned = choice_reward(model, problem.reward)
        found = optimal.total_reward(model.host, earned, problem.target, **options)
    return safe_ends(model, found, highest=problem.highest)
