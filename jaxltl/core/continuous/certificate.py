"""Certificates of policies in continuous worlds: bounds of satisfaction probabilities by cell."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from flax.errors import FlaxError
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.continuous.abstraction import (
    ALMOST_SURE,
    ITERATED,
    SURE,
    Abstraction,
    Bounds,
    Limits,
)
from jaxltl.core.continuous.dynamics import Dynamics, Step
from jaxltl.core.continuous.grid import Grid, make_grid
from jaxltl.core.continuous.learned_policy import Policy, StatePolicy, learned_policy
from jaxltl.core.environments.environment import traced
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.pretty_print import brief, rounded_outward
from jaxltl.core.status import Status

HOW = {SURE: "surely", ALMOST_SURE: "almost surely", ITERATED: "by value iteration"}
FIRST_CELLS = 20_000  # of the default grid; finer grids follow
_BYTES = 400  # of memory for a cell and action, about
PAIRS = 2**24  # of cells and actions on one grid


def _facts(certificate: Certificate) -> Iterator[str]:
    lower, upper = certificate.bounds_text()
    yield f"{certificate.formula}"
    yield f"initial states: {lower} to {upper}"
    yield f"{certificate.grid.num_cells:,} cells"
    yield certificate.status.name


@brief(facts=_facts)
@dataclass(frozen=True, eq=False)
class Certificate:
    """Bounds of the probability that a formula holds from each cell, under one policy.

    Attributes:
      grid: cells of the domain.
      lower, upper: ``float64[C]``, bounds for all states of a cell as the initial state.
      how: ``int8[C]``: 3 where the formula holds surely (for every noise in its bounds), 2 with
        probability 1, 1 by value iteration, 0 without a proof; see :meth:`summary`.
      initial: ``bool[C]``, cells that meet the initial states.
      status: ``CONVERGED`` if the bounds of all initial states are as narrow as the tolerance, or
        decide the threshold; ``MAX_STEPS`` otherwise.
      seconds: wall time by stage.
      formula: text of the formula.

    Example:
      >>> from jaxltl.core.continuous import make_dynamics
      >>> world = make_dynamics(
      ...     lambda x, u, w: x / 2, domain=([-1.0], [1.0]), labels={"middle": ([-0.1], [0.1])})
      >>> proof = certify_policy(world, lambda x: jnp.zeros(0), "F G middle", cells=[40])
      >>> [float(x) for x in proof.at([0.7])], int(proof.how.min())
      ([1.0, 1.0], 3)
    """

    grid: Grid
    lower: Floats
    upper: Floats
    how: Integers
    initial: Booleans
    status: Status
    seconds: dict[str, float]
    formula: str

    @property
    def initial_bounds(self) -> tuple[float, float]:
        """Least lower and least upper bound over the cells of initial states.

        The satisfaction probability is at least the first from every initial state, and at most the
        second from some initial cell.
        """
        return float(self.lower[self.initial].min()), float(self.upper[self.initial].min())

    def bounds_text(self) -> tuple[str, str]:
        """:attr:`initial_bounds` with seven digits, rounded outward."""
        lower, upper = self.initial_bounds
        return rounded_outward(lower, False, 7), rounded_outward(upper, True, 7)

    def at(self, state: ArrayLike) -> tuple[Floats, Floats]:
        """Lower and upper bounds for initial states ``float[..., n]``; 0 and 1 outside the domain."""
        cell = self.grid.locate(np.asarray(state, np.float64))
        inside = cell >= 0
        return np.where(inside, self.lower[cell], 0.0), np.where(inside, self.upper[cell], 1.0)

    def summary(self) -> str:
        """The result in one paragraph: bounds, how they were proven, and the time by stage."""
        lower, upper = self.bounds_text()
        count = int(self.initial.sum())
        shares = [
            f"{int((self.how[self.initial] == key).sum())} {text}" for key, text in HOW.items()
        ]
        stages = ", ".join(f"{name} {x:.2g} s" for name, x in self.seconds.items())
        return (
            f"{self.formula}: satisfied with probability at least {lower} from every initial state "
            f"(least upper bound {upper}). Of {count:,} initial cells: {', '.join(shares)}. "
            f"Time: {stages}."
        )


class ProofOptions(TypedDict, total=False):
    """Options of proofs.

    Attributes:
      cells: number of cells of the first grid along each axis; default: about 20,000 in all.
      tolerance: width of the bounds of initial states at which refinement stops; default 1e-3.
      threshold: stop as soon as the lower bounds of all initial states reach it, or the upper bound of
        one of them is below; default None.
      max_cells: of the finest grid; default 2^20.
      max_sweeps: of value iteration on one grid; default 1,000.
      upper: False to skip upper bounds.
      report: function that is called with lines of progress.
    """

    cells: Sequence[int]
    tolerance: float
    threshold: float | None
    max_cells: int
    max_sweeps: int
    upper: bool
    report: Callable[[str], None]


def certify_policy(
    dynamics: Dynamics,
    policy: Policy,
    formula: str | Formula,
    **options: Unpack[ProofOptions],
) -> Certificate:
    """Certified bounds of the probability that a policy satisfies a formula, for each cell.

    The successors of each cell are enclosed (:func:`jaxltl.enclose`), noise included. Sets of cells
    from which the formula holds for every noise, then with probability 1, are nested fixed points in
    the product with the formula's automaton; bounds elsewhere are reachability probabilities of these
    sets in an interval Markov chain whose probabilities are products of factors of each coordinate.
    Upper bounds are those of the negated formula. Cells are halved until the bounds of the initial
    states are narrow, or until an interrupt (``KeyboardInterrupt``), after which the bounds of the
    grid before are returned with the status ``MAX_STEPS``.

    Args:
      dynamics: the world, of :func:`make_dynamics`.
      policy: deterministic, and of the state alone: a JAX function ``float[n] -> float[m]``, or what
        :func:`state_policy` accepts: a flax module with its parameters, or the agent of a learner in
        these dynamics or in the task environment of this formula.
      formula: any LTL formula over the labels.
      options: see :class:`ProofOptions`.

    Returns:
      :class:`Certificate`. Bounds hold for real numbers: rounding of this computation is included,
      that of the controller's own arithmetic is not.

    Raises:
      ValueError: a policy or a step with a primitive that has no enclosure, actions of another shape,
        a proposition that is no label, or a grid beyond `max_cells`.

    Example:
      >>> from jaxltl.core.continuous import make_dynamics, triangular
      >>> world = make_dynamics(
      ...     lambda x, u, w: x + u + 0.02 * w, domain=([-1.0], [1.0]), noise=triangular(-1.0, 1.0),
      ...     actions=([-0.5], [0.5]), labels={"goal": ([-0.1], [0.1])}, initial=([0.5], [0.6]))
      >>> proof = certify_policy(world, lambda x: -0.2 * x, "F goal", cells=[100])
      >>> proof.initial_bounds, proof.status.name
      ((1.0, 1.0), 'CONVERGED')
    """
    validation.keywords("certify_policy", options, ProofOptions)
    validation.instance("dynamics", dynamics, Dynamics, "those of make_dynamics")
    step = closed_loop(dynamics, learned_policy(policy, dynamics, formula))
    return prove(dynamics, formula, step, np.zeros((1, 1)), options)[0]


def prove(
    dynamics: Dynamics, formula: str | Formula, step: Step, actions: Floats, options: ProofOptions
) -> tuple[Certificate, Abstraction, Bounds]:
    """The certificate of a step under the best actions of a grid, and its parts."""
    settings: dict[str, Any] = {name: x for name, x in options.items() if name != "cells"}
    settings["tolerance"] = validation.finite_number("tolerance", settings.get("tolerance", 1e-3))
    if settings.get("threshold") is not None:
        settings["threshold"] = validation.finite_number("threshold", settings["threshold"])
    limits = Limits(**settings)
    grid = first_grid(dynamics, options.get("cells"), limits.max_cells, len(actions))
    limits = replace(limits, max_cells=min(limits.max_cells, PAIRS // len(actions)))
    abstraction = Abstraction(dynamics, formula, step, actions, limits)
    bounds = abstraction.bounds(grid)
    lower, upper = bounds.initial_bounds()
    how = bounds.task.initial(bounds.how.astype(np.float64)).astype(np.int8)
    ends = lower[bounds.initial], upper[bounds.initial]
    decided = (ends[1] - ends[0]).max() <= limits.tolerance or limits.decides(*ends)
    status = Status.CONVERGED if decided else Status.MAX_STEPS
    seconds, text = abstraction.seconds, str(formula)
    certificate = Certificate(bounds.grid, lower, upper, how, bounds.initial, status, seconds, text)
    return certificate, abstraction, bounds


def closed_loop(dynamics: Dynamics, policy: StatePolicy) -> Callable[..., jax.Array]:
    """The step of a world under a policy; checks the shape of actions."""
    n, m = dynamics.num_states, dynamics.num_actions
    try:
        action_spec = traced("policy", policy, jax.ShapeDtypeStruct((n,), jnp.float32))
    except (TypeError, FlaxError) as error:  # shapes that do not fit
        message = " ".join(f"policy fails with a state float[{n}]: {error}".split())
        raise ValueError(f"{message}; give a function of a state float[{n}].") from error
    if tuple(getattr(action_spec, "shape", ("?",))) != (m,):
        raise ValueError(
            f"policy returns an array of shape {list(getattr(action_spec, 'shape', ()))} for a state of {n} "
            f"coordinates; return float[{m}], an action."
        )

    def step(state: jax.Array, _: jax.Array, noise: jax.Array) -> jax.Array:
        action = policy(state)
        if isinstance(dynamics.actions, tuple):
            action = jnp.clip(action, *(jnp.asarray(x, action.dtype) for x in dynamics.actions))
        return dynamics.step(state, action, noise)

    return step


def first_grid(
    dynamics: Dynamics, cells: Sequence[int] | None, max_cells: int, num_actions: int = 1
) -> Grid:
    """The first grid, whose edges include those of the labels and of the initial boxes."""
    n = dynamics.num_states
    if cells is None:
        cells = (max(int(FIRST_CELLS ** (1 / n)), 2),) * n
    breakpoints = []
    for axis in range(n):
        edges = np.concatenate([[], *(r.breakpoints(axis) for r in dynamics.labels.values())])
        # Initial boxes are closed: an edge beyond the upper one saves the cells behind it.
        ends = dynamics.initial.high[:, axis]
        ends = np.nextafter(ends[~np.isin(ends, edges)], np.inf)
        breakpoints.append(np.unique([*edges, *dynamics.initial.low[:, axis], *ends]))
    shape = tuple(int(k) for k in np.atleast_1d(cells))
    count = int(np.prod([float(k) for k in shape]))
    limit = min(max_cells, PAIRS // num_actions)
    if count > limit:
        remedy = f"or raise max_cells={max_cells:,}" if limit == max_cells else "or fewer actions"
        raise ValueError(
            f"cells={shape} are {count:,} cells, which take about "
            f"{count * num_actions * _BYTES / 2**30:.3g} GiB with {num_actions:,} actions; give at most "
            f"{limit:,}, {remedy}."
        )
    return make_grid(*dynamics.domain, shape, breakpoints)
