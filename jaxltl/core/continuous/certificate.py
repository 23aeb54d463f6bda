"""Certificates of policies in continuous worlds: bounds of satisfaction probabilities by cell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax.errors import FlaxError
from jax.extend.core import jaxpr_as_fun
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans, Floats, Integers, PyTree
from jaxltl.core.continuous.abstraction import (
    ALMOST_SURE,
    Abstraction,
    CellBounds,
    ITERATED,
    RefinementLimits,
    Report,
    SURE,
)
from jaxltl.core.continuous.dynamics import Dynamics, Step, to_environment
from jaxltl.core.continuous.grid import Grid, make_grid
from jaxltl.core.continuous.regions import UndefinedError, box
from jaxltl.core.environments.environment import Environment, traced
from jaxltl.core.environments.episodes import Agent, Episode, make_agent, run_episode
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.environments.task_environment import (
    TaskObservation,
    TaskTables,
    task_environment,
    task_tables,
)
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.pretty_print import brief, rounded_outward
from jaxltl.core.status import Status


StatePolicy = Callable[[jax.Array], jax.Array]
# A function, an Agent, or a flax module with its parameters.
Policy = StatePolicy | Agent | tuple[object, PyTree]


def state_policy(policy: Policy, environment: Dynamics | Environment) -> StatePolicy:
    """A learned policy as a function ``float[n] -> float[m]`` of the state of dynamics.

    Args:
      policy: one of

        - a function ``float[n] -> float[m]``, which is returned;
        - ``(module, parameters)`` of flax, applied to the state;
        - a deterministic :class:`~jaxltl.core.environments.episodes.Agent`: ``ppo.greedy(...)`` or
          ``trust_region.greedy(...)`` of ``(state, problem, hparams)``, the mean of the Gaussian;
          ``network_agent(network, environment)(cce.policy(...))``; the latter's parameters alone
          are no policy.
      environment: the dynamics or the task environment in which the policy was learned. In the latter
        the policy observes the automaton state too; it is held at its value while the formula is
        undecided.

    Returns:
      The function; differentiable where the policy is.

    Raises:
      ValueError: an agent with memory or with random actions; a task with several undecided automaton
        states that the policy can distinguish, so that it is no function of the state.

    Example:
      >>> from jaxltl.core.continuous import make_dynamics
      >>> from jaxltl.core.environments import make_agent
      >>> world = make_dynamics(
      ...     lambda x, u, w: x + u, domain=([0.0], [1.0]), labels={}, actions=([-1.0], [1.0]))
      >>> agent = make_agent(lambda seen, key: -seen / 2)
      >>> float(state_policy(agent, world)(jnp.array([0.5]))[0])
      -0.25
    """
    if isinstance(policy, tuple) and len(policy) == 2 and hasattr(policy[0], "apply"):
        apply, parameters = policy[0].apply, policy[1]
        variables = (
            parameters
            if isinstance(parameters, dict) and "params" in parameters
            else {"params": parameters}
        )
        return lambda state: apply(variables, state)
    if not isinstance(policy, Agent):
        return validation.function("policy", policy)
    if jax.tree.leaves(policy.memory):
        raise ValueError("policy is an agent with memory; give a policy of the state alone.")
    tabled = None if isinstance(environment, Dynamics) else _tables(environment)
    row = None if tabled is None else _undecided_row(tabled)

    def act(state: jax.Array) -> jax.Array:
        seen = state if row is None else TaskObservation(state, jnp.asarray(row, state.dtype))
        action: jax.Array = policy.act((), seen, None, None)[0]
        return action

    n = environment.num_states if isinstance(environment, Dynamics) else _size(environment)
    try:
        jax.eval_shape(act, jax.ShapeDtypeStruct((n,), jnp.result_type(float)))
    except (TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"policy is an agent that cannot act on a state float[{n}] without a random key "
            f"({' '.join(str(error).split())[:120]}); give a deterministic one, such as "
            "ppo.greedy(state, problem, hparams), and state_policy(agent, environment) of the "
            "environment in which it was learned."
        ) from error
    return _folded(act)


def _folded(act: StatePolicy) -> StatePolicy:
    """The same function with the parts evaluated that depend on no state, such as scales.

    Their enclosures would be wide where a comparison of constants is within rounding of equality.
    """

    def folded(state: jax.Array) -> jax.Array:
        program = jax.make_jaxpr(act)(jax.ShapeDtypeStruct(state.shape, state.dtype))
        with jax.ensure_compile_time_eval():
            action: jax.Array = jaxpr_as_fun(program)(state)[0]
        return action

    return folded


def _tables(environment: Environment) -> TaskTables | None:
    """The task's tables, or None for an environment without a task."""
    try:
        return task_tables(environment)
    except ValueError:
        return None


