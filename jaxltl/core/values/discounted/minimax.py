"""Discounted values of zero-sum games, and of one strategy in the worst case.

The system maximises and the environment minimises. Derivatives are by the implicit function
theorem. Shapes are written for states ``[S]``; a game on a Product has ``[S, Q]``. In a game on a
sparse model quantities on actions are ``[R]``, and an action is a row.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core import validation
from jaxltl.core.values.engine.validated import validated
from jaxltl.core.graphs.attractor import attract
from jaxltl.core.graphs.graph import Graph, graph_of, take
from jaxltl.core.models.compiled import compiled_form, compiled_policy, reshape_solution
from jaxltl.core.models.game import Game, as_game
from jaxltl.core.models.ops.array_namespace import jit, namespace, to_jax
from jaxltl.core.models.ops.choices import Layout, Quantity, SweepOperator, choice_shape, choices
from jaxltl.core.models.ops.operators import (
    CheckedPolicy,
    expectation,
    is_deterministic,
    require_policy,
    valid_policy,
)
from jaxltl.core.models.ops.successor_tables import sweep_operator
from jaxltl.core.models.protocols import Array, Model, PyTree
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.types import Solution, require_shape, status_code
from jaxltl.core.values.discounted.compiled import best_action, expected_reward
from jaxltl.core.values.door.question import Accuracy, DiscountedReward, Question
from jaxltl.core.values.engine import newton
from jaxltl.core.values.engine.certificates import (
    RelativeEnclosure,
    backup_error,
    make_enclosure,
    refuse,
    rounding_unit,
)
from jaxltl.core.values.engine.host_solution import negated
from jaxltl.core.values.engine.implicit_diff import implicit
from jaxltl.core.values.engine.iterate import iterate
from jaxltl.core.values.engine.linear import DENSE_LIMIT, System

_PER = ("move", "system_move")
_METHODS = ("policy_iteration", "value_iteration", "strategy_iteration")


@validated(games=True, per=_PER, method=_METHODS)
def minimax_value(
    game: Model,
    reward: chex.Array,
    discount: chex.Numeric,
    *,
    per: str = "move",
    method: str = "policy_iteration",
    allowed: chex.Array | None = None,
    tolerance: chex.Numeric | None = None,
    max_steps: chex.Numeric = 100_000,
) -> Solution:
    """Minimax value: discounted reward that the system secures against every environment.

    ``V(s) = max_a R(s, a) + g(s) * sum_t P(t | s, a) V(t)`` where the system moves, the same
    with min where the environment does (Shapley 1953; dissertation, section 5.2.4). With
    ``per="move"``, g is the discount; with ``per="system_move"``, 1 at the environment's states.
    With the maximal discounted time ``h >= 1 + g P h``, ``|T v - v| <= e`` bounds the error by
    ``e * h``.

    Args:
      game: a Game; any other model is the game in which the system always moves.
      reward: ``float[S]``, ``float[S, A]`` or ``float[S, A, K]``; rewards at environment states count. In
        a game on a sparse model as of :func:`~jaxltl.core.models.sparse.choice_reward`.
      discount: scalar in [0, 1).
      per: ``"move"`` or ``"system_move"``, which moves are discounted.
      method: ``"policy_iteration"`` (Pollatschek and Avi-Itzhak 1969, with sweeps where a step does
        not halve the error), ``"value_iteration"`` or ``"strategy_iteration"`` (Hoffman and Karp
        1966), which always ends.
      allowed: ``bool[S, A]``, the action mask, such as a permissive strategy; default the available
        moves. A state without any has the value minus infinity.
      tolerance: width of the enclosure; default: as narrow as the dtype allows.
      max_steps: maximal number of backups, or of strategies in strategy iteration, without those
        for h; default 100,000.

    Returns:
      :class:`Solution`; `policy` is ``int32[S]``, greedy for both players: the system's part
      secures at least `lower`, the environment's concedes at most `upper`, where these are finite.
      Differentiable in the reward, the discount and the probabilities, where greedy choices are
      unique.

    Raises:
      ValueError: a wrong shape, an unknown method or `per`, or, with ``per="system_move"``, an
        environment that can move for ever without the system (under ``jit``: status NONFINITE).

    Example:
      >>> from jaxltl import from_dense, make_game
      >>> world = from_dense([[[0, 1.0], [0, 1.0]], [[1.0, 0], [1.0, 0]]])
      >>> game = make_game(world, [True, False])
      >>> reward = jnp.array([[1.0, 2.0], [0.0, 1.0]])
      >>> best = minimax_value(game, reward, 0.5, per="system_move")
      >>> [round(v, 4) for v in best.value.tolist()], best.policy.tolist()
      ([4.0, 4.0], [1, 0])
    """
    game_model = as_game(game)
    form, reward = compiled_form(game_model, reward)
    if allowed is not None:
        require_shape("allowed", allowed, choice_shape(form))
    graph = graph_of(form, allowed)
    xp = graph.xp
    system, moves = take(graph, (form.system, graph.available))
    if allowed is not None:
        moves = moves & xp.asarray(allowed, bool)
    # Chance and the environment may lead to where play gets stuck.
    lost = attract(graph, ~graph.first(moves)[0], moves, rule=~system).region
    moves = moves & ~graph.on_choices(lost) & ~graph.exists(lost)
    defined = _returns(graph, per, system | lost, moves, xp.zeros_like(lost))
    moves, live = to_jax((moves, ~lost))
    problem = _MinimaxProblem(form, None, moves, live, defined, reward, discount)
    return reshape_solution(
        game_model, _solve(problem, tolerance, max_steps, per=per, method=method)
    )


def discounted_game(model: Model, question: Question, accuracy: Accuracy) -> Solution:
    """Discounted rewards of traced games; a minimum is that of the negated reward."""
    path, game = question.path, as_game(model)
    assert isinstance(path, DiscountedReward)
    if question.environment == "cooperative":
        if question.policy is not None:
            raise ValueError(
                "environment='cooperative' with a policy is answered for concrete games; call it outside jit."
            )
        game = replace(game, system=jnp.ones_like(game.system))
    sign = 1 if question.objective == "max" or question.policy is not None else -1
    reward = path.reward if sign > 0 else jax.tree.map(jnp.negative, path.reward)
    width, policy = accuracy.tolerance, question.policy
    if policy is None:
        solution = minimax_value(game, reward, path.discount, tolerance=width)
    else:
        solution = strategy_value(game, policy, reward, path.discount, tolerance=width)
    return solution if sign > 0 else negated(solution)


@validated(games=True, per=_PER, method=_METHODS)
def strategy_value(
    game: Model,
    strategy: chex.Array,
    reward: chex.Array,
    discount: chex.Numeric,
    *,
    per: str = "move",
    environment: chex.Array | str = "adversarial",
    method: str = "policy_iteration",
    tolerance: chex.Numeric | None = None,
    max_steps: chex.Numeric = 100_000,
) -> Solution:
    """Discounted value of a strategy, against the worst case or a policy of the environment.

    ``V(s) = sum_a mu(s, a) (R(s, a) + g(s) * P V)`` where the system moves; where the
    environment does, the minimum over its moves (dissertation, (5.2)), or the mean under its
    policy. Discounts, methods and bounds are those of :func:`minimax_value`.

    Args:
      game, reward, discount, per, method, tolerance, max_steps: as in :func:`minimax_value`.
      strategy: ``int32[S]`` or ``float[S, A]``, distributions over available moves at the system's
        states. A deadlock, and each state from which it can be reached, has the value minus
        infinity.
      environment: ``"adversarial"``, or a policy ``int32[S]`` or ``float[S, A]``.

    Returns:
      :class:`Solution`; `policy` is ``float[S, A]``, both players' choices. Differentiable in the
      reward, the discount, the probabilities and stochastic strategies, wherever the environment's
      best answer is unique.

    Raises:
      ValueError: as :func:`minimax_value`; or a row of the strategy or of the environment's policy
        is not a distribution over available moves (under ``jit``: status INVALID).

    Example:
      >>> from jaxltl import from_dense, make_game
      >>> world = from_dense([[[0, 1.0], [0, 1.0]], [[1.0, 0], [1.0, 0]]])
      >>> game = make_game(world, [True, False])
      >>> reward = jnp.array([[1.0, 2.0], [0.0, 1.0]])
      >>> worst = strategy_value(game, jnp.array([0, 0]), reward, 0.5, per="system_move")
      >>> [round(v, 4) for v in worst.value.tolist()]
      [2.0, 2.0]
    """
    game_model = as_game(game)
    form, reward = compiled_form(game_model, reward)
    if isinstance(environment, str):
        validation.choice("environment", environment, ("adversarial",))
        environment = None
    own = game_model.system
    strategy = compiled_policy(game_model, strategy, own)
    policies = [("strategy", strategy, form.system)]
    if environment is not None:
        environment = compiled_policy(game_model, environment, ~own)
        policies.append(("environment", environment, ~form.system))
    for name, policy, states in policies:
        kind, shape = "stochastic", choice_shape(form)
        if is_deterministic(policy):
            kind, shape = "of integers", form.state_shape
        require_shape(f"{name} ({kind})", policy, shape)
        if not isinstance(form.mdp, SparseMDP):  # those of sparse models are checked above
            require_policy(form, policy, _read(form, states))
    checked = _joint(form, strategy, environment)
    graph = graph_of(form, checked)
    system, used = take(graph, (form.system, checked.used))
    followed = graph.xp.ones_like(system)
    drawn = followed if environment is not None else system
    moves = graph.available & graph.xp.where(graph.on_choices(drawn), used, True)
    # Fixed policies do not avoid states without moves.
    lost = attract(graph, ~graph.first(moves)[0], moves, rule=followed).region
    moves = moves & ~graph.on_choices(lost)
    defined = _returns(graph, per, system | lost, moves, drawn)
    moves, drawn, live = to_jax((moves, drawn, ~lost))
    checked = checked._replace(used=drawn)
    problem = _MinimaxProblem(form, checked, moves, live, defined, reward, discount)
    return reshape_solution(
        game_model, _solve(problem, tolerance, max_steps, per=per, method=method)
    )


def _read(game: Game, states: Array) -> Array:
    """A player's states with available moves: rows of its policy that are read."""
    if isinstance(game.mdp, SparseMDP):  # every state has a choice
        return states
    xp, states, available = namespace(states, game.available)
    return states & xp.any(available, axis=-1)


