"""Policy gradient for finite-state controllers of partially observable models (Meuleau et al. 1999).

A controller of M memory states chooses action a with probability ``pi(a | m, o)``, and memory state m'
with ``eta(m' | m, o')`` when it enters an observation o'; both are softmax tables. Its value is that of a
chain of states and memory states,

    v(m, s) = sum_a pi(a | m, o(s)) (g(s, a) + discount sum_t P(t | s, a) sum_n eta(n | m, o(t)) v(n, t)),

which is solved, and differentiated implicitly; before the first observation the memory state is 0.
``make_problem(pomdp, formula=...)`` takes any formula of linear temporal logic. Many starts are a ``vmap`` over
keys. The learned value certifies nothing; ``reachability_probability(pomdp, target, policy=...)`` or
``total_reward`` of the policy do, and :func:`learn_formula` learns and certifies a controller for a formula.

Example: a hidden coin; one guess, right in state 2. A look, which costs nothing, shows the coin.
  >>> import jax, numpy as np, jaxltl as jl
  >>> from jaxltl.algos import finite_state_controllers as fsc
  >>> table = np.zeros((6, 3, 6))  # heads, tails, right, wrong, heads seen, tails seen
  >>> table[0, :, [3, 2, 4]] = table[1, :, [2, 3, 5]] = np.eye(3)
  >>> table[4, :, [3, 2, 0]] = table[5, :, [2, 3, 1]] = np.eye(3)
  >>> table[[2, 3], :, [2, 3]] = 1
  >>> world = jl.from_dense(table, initial=[0.5, 0.5, 0, 0, 0, 0], label={"right": [2]})
  >>> coin = jl.models.make_pomdp(world, [0, 0, 1, 1, 2, 3])
  >>> problem = fsc.make_problem(coin, "right")
  >>> hparams = fsc.Hparams(learning_rate=0.5)
  >>> starts = jax.random.split(jax.random.key(0), 4)
  >>> train = jax.vmap(lambda key: fsc.train(key, problem, hparams, num_steps=100))
  >>> state, metrics = train(starts)
  >>> best = jax.tree.map(lambda x: x[metrics.value[:, -1].argmax()], state)
  >>> policy = fsc.policy(best, problem, hparams)
  >>> bool(jl.reachability_probability(coin, "right", policy=policy).lower > 0.9)
  True
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxltl.algos.common import learner, optimizers
from jaxltl.algos.common.chunks import ChunkOptions, run_in_chunks
from jaxltl.algos.common.settings import Number, RunState, static, traced
from jaxltl.core import struct
from jaxltl.core.automata.translate import FormulaLike
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.protocols import Array, Key
from jaxltl.core.models.sparse import Reward, choice_reward
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.types import AtInitial, Solution
from jaxltl.core.validation import Range, choice, require_in_range
from jaxltl.core.values.engine.host_solution import complement_event
from jaxltl.core.values.engine.implicit_diff import implicit
from jaxltl.core.values.partial_observability.chains import controlled_chain
from jaxltl.core.values.partial_observability.controller_chain import (
    ControllerChain,
    controller_solver,
)
from jaxltl.core.values.partial_observability.long_run import (
    LEAK,
    satisfaction_problem,
)
from jaxltl.core.values.partial_observability.problem import (
    BeliefProblem,
    discounted_problem,
    reach_problem,
    reward_problem,
)
from jaxltl.core.values.partial_observability.reduction import (
    reduced_controller,
    without_rare_actions,
)
from jaxltl.core.values.partial_observability.solve import (
    belief_bounds,
    controller_value as value_of_policy,
    target_states,
    task_pomdp,
)
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction

_CERTIFIED = 5  # starts whose controllers are certified
_RARE = 0.1  # probability up to which actions are left out of a variant of a controller


@struct.dataclass
class Problem:
    """The value of controllers of a POMDP, on its undecided states, N of them.

    Attributes:
      successor, probability: ``int32[N, A, K]`` and ``float[N, A, K]``, of undecided successors.
      gain: ``float[N, A]``, the probability of entering the target, or the reward.
      observation: ``int32[N]``.
      available: ``bool[O, A]``.
      initial: ``float[N]``, the initial belief.
      initial_gain: ``float[]``, its probability of the target.
      discount: ``float[]``.
      sign: 1 for a maximum, -1 for a minimum; static.
    """

    successor: jax.Array
    probability: jax.Array
    gain: jax.Array
    observation: jax.Array
    available: jax.Array
    initial: jax.Array
    initial_gain: jax.Array
    discount: jax.Array
    sign: int = struct.field(pytree_node=False, default=1)


def make_problem(
    pomdp: POMDP,
    target: Array | str | None = None,
    *,
    stay: Array | str | None = None,
    reward: Reward = None,
    discount: float | None = None,
    formula: FormulaLike | None = None,
    leak: float | None = LEAK,
    objective: str = "max",
) -> Problem:
    """A checked :class:`Problem`: of a target, of a reward, or of a formula of linear temporal logic.

    Args:
      pomdp: a concrete POMDP.
      target: ``bool[S]``, a label or a formula of labels. Without a reward, the value is the probability
        of reaching it.
      stay: the states through which it must be reached.
      reward: earned until the target, or with a discount for ever; rewards and names as of
        :func:`~jaxltl.core.models.sparse.choice_reward`.
      discount: of rewards, below 1; default: none, for which every reachable state must be able to reach
        the target.
      formula: satisfied in the product with its automaton; instead of a target and a reward.
      leak: the probability in (0, 1) with which a transition of the least priority ends a run of the smooth
        objective of a formula, see :mod:`~jaxltl.core.values.partial_observability.long_run`. None: the
        exact satisfaction probability, which of random actions is often 0.
      objective: ``"max"`` or ``"min"``.

    Raises:
      ValueError: neither a target, a discounted reward nor a formula, several of them, or a state that
        cannot reach the target of an undiscounted reward.
    """
    choice("objective", objective, ("max", "min"))
    maximize = objective == "max"
    if formula is not None:
        if target is not None or stay is not None or reward is not None or discount is not None:
            raise ValueError(
                "make_problem: formula is given; leave out target, stay, reward and discount."
            )
        if leak is not None:
            require_in_range("leak", leak, Range(0, 1, open_above=True, open_below=True))
        return _arrays(satisfaction_problem(pomdp, formula, maximize=maximize, leak=leak), 1.0)
    if reward is None:
        if target is None or discount is not None:
            raise ValueError(
                "make_problem: give a target, or a reward with its discount or its target."
            )
        within = None if stay is None else target_states(pomdp, "stay", stay)
        goal = target_states(pomdp, "target", target)
        return _arrays(reach_problem(pomdp, goal, within, maximize=maximize), 1.0)
    earned = choice_reward(pomdp.fully_observable, reward)
    if stay is not None:
        raise ValueError("make_problem: stay is for probabilities; leave it out with a reward.")
    if discount is not None:
        require_in_range("discount", discount)
        goal = np.zeros(pomdp.num_states, bool)
        goal = goal if target is None else target_states(pomdp, "target", target)
        return _arrays(discounted_problem(pomdp, earned, goal, maximize=maximize), discount)
    if target is None:
        raise ValueError("make_problem: target is None; total rewards need a target or a discount.")
    problem = reward_problem(pomdp, earned, target_states(pomdp, "target", target), maximize=False)
    if problem.has_infinite:
        raise ValueError(
            "make_problem: some reachable state cannot reach the target almost surely, so that rewards of "
            "softmax controllers are infinite; give a discount."
        )
    return replace(_arrays(problem, 1.0), sign=1 if maximize else -1)


def _arrays(problem: BeliefProblem, discount: float) -> Problem:
    count = [np.diff(t.indptr) for t in problem.transition]
    width = max([1, *(int(c.max(initial=0)) for c in count)])
    shape = problem.num_states, len(problem.transition), width
    successor, probability = np.zeros(shape, np.int32), np.zeros(shape)
    for a, (matrix, number) in enumerate(zip(problem.transition, count, strict=True)):
        row = np.arange(problem.num_states).repeat(number)
        place = np.arange(row.size) - matrix.indptr[row]
        successor[row, a, place], probability[row, a, place] = matrix.indices, matrix.data
    dtype = jnp.result_type(float)
    legal = problem.available | ~problem.available.any(1, keepdims=True)
    return Problem(
        successor=jnp.asarray(successor),
        probability=jnp.asarray(probability, dtype),
        gain=jnp.asarray(problem.gain.T, dtype),
        observation=jnp.asarray(problem.observation, jnp.int32),
        available=jnp.asarray(legal),
        initial=jnp.asarray(problem.initial, dtype),
        initial_gain=jnp.asarray(problem.initial_gain, dtype),
        discount=jnp.asarray(discount, dtype),
        sign=1 if problem.maximize else -1,
    )


class ControllerLogits(NamedTuple):
    """Logits of a controller.

    Attributes:
      action: ``float[M, O, A]``.
      update: ``float[M, O, M]``, of the next memory state by the observation that is entered.

    >>> ControllerLogits(jnp.zeros((1, 2, 3)), jnp.zeros((1, 2, 1))).action.shape
    (1, 2, 3)
    """

    action: jax.Array
    update: jax.Array


@struct.dataclass
class Hparams:
    """Settings of the learner.

    Attributes:
      learning_rate: of the optimizer; default 0.1.
      scale: standard deviation of the initial logits; default 0.5.
      num_memory: memory states; static, default 1.
      optimizer: the name of one of optax; static, default ``"adam"``.
    """

    learning_rate: Number = traced(Range(0, open_above=True), default=0.1)
    scale: Number = traced(Range(0, open_above=True), default=0.5)
    num_memory: int = static(Range(1, 1000, integer=True), default=1)
    optimizer: str = static((*optimizers.NAMES, "sign"), default="adam")


@struct.dataclass
class State(RunState):
    """A controller in training.

    Attributes:
      parameters: :class:`ControllerLogits`.
      optimizer: optax's state.
    """

    parameters: ControllerLogits
    optimizer: optax.OptState


@struct.dataclass
class Metrics:
    """Figures of the controller before a step; scalars, of a run ``[T]``.

    Attributes:
      value: from the initial belief.
      gradient_norm: of the value in the logits.
      status: COMPLETED, or NONFINITE.
    """

    value: jax.Array
    gradient_norm: jax.Array
    status: jax.Array


def controller_value(problem: Problem, parameters: ControllerLogits) -> jax.Array:
    """The value of a softmax controller from the initial belief, with implicit derivatives.

    Args:
      problem: of :func:`make_problem`.
      parameters: the logits; the value is differentiable in them, and in the arrays of the problem.

    Returns:
      ``float[]``, without a certificate.

    Example:
      >>> import jaxltl as jl
      >>> world = jl.from_dense([[[0.5, 0.25, 0.25]], [[0, 1.0, 0]], [[0, 0, 1.0]]],
      ...                       initial=[1, 0, 0], label={"a": [1]})
      >>> problem = make_problem(jl.models.make_pomdp(world, [0, 0, 0]), "a")
      >>> round(float(controller_value(problem, ControllerLogits(jnp.zeros((1, 1, 1)), jnp.zeros((1, 1, 1))))), 6)
      0.5
    """
    seen, discount = problem.observation, problem.discount
    act = jax.nn.softmax(jnp.where(problem.available, parameters.action, -jnp.inf))[:, seen]
    keep = jax.nn.softmax(parameters.update)[:, seen]
    earned = jnp.sum(act * problem.gain, -1)

    chain = ControllerChain(problem.successor, problem.probability, act, keep, discount)
    solver = controller_solver(chain)
    solved = solver.solve(earned)
    value = implicit(lambda x: earned + chain.onward(x), solved, solver)
    return problem.initial_gain + jnp.sum(problem.initial * jnp.sum(keep[0].T * value, 0))


def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """Normal logits."""
    first, second = jax.random.split(learner.init_key(key))
    num_memory, count = hparams.num_memory, problem.available.shape[0]
    dtype = problem.gain.dtype
    action = jax.random.normal(first, (num_memory, *problem.available.shape), dtype)
    update = jax.random.normal(second, (num_memory, count, num_memory), dtype)
    parameters = ControllerLogits(hparams.scale * action, hparams.scale * update)
    return start_at(key, parameters, problem, hparams)


def start_at(key: Key, parameters: ControllerLogits, problem: Problem, hparams: Hparams) -> State:
    """A :class:`State` at given logits, such as those of :func:`logits_of`; ``init`` draws them.

    Args:
      key: random key, which the state keeps.
      parameters: the logits.
      problem, hparams: as for ``init``.

    Returns:
      :class:`State`.

    Example:
      >>> parameters = ControllerLogits(jnp.zeros((1, 2, 3)), jnp.zeros((1, 2, 1)))
      >>> start_at(jax.random.key(0), parameters, None, Hparams()).step.item()
      0
    """
    del problem
    return State(key, jnp.int32(0), parameters, optimizers.start(hparams, parameters))


def logits_of(
    policy: FiniteMemoryPolicy, problem: Problem, least: float = 1e-2
) -> ControllerLogits:
    """Logits of a finite-memory policy over observations, with at least the weight `least` for each choice.

    Args:
      policy: such as that of :func:`~jaxltl.core.values.partial_observability.solve.belief_bounds`, for a
        start from explored beliefs.
      problem: of the same POMDP.
      least: the least weight, before normalisation.

    Returns:
      :class:`ControllerLogits`, for :func:`start_at`.

    Example:
      >>> import jaxltl as jl
      >>> world = jl.from_dense([[[0, 1.0], [1.0, 0]], [[0, 1.0], [0, 1.0]]], label={"a": [1]})
      >>> problem = make_problem(jl.models.make_pomdp(world, [0, 0]), "a")
      >>> policy = jl.FiniteMemoryPolicy(np.array([[0]]), np.array([0]), np.array([[0]]))
      >>> logits_of(policy, problem).action.round().tolist()
      [[[0.0, -5.0]]]
    """
    available = np.asarray(problem.available)
    action = np.asarray(policy.action)
    if not policy.is_random:
        action = np.eye(available.shape[1])[action]
    update = np.asarray(policy.next_memory)
    memory = np.eye(update.shape[1])[update]
    weights = (np.log(np.maximum(x, least)).swapaxes(0, 1) for x in (action, memory))
    dtype = problem.gain.dtype
    first, second = (jnp.asarray(x, dtype) for x in weights)
    return ControllerLogits(first, second)


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """A gradient step."""

    def loss(parameters: ControllerLogits) -> tuple[jax.Array, None]:
        return -problem.sign * controller_value(problem, parameters), None

    moved = optimizers.descend(loss, state, hparams)
    finite = jnp.isfinite(moved.loss) & jnp.isfinite(moved.gradient_norm)
    metrics = Metrics(
        value=-problem.sign * moved.loss,
        gradient_norm=moved.gradient_norm,
        status=learner.completion_status(jnp.bool_(True), finite),
    )
    after = State(state.key, state.step + 1, moved.parameters, moved.optimizer)
    return after, metrics


init, step, run, train, run_until, train_until = learner.bind(_init, _step)


def policy(state: State, problem: Problem, hparams: Hparams) -> FiniteMemoryPolicy:
    """The finite-memory policy over observations: random actions, and the likeliest memory updates.

    ``int[O, M]`` updates on entry, from memory state 0 before the first observation; on the host.
    :func:`~jaxltl.core.values.without_rare_actions` leaves out actions that are taken now and then.
    """
    del hparams
    logits = jnp.where(problem.available, state.parameters.action, -jnp.inf)
    action = np.asarray(jax.nn.softmax(logits), np.float64).swapaxes(0, 1)
    update = np.asarray(state.parameters.update).argmax(-1).T.astype(np.int32)
    return FiniteMemoryPolicy(action, update[:, 0].copy(), update)


@dataclass(frozen=True)
class CertifiedController:
    """A controller for a formula, with bounds.

    Attributes:
      policy: the best controller of at most M memory states, over observations.
      satisfaction: its satisfaction probability at the initial belief, certified.
      explored: bounds of all controllers, by explored beliefs or those of `optimal_satisfaction`, with the
        controller of the lower bound.
      reduced: that controller with merged memory states, perhaps of more than M.
      fully_observable: the optimum of policies that see the states, ``Solution`` of the model.
      start: of the policy: ``"random"`` logits, ``"beliefs"``, a start at the explored controller, or
        ``"explored"``, that controller itself.
      history: metrics ``[T, N]`` of all starts by name, and ``step`` ``[T]``.

    >>> CertifiedController.__dataclass_fields__["start"].name
    'start'
    """

    policy: FiniteMemoryPolicy
    satisfaction: AtInitial
    explored: Solution
    reduced: FiniteMemoryPolicy
    fully_observable: AtInitial
    start: str
    history: dict[str, np.ndarray]


def learn_formula(
    key: Key,
    pomdp: POMDP,
    formula: FormulaLike,
    hparams: Hparams,
    *,
    num_starts: int = 16,
    num_steps: int = 200,
    discount: float = 1.0,
    tolerance: float = 1e-3,
    max_beliefs: int = 2000,
    max_seconds: float | None = None,
    options: ChunkOptions | None = None,
) -> CertifiedController:
    """A finite-state controller for a formula, learned from several starts and certified.

    Beliefs are explored for both bounds of a co-safe or safe formula; of others they are those of
    :func:`~jaxltl.core.values.undiscounted.satisfaction.optimal_satisfaction`. Their controller, if it
    can be reduced to the memory of `hparams`, is one start of the policy gradient; the other starts are
    random. The five best of them are certified with random, without rare, and with likeliest actions. Of
    all controllers within the tolerance of the best value, the one of fewest expected steps to a
    decision is kept.

    Args:
      key: random key.
      pomdp: a concrete POMDP.
      formula: its automaton is hidden, and the memory has to keep what matters of it.
      hparams: of the learner; ``num_memory`` bounds the memory of the policy.
      num_starts, num_steps: number of starts, and gradient steps of each.
      discount: of steps, for the learner of a co-safe formula alone: below 1 it favours quick controllers.
      tolerance, max_beliefs, max_seconds: of the exploration, see
        :func:`~jaxltl.core.values.partial_observability.solve.belief_bounds`.
      options: reports, and a checkpoint from which a run resumes.

    Returns:
      :class:`CertifiedController`.

    Raises:
      ValueError: a formula with unknown propositions, or a discount out of range.

    Example:
      >>> import jaxltl as jl
      >>> rooms = jl.envs.partial_gridworld("a . . g . . x", 1, hidden=["g", "x"], initial="a")
      >>> learned = learn_formula(jax.random.key(0), rooms, "!x U g", Hparams(), num_starts=2, num_steps=3)
      >>> round(float(learned.satisfaction.lower), 6)
      1.0
    """
    joint, final, automaton = task_pomdp(pomdp, formula)
    require_in_range("discount", discount, Range(0, 1, open_below=True))
    decided = np.zeros(joint.num_states, bool)
    if final is None:
        explored = optimal_satisfaction(pomdp, automaton, tolerance=tolerance)
        problem = make_problem(pomdp, formula=automaton)
    else:
        objective, target = ("min", ~final) if automaton.is_safety else ("max", final)
        explored = belief_bounds(
            joint,
            target,
            objective=objective,
            tolerance=tolerance,
            max_beliefs=max_beliefs,
            max_seconds=max_seconds,
        )
        decided[:] = True
        decided[reach_problem(joint, target, None, maximize=objective == "max").state] = False
        problem = make_problem(joint, target, objective=objective)
        if not automaton.is_safety:
            problem = replace(problem, discount=jnp.asarray(discount, problem.gain.dtype))
    reduced = reduced_controller(joint, _controller_of(explored), decided=decided)
    keys = jax.random.split(key, num_starts)
    states = jax.vmap(lambda one: init(one, problem, hparams))(keys)
    fits = reduced.next_memory.shape[1] <= hparams.num_memory
    if fits:
        logits = _padded_logits(logits_of(reduced, problem), hparams.num_memory)
        first = start_at(keys[0], logits, problem, hparams)
        states = jax.tree.map(lambda x, y: x.at[0].set(y), states, first)
    chunks = run_in_chunks(
        step,
        states,
        problem,
        hparams,
        num_steps=num_steps,
        options=replace(options or ChunkOptions(), lanes=True),
    )
    history = {"step": chunks.step, **vars(chunks.metrics)}
    last = problem.sign * np.where(
        np.isfinite(history["value"][-1]), history["value"][-1], -problem.sign
    )
    candidates = [(reduced, "explored")] if fits else []
    for lane in np.argsort(-last, kind="stable")[:_CERTIFIED].tolist():
        one = policy(jax.tree.map(lambda x, i=lane: x[i], chunks.state), problem, hparams)
        likeliest = one.replace(action=np.eye(one.num_actions)[one.action.argmax(-1)])
        common = without_rare_actions(one, _RARE)
        name = "beliefs" if fits and lane == 0 else "random"
        candidates += [(one, name), (common, name), (likeliest, name)]
    small = [reduced_controller(joint, one, decided=decided) for one, _ in candidates]
    values = [_satisfaction(pomdp, one, formula) for one in small]
    lower = np.array([float(x.lower) for x in values])
    slow = [
        _expected_steps(joint, one, decided)
        if decided.any() and value >= lower.max() - tolerance
        else np.inf
        for one, value in zip(small, lower, strict=True)
    ]
    best = (
        int(np.lexsort((-lower, np.array(slow)))[0])
        if np.isfinite(slow).any()
        else int(lower.argmax())
    )
    return CertifiedController(
        policy=small[best],
        satisfaction=values[best],
        explored=complement_event(explored) if automaton.is_safety else explored,
        reduced=reduced,
        fully_observable=optimal_satisfaction(pomdp.fully_observable, formula).at_initial,
        start=candidates[best][1],
        history=history,
    )


def _padded_logits(parameters: ControllerLogits, num_memory: int) -> ControllerLogits:
    """Logits with more memory states, which no update likes to enter."""
    more = num_memory - parameters.action.shape[0]
    action = jnp.pad(parameters.action, ((0, more), (0, 0), (0, 0)))
    update = jnp.pad(parameters.update, ((0, more), (0, 0), (0, 0)))
    least = parameters.update.min()
    return ControllerLogits(
        action, jnp.pad(update, ((0, 0), (0, 0), (0, more)), constant_values=least)
    )


def _controller_of(solution: Solution) -> FiniteMemoryPolicy:
    """The controller of a solution of a POMDP."""
    assert isinstance(solution.policy, FiniteMemoryPolicy)
    return solution.policy


def _expected_steps(joint: POMDP, one: FiniteMemoryPolicy, decided: Array) -> float:
    """Expected steps of a controller until a decided state, an upper bound; perhaps infinite."""
    steps = np.ones(joint.num_states)
    return float(value_of_policy(joint, one, decided, reward=steps, tolerance=1e-3).upper)


def _satisfaction(pomdp: POMDP, one: FiniteMemoryPolicy, formula: FormulaLike) -> AtInitial:
    chain = controlled_chain(pomdp, one)
    return optimal_satisfaction(chain, formula).at_initial