def _size(environment: Environment) -> int:
    shape = jax.eval_shape(
        lambda key: environment.observe(environment.reset(key)), jax.random.key(0)
    )
    return int((shape.world if isinstance(shape, TaskObservation) else shape).shape[0])


def _undecided_row(tables: TaskTables) -> Floats:
    """The observation of the automaton state while the task is undecided."""
    delta, verdict = np.asarray(tables.delta), np.asarray(tables.verdict)
    rows = np.eye(len(delta)) if tables.embedding is None else np.asarray(tables.embedding)
    reached = {int(tables.initial)}
    while (more := reached | set(delta[list(reached)].ravel().tolist())) != reached:
        reached = more
    entered = np.unique(delta[list(reached)])  # an observation follows the first label
    undecided = entered[verdict[entered] == Verdict.UNDECIDED]
    distinct: Floats = np.unique(rows[undecided], axis=0)
    if len(distinct) > 1:
        raise ValueError(
            f"the policy observes {len(undecided)} undecided automaton states of its task, so that it is "
            "no function of the state alone; learn with embedding=np.zeros((Q, 1)), which hides them, "
            "or synthesize a policy with memory by synthesize_policy."
        )
    result: Floats = rows[int(tables.initial)] if not len(distinct) else distinct[0]
    return result


def learned_policy(policy: Policy, dynamics: Dynamics, formula: str | Formula) -> StatePolicy:
    """:func:`state_policy` of an agent that was learned in the dynamics, or in their task."""
    try:
        return state_policy(policy, dynamics)
    except ValueError:
        if not isinstance(policy, Agent) or jax.tree.leaves(policy.memory):
            raise
    return state_policy(policy, task_environment(dynamics.environment, formula))


HOW = {SURE: "surely", ALMOST_SURE: "almost surely", ITERATED: "by value iteration"}
FIRST_CELLS, FIRST_LENGTH = 20_000, 1_000  # of the default grid in all and along an axis
_BYTES = 400  # of memory for a cell and action, about
PAIRS = 2**24  # of cells and actions on one grid


@brief
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
        decide the threshold; ``NONFINITE``, with all bounds 0 and 1, if the step, the policy or the
        function of a label may be NaN in the domain; ``MAX_STEPS`` otherwise.
      seconds: wall time by stage.
      formula: text of the formula.
      reason: where a value may be NaN if the status is ``NONFINITE``, else empty.

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
    reason: str = ""

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
        if self.status == Status.NONFINITE:
            return f"{self.formula}: nothing is proven, since {self.reason}"
        return (
            f"{self.formula}: satisfied with probability at least {lower} from every initial state "
            f"(least upper bound {upper}). Of {count:,} initial cells: {', '.join(shares)}. "
            f"Time: {stages}."
        )