class _FixedPolicies(NamedTuple):
    """Policies of the players that do not optimise."""

    policy: CheckedPolicy
    used: jax.Array  # bool[S, A], the moves of positive weight; later bool[S], where they count


class _MinimaxProblem(NamedTuple):
    """A discounted game with its graph's preprocessing."""

    game: Game
    drawn: _FixedPolicies | None  # policies of the players that do not optimise
    moves: jax.Array  # that may be made
    live: jax.Array  # states from which play does not get stuck
    defined: jax.Array  # whether values exist
    reward: chex.Array
    discount: chex.Numeric


@jit()
def _joint(game: Game, strategy: chex.Array, environment: chex.Array | None) -> _FixedPolicies:
    """Joint policy of both players, zero where neither is read."""
    read, over = _read(game, game.system), choices(game)
    weight, joint, valid, representable = valid_policy(game, jnp.asarray(strategy), read)
    weight = jnp.where(over.broadcast(read), weight, 0)  # rows that are not read
    if environment is not None:
        read = _read(game, ~game.system)
        other = valid_policy(game, jnp.asarray(environment), read)
        weight = jnp.where(over.broadcast(read), other.distribution, weight)
        joint = jnp.where(over.broadcast(read), other.masked, joint)
        valid &= other.valid
    return _FixedPolicies(
        CheckedPolicy(weight, joint, valid, representable), lax.stop_gradient(weight) > 0
    )


