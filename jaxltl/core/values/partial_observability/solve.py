"""Optimal values of partially observable models between certified bounds, and values of controllers."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import jax
import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.translate import FormulaLike
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.construct.state_formulas import states_satisfying
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.product import product
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import Reward, Rewards, choice_reward
from jaxltl.core.values.engine.state_quantities import nonnegative_reward
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.sparse.solvers import reachability as solver
from jaxltl.core.types import Solution, Status, check, require_states
from jaxltl.core.values.engine.host_solution import complement_event
from jaxltl.core.values.engine.validated import validated
from jaxltl.core.values.partial_observability.controller_gradient import (
    SoftmaxAscent,
    first_controllers,
)
from jaxltl.core.values.partial_observability.chains import chain_solution, controlled_chain
from jaxltl.core.values.partial_observability.exploration import BeliefBounds, explore
from jaxltl.core.values.partial_observability.long_run import learned_satisfaction, lost_states
from jaxltl.core.values.partial_observability.problem import (
    BeliefProblem,
    reach_problem,
    reward_problem,
)

TOLERANCE = 1e-3
MAX_BELIEFS = 10_000
_FEW = 100  # beliefs that are expanded before controllers are improved by gradients
Report = Callable[[int, float, float], None]


@validated(games=True, host=True)
def belief_bounds(
    pomdp: POMDP,
    target: Array | str,
    *,
    stay: Array | str | None = None,
    reward: Reward = None,
    objective: str = "max",
    tolerance: float = TOLERANCE,
    max_beliefs: int = MAX_BELIEFS,
    max_seconds: float | None = None,
    controllers: Sequence[FiniteMemoryPolicy] = (),
    report: Report | None = None,
    throw: bool = False,
) -> Solution:
    """Optimal reachability probability or total reward of a POMDP from its initial belief.

    Beliefs are explored between two certified bounds: that of all controllers, from the fast informed
    bound (Hauskrecht 2000) at beliefs where the exploration ends, and the value of one finite-memory
    controller, which continues there by known controllers (as Norman, Parker and Zou 2017, Andriushchenko
    et al. 2023, and Ho et al. 2024). The problem is undecidable in general: bounds may stay apart.

    Args:
      pomdp: a concrete POMDP.
      target: ``bool[S]``, a label or a formula of labels; it need not be observable.
      stay: the states through which the target must be reached; default: all.
      reward: a reward of the model that is earned until the target is reached. Where the target is not
        reached almost surely, the reward is infinite; a maximum needs a target that all policies reach
        almost surely. Default: the probability.
      objective: ``"max"`` or ``"min"``.
      tolerance: width of the bounds, at which the exploration ends; of rewards relative to the value.
      max_beliefs: largest number of expanded beliefs, which bounds memory and time.
      max_seconds: of the exploration; default: no limit. The last evaluation of a controller may exceed it.
      controllers: finite-memory policies over observations to begin with, beside those by gradients.
      report: is called with the number of beliefs and both bounds after each round.
      throw: raise NotConverged unless the solution converged.

    Returns:
      :class:`~jaxltl.core.types.Solution` of shapes ``[]``: `lower` and `upper` contain the optimum;
      `policy` is a :class:`~jaxltl.core.policies.finite_memory.FiniteMemoryPolicy` over observations, and
      `value` its certified value, the lower bound of a maximum. An interrupt from the keyboard ends the
      exploration with the bounds so far. MAX_STEPS if a limit ended it. Bounds hold for the probabilities
      that doubles abbreviate: the shortest decimals if those of a row sum to one, else normalised doubles.

    Raises:
      ValueError: an unknown label or reward, an infinite maximum of rewards, or a controller of other observations.

    Example:
      >>> import jaxltl as jl
      >>> world = jl.make_sparse([0, 1, 3, 5, 6, 7], [0, 2, 3, 4, 5, 6, 7, 8], [1, 2, 3, 4, 4, 3, 3, 4],
      ...     [0.5, 0.5, 1, 1, 1, 1, 1, 1], initial=[1, 0, 0, 0, 0], label={"win": [3]})
      >>> hidden = jl.models.make_pomdp(world, [0, 1, 1, 2, 3])  # 1 and 2 look alike
      >>> answer = belief_bounds(hidden, "win")
      >>> round(float(answer.lower), 6), round(float(answer.upper), 6)
      (0.5, 0.5)
    """
    pomdp = _require_pomdp(pomdp)
    model = pomdp.fully_observable
    goal = target_states(pomdp, "target", target)
    maximize = objective == "max"
    if reward is None:
        within = None if stay is None else target_states(pomdp, "stay", stay)
        problem = reach_problem(pomdp, goal, within, maximize=maximize)
    else:
        if stay is not None:
            raise ValueError(
                "belief_bounds: stay restricts probabilities; give reward without stay."
            )
        earned = nonnegative_reward(model, reward, "total rewards")
        problem = reward_problem(pomdp, earned, goal, maximize=maximize)
        if maximize and problem.has_infinite:
            state = int(problem.state[np.argmax(~problem.is_finite)])
            raise ValueError(
                f"belief_bounds: the maximal reward from state {state} is infinite if states are seen, since a "
                "policy may miss the target; that is no upper bound. Ask for objective='min', or evaluate a "
                "controller by controlled_chain."
            )
    limit = validation.integer("max_beliefs", max_beliefs, least=1)
    seconds = np.inf if max_seconds is None else float(max_seconds)
    if not seconds > 0:
        raise ValueError(f"max_seconds is {max_seconds}; give a positive number of seconds.")
    width = float(tolerance)
    if not (problem.initial > 0).any():  # decided by the graph
        policy = SoftmaxAscent.random(problem, 1, 0.0, 0).policies()[0]
        value = problem.initial_gain
        return _solution(problem, BeliefBounds(value, value, policy, 0, 0, True), width)
    known = [*controllers, *SoftmaxAscent.random(problem, 1, 0.0, 0).policies()]
    size, bounds = min(limit, _FEW), None
    end = time.monotonic() + seconds
    while True:
        rest = max(end - time.monotonic(), 0.0)
        more = explore(
            problem, known, tolerance=width, max_beliefs=size, max_seconds=rest, report=report
        )
        bounds = more if bounds is None else bounds.joined(more, maximize)
        rest = end - time.monotonic()
        if bounds.is_complete or problem.is_infinite or size == limit or rest <= 0:
            break
        known, size = [*controllers, *first_controllers(problem, rest)], limit
    solution = _solution(problem, bounds, float(tolerance))
    return check(solution) if throw else solution


def _require_pomdp(pomdp: POMDP) -> POMDP:
    if not isinstance(pomdp, POMDP):
        raise ValueError(
            f"the model is {type(pomdp).__name__}, not a POMDP; make one by make_pomdp(model, observation)."
        )
    return pomdp


def target_states(pomdp: POMDP, name: str, states: Array | str) -> Booleans:
    """A set of states ``bool[S]`` from a mask, a label or a formula of labels."""
    if isinstance(states, str):
        return states_satisfying(pomdp.fully_observable, states, name)
    require_states(name, states, (pomdp.num_states,))
    return np.asarray(states, bool)


def _solution(problem: BeliefProblem, bounds: BeliefBounds, tolerance: float) -> Solution:
    if problem.maximize:
        lower, upper = bounds.inner, max(bounds.outer, bounds.inner)
    else:
        lower, upper = min(bounds.outer, bounds.inner), bounds.inner
    if not problem.is_reward:
        lower, upper = max(lower, 0.0), min(upper, 1.0)
    lower = np.inf if problem.is_infinite else lower
    value = lower if problem.maximize else upper
    done = (
        np.isfinite(lower) and upper - lower <= tolerance * (abs(upper) if problem.is_reward else 1)
    ) or lower == upper
    status = Status.CONVERGED if done else Status.MAX_STEPS
    pomdp, policy = problem.pomdp, bounds.policy
    if policy is not None:
        policy = policy.replace(actions=pomdp.action_names, states=pomdp.observation_names)
    parts: dict[str, Array] = {
        "value": np.float64(value),
        "policy": policy,
        "lower": np.float64(lower),
        "upper": np.float64(upper),
        "residual": np.float64(upper - lower),
        "num_steps": np.int32(bounds.rounds),
        "status": np.int32(status),
        "initial": np.ones(()),
    }
    return Solution(**parts, method=f"exploration of {bounds.num_beliefs} beliefs")


def controller_value(
    pomdp: POMDP,
    policy: FiniteMemoryPolicy,
    target: Array | str,
    *,
    stay: Array | str | None = None,
    reward: Reward = None,
    tolerance: float = 1e-6,
) -> Solution:
    """Certified probability or total reward of a controller, of shapes ``[]``; see :func:`belief_bounds`."""
    model = _require_pomdp(pomdp).fully_observable
    earned = {} if reward is None else {"": Rewards(choice=choice_reward(model, reward))}
    chain = controlled_chain(
        replace(pomdp, fully_observable=replace(model, rewards=earned)), policy
    )
    state = chain.valuation["state"]
    goal = target_states(pomdp, "target", target)[state]
    if reward is None:
        within = None if stay is None else target_states(pomdp, "stay", stay)[state]
        bounds = solver.reachability(
            chain.host, goal, maximize=True, stay=within, tolerance=tolerance, depth=4
        )
    else:
        bounds = solver.total_reward(
            chain.host, choice_reward(chain), goal, maximize=False, tolerance=tolerance, depth=4
        )
    solution = chain_solution(bounds, np.asarray(chain.initial))
    at = solution.at_initial
    width = float(at.upper - at.lower)
    scale = 1.0 if reward is None else max(abs(float(at.lower)), 1e-12)
    narrow = width <= 2 * tolerance * scale or at.lower == at.upper
    return replace(
        solution,
        value=at.value,
        lower=at.lower,
        upper=at.upper,
        policy=policy,  # type: ignore[arg-type]
        initial=np.ones(()),  # type: ignore[arg-type]
        status=np.int32(Status.CONVERGED if narrow else Status.PRECISION),  # type: ignore[arg-type]
    )


def partially_observable_satisfaction(
    pomdp: POMDP,
    formula: FormulaLike,
    *,
    objective: str = "max",
    tolerance: jax.Array | float | None = None,
    max_beliefs: int = MAX_BELIEFS,
) -> Solution:
    """Bounds of the optimal satisfaction probability, of a co-safe or safe formula over the product's beliefs.

    Of other formulas the one bound is a controller's, and the other one that of policies that see the states,
    or of avoiding, over beliefs, the states in which such a policy has lost.
    The automaton's state is hidden as far as labels are; the controller reads observations alone.
    """
    joint, final, automaton = task_pomdp(pomdp, formula)
    width = TOLERANCE if tolerance is None else float(tolerance)
    if final is None:
        answer = learned_satisfaction(pomdp, automaton, objective=objective, tolerance=width)
        lost = lost_states(pomdp, automaton, maximize=objective == "max")
        if answer.status == Status.CONVERGED or not lost.any():
            return answer
        limit = belief_bounds(
            joint, lost, objective="min", tolerance=width, max_beliefs=max_beliefs
        )
        return _limited(answer, limit, objective, width)
    bounds = partial(belief_bounds, joint, tolerance=width, max_beliefs=max_beliefs)
    if automaton.is_safety:
        opposite = "min" if objective == "max" else "max"
        return complement_event(bounds(~final, objective=opposite))
    return bounds(final, objective=objective)


def _limited(answer: Solution, limit: Solution, objective: str, tolerance: float) -> Solution:
    """The answer with the bound by beliefs of the probability of lost states, if it is the better one.

    From them a maximum is 0 and a minimum 1: it is at most that of avoiding them, or at least that of
    reaching them.
    """
    lower, upper = float(answer.lower), float(answer.upper)
    if objective == "max":
        upper = max(lower, min(upper, float(complement_event(limit).upper)))
    else:
        lower = min(upper, max(lower, float(limit.lower)))
    done = upper - lower <= tolerance
    parts: dict[str, Array] = {
        "lower": np.float64(lower),
        "upper": np.float64(upper),
        "residual": np.float64(upper - lower),
        "status": np.int32(Status.CONVERGED if done else Status.MAX_STEPS),
    }
    return replace(answer, **parts)


def task_pomdp(pomdp: POMDP, formula: FormulaLike) -> tuple[POMDP, Booleans | None, Automaton]:
    """The product with a formula's automaton, whose state is hidden, its final states, and the automaton.

    Its observations are those of the POMDP. A co-safe formula is satisfied by reaching a final state, a
    safe one by staying in them; of other formulas they are None.
    """
    world = product(pomdp.fully_observable, formula)
    seen = np.repeat(np.asarray(pomdp.observation), world.num_memory)
    automaton: Automaton = world.automaton
    final = np.asarray(world.final).ravel() if automaton.has_final_states else None
    return POMDP(to_sparse(world), seen, pomdp.observables), final, automaton