def certify_policy(
    dynamics: Dynamics,
    policy: Policy,
    formula: str | Formula,
    *,
    cells: Sequence[int] | None = None,
    tolerance: float = 1e-3,
    threshold: float | None = None,
    max_cells: int = 2**20,
    max_sweeps: int = 1000,
    upper: bool = True,
    report: Report | None = None,
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
      cells: number of cells of the first grid along each axis; default: about 20,000 in all, at most
        1,000 along an axis.
      tolerance: width of the bounds of initial states at which refinement stops.
      threshold: stop as soon as the lower bounds of all initial states reach it, or the upper bound of
        one of them is below.
      max_cells: of the finest grid.
      max_sweeps: of value iteration on one grid.
      upper: False to skip upper bounds.
      report: function that is called with lines of progress.

    Returns:
      :class:`Certificate`. Bounds hold for real numbers: rounding of this computation is included,
      that of the controller's own arithmetic is not.

    Raises:
      ValueError: a policy or a step with a primitive that has no enclosure, actions of another shape,
        a proposition that is no label, a grid beyond `max_cells`, or a first grid with more transition
        probabilities than memory should hold (a finer one ends the refinement).

    Example:
      >>> from jaxltl.core.continuous import make_dynamics, triangular
      >>> world = make_dynamics(
      ...     lambda x, u, w: x + u + 0.02 * w, domain=([-1.0], [1.0]), noise=triangular(-1.0, 1.0),
      ...     actions=([-0.5], [0.5]), labels={"goal": ([-0.1], [0.1])}, initial=([0.5], [0.6]))
      >>> proof = certify_policy(world, lambda x: -0.2 * x, "F goal", cells=[100])
      >>> proof.initial_bounds, proof.status.name
      ((1.0, 1.0), 'CONVERGED')
    """
    validation.instance("dynamics", dynamics, Dynamics, "those of make_dynamics")
    step = closed_loop(dynamics, learned_policy(policy, dynamics, formula))
    limits = RefinementLimits(tolerance, threshold, max_cells, max_sweeps, upper, report)
    return prove(dynamics, formula, step, np.zeros((1, 1)), cells, limits)[0]


def prove(
    dynamics: Dynamics,
    formula: str | Formula,
    step: Step,
    actions: Floats,
    cells: Sequence[int] | None,
    limits: RefinementLimits,
) -> tuple[Certificate, Abstraction, CellBounds]:
    """The certificate of a step under the best actions of a grid, and its parts."""
    limits = _checked(limits)
    validation.instance("formula", formula, (str, Formula), "a formula or its text")
    _require_initial_inside(dynamics)
    grid = first_grid(dynamics, cells, limits.max_cells, len(actions))
    limits = replace(limits, max_cells=min(limits.max_cells, PAIRS // len(actions)))
    abstraction = Abstraction(dynamics, formula, step, actions, limits)
    reason = ""
    try:
        bounds = abstraction.bounds(grid)
    except UndefinedError as error:
        bounds, reason = abstraction.vacuous(grid), str(error)
    lower, upper = bounds.initial_bounds()
    how = bounds.task.initial(bounds.how.astype(np.float64)).astype(np.int8)
    ends = lower[bounds.initial], upper[bounds.initial]
    decided = (ends[1] - ends[0]).max() <= limits.tolerance or limits.decides(*ends)
    status = Status.CONVERGED if decided else Status.MAX_STEPS
    status = Status.NONFINITE if reason else status
    seconds, text = abstraction.seconds, str(formula)
    certificate = Certificate(
        bounds.grid, lower, upper, how, bounds.initial, status, seconds, text, reason
    )
    return certificate, abstraction, bounds


def _checked(limits: RefinementLimits) -> RefinementLimits:
    """The validated limits of a refinement."""
    validation.require_in_range("tolerance", limits.tolerance)
    threshold, report = limits.threshold, limits.report
    return RefinementLimits(
        limits.tolerance,
        None if threshold is None else validation.fraction("threshold", threshold),
        validation.integer("max_cells", limits.max_cells, least=1),
        validation.integer("max_sweeps", limits.max_sweeps, least=1),
        validation.boolean("upper", limits.upper),
        None if report is None else validation.function("report", report),
    )


def _require_initial_inside(dynamics: Dynamics) -> None:
    """Raises ValueError for initial states outside a domain that replaced the one they were checked with."""
    (low, high), initial = dynamics.domain, dynamics.initial
    inside = ((low <= initial.low) & (initial.high <= high)).all(axis=1)
    if not inside.all():
        i = int(np.argmin(inside))
        raise ValueError(
            f"initial: box {i}, {initial.low[i].tolist()} to {initial.high[i].tolist()}, has states outside "
            "the domain, for which nothing is proven; give boxes inside of it."
        )


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
        cells = (min(max(int(FIRST_CELLS ** (1 / n)), 2), FIRST_LENGTH),) * n
    breakpoints = []
    for axis in range(n):
        edges = np.concatenate([[], *(r.breakpoints(axis) for r in dynamics.labels.values())])
        # Initial boxes are closed: an edge beyond the upper one saves the cells behind it.
        ends = dynamics.initial.high[:, axis]
        ends = np.nextafter(ends[~np.isin(ends, edges)], np.inf)
        breakpoints.append(np.unique([*edges, *dynamics.initial.low[:, axis], *ends]))
    each = [cells] if np.ndim(cells) == 0 else validation.sequence("cells", cells)
    shape = tuple(validation.integer("cells", k, least=1, limit=2**31 - 1) for k in each)
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


_RUNS = 1000  # simulated at a time


def counterexample(
    key: chex.PRNGKey,
    dynamics: Dynamics,
    policy: Policy,
    formula: str | Formula,
    certificate: Certificate | None = None,
    num_steps: int = 200,
) -> Floats | None:
    """A simulated run that violates a formula, from the initial cell with the least upper bound.

    A run violates a formula as soon as no continuation satisfies it: every violated safety formula has
    such a run, and a formula such as ``!unsafe U goal`` where a run enters ``unsafe``. With
    ``outside="violates"`` a run also violates it that leaves the domain before the formula is satisfied
    for good; no other finite run violates ``F goal``. Disturbances are uniform, so that a worst case may be missed.

    Args:
      key: random key.
      dynamics, policy, formula: as of :func:`certify_policy`.
      certificate: bounds of the same policy, by which the initial cell is chosen; default: initial
        states are sampled.
      num_steps: longest run; static. One thousand runs are simulated.

    Returns:
      ``float64[T + 1, n]``, the shortest violating run found, its first state initial; None if no run
      violates the formula, which proves nothing.

    Raises:
      ValueError: a policy of another shape, or a proposition that is no label.

    Example:
      >>> from jaxltl.core.continuous import make_dynamics
      >>> world = make_dynamics(
      ...     lambda x, u, w: x + u, domain=([0.0], [1.0]), actions=([-1.0], [1.0]),
      ...     labels={"pit": ([0.8], [1.0])}, initial=([0.0], [0.1]))
      >>> run = counterexample(jax.random.key(0), world, lambda x: x * 0 + 0.25, "G !pit")
      >>> len(run), bool(run[-1, 0] >= 0.8)
      (4, True)
    """
    num_steps = validation.integer("num_steps", num_steps, least=1, limit=2**31 - 1)
    if certificate is not None:
        validation.instance("certificate", certificate, Certificate, "that of certify_policy")
    validation.instance("dynamics", dynamics, Dynamics, "those of make_dynamics")
    if certificate is not None:
        cells = np.flatnonzero(certificate.initial)
        low, high = certificate.grid.boxes(cells[[np.argmin(certificate.upper[cells])]])
        first = np.maximum(low, dynamics.initial.low), np.minimum(high, dynamics.initial.high)
        met = (first[0] < first[1]).all(axis=1)
        dynamics = replace(dynamics, initial=box(first[0][met], first[1][met]))
    act = learned_policy(policy, dynamics, formula)
    task = task_environment(to_environment(dynamics), formula)
    agent = make_agent(lambda seen, key: act(seen.world))

    @jax.jit
    def simulated(key: chex.PRNGKey) -> Episode:
        return run_episode(key, task, agent, num_steps=num_steps)

    runs = jax.device_get(jax.vmap(simulated)(jax.random.split(key, _RUNS)))
    violated = np.asarray(runs.world.verdict) == Verdict.VIOLATED
    if not violated.any():
        return None
    steps = np.where(violated.any(axis=1), violated.argmax(axis=1), num_steps + 1)
    run: Floats = np.asarray(runs.world.world[steps.argmin(), : steps.min() + 1], np.float64)
    return run