def _returns(graph: Graph, per: str, goal: Array, moves: Array, drawn: Array) -> Array:
    """True if the environment always returns to a goal, so that values per system move exist."""
    if per == "move":
        return np.True_
    back = attract(graph, goal, moves, rule=drawn).region
    if graph.xp is np and not back.all():
        first = tuple(int(i) for i in np.argwhere(~back)[0])
        raise ValueError(
            f"from state {first[0] if len(first) == 1 else first} the environment can move "
            "for ever without the system, and such moves are not discounted with "
            "per='system_move', so there is no value; use per='move', or give the system "
            "a move in every cycle."
        )
    return back.all()


class _DiscountedGame(NamedTuple):
    """Numbers of a discounted game over flat states; lanes may differ in all of them."""

    system: jax.Array
    drawn: jax.Array | None  # states in which moves are drawn by `weight`
    weight: Quantity  # in columns
    horizon: jax.Array  # the largest value of h; infinite or NaN without a bound
    discount: jax.Array
    unit: jax.Array  # relative rounding of a backup
    size: jax.Array  # the largest reward
    tolerance: jax.Array | None


def _chosen(over: Layout, q: Quantity, play: _DiscountedGame) -> tuple[jax.Array, Quantity]:
    """Values and weights of both players' best moves."""
    own = jax.tree.map(lambda s, x: jnp.where(s, x, -x), over.broadcast(play.system, q), q)
    best, weight = best_action(over, own, play)
    best = jnp.where(play.system, best, -best)
    if play.drawn is None:
        return best, weight
    weight = jax.tree.map(jnp.where, over.broadcast(play.drawn, q), play.weight, weight)
    return jnp.where(play.drawn, _mean(over, weight, q), best), weight


def _mean(over: Layout, weight: Quantity, q: Quantity) -> jax.Array:
    """The mean of columns that are infinite where moves are not allowed."""
    return over.mean(weight, jax.tree.map(lambda x: jnp.where(jnp.isinf(x), 0, x), q))


def _gains(
    rows: SweepOperator, play: _DiscountedGame, reward: Quantity, moves: Quantity, live: jax.Array
) -> Quantity:
    """Columns of a reward: infinitely bad for the owner at moves that are not allowed."""
    never = jnp.where(play.system, -jnp.inf, jnp.inf).astype(play.discount.dtype)
    if play.drawn is not None:
        never = jnp.where(play.drawn, 0, never)
    to_choices = rows.choices.broadcast
    return jax.tree.map(
        lambda lives, m, r, none: jnp.where(lives, jnp.where(m, r, none), 0),
        to_choices(live, reward),
        moves,
        reward,
        to_choices(never, reward),
    )


def _horizon(
    rows: SweepOperator,
    play: _DiscountedGame,
    problem: _MinimaxProblem,
    moves: Quantity,
    per: str,
    max_steps: chex.Numeric,
) -> jax.Array:
    """A function h with ``h >= 1 + g P h`` for all moves; infinite or NaN without one.

    With tau the maximal expected number of undiscounted moves before the next discounted one, and
    L its maximum over states: ``h = (1 + discount * L) / (1 - discount) + tau``.
    """
    tau, live, defined = jnp.zeros((), play.discount.dtype), problem.live.ravel(), problem.defined
    if per == "system_move":
        free = live & ~play.system
        slow = play._replace(system=jnp.ones_like(live))

        def judge(
            tau: jax.Array, after: jax.Array, parameters: tuple[_DiscountedGame, jax.Array]
        ) -> tuple[jax.Array, jax.Array]:
            growth = jnp.max(after - tau, axis=0)
            # Below, from 1 + P tau <= tau + growth follows that tau / (1 - growth) is enough.
            return (growth <= 2.0**-7) | ~jnp.isfinite(growth) | ~parameters[1], jnp.abs(growth)

        ones = jax.tree.map(lambda m: jnp.ones(m.shape, tau.dtype), moves)
        tau, after, *_ = newton.solve(
            rows,
            newton.Method(lambda over, q, parameters: _chosen(over, q, parameters[0]), judge),
            newton.Backup(
                _gains(rows, slow, ones, moves, free),
                free.astype(tau.dtype),
                jnp.zeros_like(play.discount),
                (slow, defined),
            ),
            jnp.zeros(live.shape, tau.dtype),
            max_steps=max_steps,
        )
        growth = jnp.max(after - tau)
        tau = jnp.where(growth < 0.5, tau / (1 - growth), jnp.inf)
    horizon = (1 + play.discount * jnp.max(tau)) / (1 - play.discount) + tau
    slack = 2 * play.unit * jnp.max(horizon)
    horizon = jnp.where(slack < 0.5, horizon * (1 + slack), jnp.inf)
    valid = defined & (play.discount >= 0) & (play.discount < 1)
    return jnp.where(valid, horizon, jnp.nan)


def _certify(play: _DiscountedGame, value: jax.Array, image: jax.Array) -> RelativeEnclosure:
    """``T v + [down, up]`` encloses the fixed point of T; `horizon` for each state or its largest.

    With ``c = max(T v - v)``: if c >= 0, ``u = v + c h`` has ``T u <= u``, so the fixed point
    is at most ``T u <= T v + c (h - 1)``. If c < 0 the same holds with the constant
    ``1 / (1 - discount)``, as no move is discounted more. Likewise below. As the width grows
    with h, the maximum of h in place of h gives a sufficient stopping criterion.
    """
    horizon = play.horizon
    unit = backup_error(play.unit, play.size, jnp.max(jnp.abs(image), axis=0))
    change = image - value
    top, bottom = jnp.max(change, axis=0), jnp.min(change, axis=0)
    least = play.discount / (1 - play.discount)
    up = top * jnp.where(top > 0, horizon - 1, least) + unit * horizon
    down = bottom * jnp.where(bottom < 0, horizon - 1, least) - unit * horizon
    finite = jnp.isfinite(top - bottom) & jnp.isfinite(play.size) & ~jnp.isnan(horizon)
    return make_enclosure(down, up, unit * horizon, play.tolerance)._replace(finite=finite)


def _judge(
    value: jax.Array, image: jax.Array, play: _DiscountedGame
) -> tuple[jax.Array, jax.Array]:
    enclosure = _certify(play, value, image)
    # Without a finite horizon no number of sweeps gives a bound.
    return enclosure.converged | enclosure.exhausted | ~jnp.isfinite(enclosure.half), enclosure.half


_FIRST_SWEEPS = 128  # of large games: they cost less than linear systems far from the value


@jit("per", "method")
def _solve(
    problem: _MinimaxProblem,
    tolerance: chex.Numeric | None,
    max_steps: chex.Numeric,
    *,
    per: str,
    method: str,
) -> Solution:
    game, drawn, moves, live, _, reward, discount = problem
    discount = jnp.asarray(discount, game.dtype)
    size = jnp.where(moves, expected_reward(game, jax.tree.map(jnp.abs, reward)), 0)
    reward, over = jnp.where(moves, expected_reward(game, reward), 0), choices(game)
    free = ~game.system if per == "system_move" else jnp.zeros_like(game.system)
    rate = jnp.where(live, jnp.where(free, 1, discount), 0)
    sign = jnp.where(game.system, 1, -1).astype(game.dtype)

    def backup(value: jax.Array) -> jax.Array:
        q = reward + over.broadcast(rate) * expectation(game, value)
        best = sign * over.max(over.broadcast(sign) * q, moves)
        if drawn is not None:
            best = jnp.where(drawn.used, over.mean(drawn.policy.distribution, q), best)
        return jnp.where(live, best, 0)

    flat = live.ravel()
    play = _DiscountedGame(
        game.system.ravel(),
        None if drawn is None else drawn.used.ravel(),
        None if drawn is None else over.columns(drawn.policy.distribution),
        discount,
        discount,
        jnp.asarray(rounding_unit(game), game.dtype),
        jnp.max(size),
        None if tolerance is None else jnp.asarray(tolerance, game.dtype),
    )
    rows, columns = sweep_operator(game), over.columns(moves)
    horizon = _horizon(rows, play, problem, columns, per, max_steps)
    play = play._replace(horizon=jnp.max(horizon))
    numbers = newton.Backup(
        _gains(rows, play, over.columns(reward), columns, flat),
        rate.ravel(),
        jnp.zeros_like(discount),
        play,
    )
    zero = jnp.zeros(flat.shape, game.dtype)
    value, image, num_steps, weight = _approached(rows, numbers, zero, method, max_steps)
    play, horizon = lax.stop_gradient((play, horizon))
    weight = over.whole(weight)
    verdict = _certify(play, value, image)
    evidence = verdict
    if per == "system_move":
        evidence = _certify(play._replace(horizon=horizon), value, image)
    known = jnp.all(evidence.half < jnp.inf)

    def answer(x: jax.Array) -> jax.Array:
        return jnp.where(live, x.reshape(live.shape), -jnp.inf)

    middle = image + evidence.shift
    solution = Solution(
        value=middle.reshape(live.shape),
        policy=over.first(weight == 1)[1] if drawn is None else weight,
        lower=answer(jnp.where(known, middle - evidence.half, -jnp.inf)),
        upper=answer(jnp.where(known, middle + evidence.half, jnp.inf)),
        residual=jnp.max(jnp.abs(image - value)),
        num_steps=num_steps,
        status=status_code(verdict.converged, verdict.finite, verdict.exhausted),
    )
    solution = jax.tree.map(lax.stop_gradient, solution)
    solution = replace(solution, value=answer(implicit(backup, solution.value)))
    return refuse(solution, None if drawn is None else drawn.policy)


def _approached(
    rows: SweepOperator,
    numbers: newton.Backup,
    zero: jax.Array,
    method: str,
    max_steps: chex.Numeric,
) -> tuple[jax.Array, jax.Array, jax.Array, PyTree]:
    """Approximate fixed point, its image, the number of steps, and the weights of its choices."""
    policies = method == "policy_iteration"
    if method == "strategy_iteration":
        value, image, num_steps = _strategy_iteration(rows, numbers, zero, max_steps)
    else:
        value, image, num_steps, chosen = newton.solve(
            rows,
            newton.Method(_chosen, _judge, newton=policies, monotone=False),
            numbers,
            zero,
            first_sweeps=_FIRST_SWEEPS if zero.size > DENSE_LIMIT else 0,
            max_steps=max_steps,
        )
    rows, numbers = lax.stop_gradient((rows, numbers))
    if policies:
        return value, image, num_steps, rows.choices.unpacked(chosen)
    q = newton.action_values(rows.choices, numbers, rows.expectation(value))
    return value, image, num_steps, _chosen(rows.choices, q, numbers.extra)[1]


_UNCHANGED = 3  # solves without a change of strategy after which more would not help


class _Strategies(NamedTuple):
    """State of strategy iteration: z is the value of the choices `weight`."""

    z: jax.Array
    weight: Quantity
    value: jax.Array
    image: jax.Array
    unchanged: jax.Array
    done: jax.Array


def _strategy_iteration(
    rows: SweepOperator, numbers: newton.Backup, zero: jax.Array, max_steps: chex.Numeric
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Solves for the value of both players' choices, then improves the environment's, or,
    where those are a best answer already, the system's (Hoffman and Karp 1966)."""

    def step(rows: SweepOperator, k: _Strategies, backup: newton.Backup) -> _Strategies:
        over, play = rows.choices, backup.extra
        q = newton.action_values(over, backup, rows.expectation(k.z))
        image, best = _chosen(over, q, play)
        own = _mean(over, k.weight, q)
        margin = 2 * play.unit * (play.size + jnp.max(jnp.abs(k.z)))
        better = jnp.where(play.system, image - own, own - image) > margin
        if play.drawn is not None:
            better &= ~play.drawn
        answers = better & ~play.system
        change = jnp.where(answers.any(), answers, better)
        weight = jax.tree.map(jnp.where, over.broadcast(change, q), best, k.weight)
        unchanged = jnp.where(change.any(), 0, k.unchanged + 1)
        done = _judge(k.z, image, play)[0] | (unchanged > _UNCHANGED)

        def solved() -> jax.Array:
            # Solving for the correction refines the value where the choices stay the same.
            return k.z + System(rows, weight, backup.scale).solve(_mean(over, weight, q) - k.z)

        z = lax.cond(done, lambda: k.z, solved)
        return _Strategies(z, weight, k.z, image, unchanged, done)

    start = _Strategies(
        zero,
        _chosen(rows.choices, numbers.reward, numbers.extra)[1],
        zero,
        zero,
        jnp.int32(-1),
        jnp.bool_(False),
    )
    last, n = iterate(step, lambda k, _: k.done, (rows, start, numbers), max_steps=max_steps)
    return last.value, last.image, n
