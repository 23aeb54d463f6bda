"""Winning regions and strategies of turn-based stochastic games: Büchi, parity and GR(1).

The system wins almost surely, or the environment wins with positive probability; without chance
both win surely. Regions are computed on supports, exactly, as fixed points of attractors
(:mod:`jaxltl.core.graphs.attractor`).
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import NamedTuple, TypeAlias, cast

import jax
import numpy as np
from jaxltl.core import struct

from jaxltl.core.array_types import Array
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.pretty_print import brief
from jaxltl.core.games.generalized_reactivity import solve_gr1
from jaxltl.core.games.objective import GR1, Parity, States, buchi
from jaxltl.core.graphs.attractor import attract
from jaxltl.core.graphs.graph import Graph, graph_of, take
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.compiled import compiled_form
from jaxltl.core.models.game import Game, as_game, as_padded_game
from jaxltl.core.models.ops.array_namespace import jax_array, namespace, to_jax
from jaxltl.core.models.product import product
from jaxltl.core.models.protocols import Model, PyTree
from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts, row_entries


@brief(drawn=True)
@struct.dataclass
class Winning:
    """Winning regions of both players, and a winning strategy of each.

    A strategy for GR(1) has memory: the system pursues the guarantees cyclically, from number 0 on, and
    the environment its assumptions.

    Attributes:
      game: the game that was solved; of a formula, the product with its automaton.
      objective: the system's objective.
      region: ``bool[S]``, the system's almost-sure winning region; elsewhere the environment
        prevents the objective with positive probability.
      action: ``int32[S]``, for GR(1) ``int32[S, J]``: the system's winning moves in the region.
      counter_action: ``int32[S]``, for GR(1) ``int32[S, M]``: the environment's outside.

    Example:
      >>> import jaxltl as jl
      >>> fork = jl.from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 0]]], initial=[1, 0],
      ...                      label={"crash": [1]})
      >>> found = jl.winning_region(fork, jl.games.safety(fork, "!crash"))
      >>> found.region.tolist(), int(found.action[0]), bool(found.realizable)
      ([True, False], 0, True)
    """

    game: Game
    objective: Parity | GR1
    region: jax.Array
    action: jax.Array
    counter_action: jax.Array

    @property
    def realizable(self) -> jax.Array:
        """``bool[]``: True if the system wins from every initial state."""
        xp, region, initial = namespace(self.region, self.game.initial)
        return jax_array(xp.all(region | (initial <= 0)))


def winning_region(
    game: Model, formula: Parity | GR1 | Automaton | Formula | str, *, chance: str = "random"
) -> Winning:
    """Winning region of the system, and winning strategies of both players.

    Parity by nested fixpoints (Zielonka 1998; with chance Banerjee, Majumdar, Mallik, Schmuck and
    Soudjani 2022); GR(1) by the triple fixpoint of Piterman, Pnueli and Sa'ar (2006).

    Args:
      game: a Game; any other model is the game in which the system always moves. Actions in one
        on a sparse model are rows, in its product with a task those of
        :func:`~jaxltl.core.models.construct.convert.to_sparse`.
      formula: an objective on the game's states (see :mod:`jaxltl.core.games.objective`), or a
        formula or an automaton, solved on its product with the game (``label_on="exit"``).
      chance: ``"random"``: by the model's probabilities; ``"adversarial"``: the environment
        chooses random successors, so that winning is sure. States from S on are then those choices
        (on the host only; sparse models are padded).

    Returns:
      :class:`Winning`; see :func:`~jaxltl.core.games.verify.verify`. Boolean: there is no derivative;
      regions and moves may be computed under ``jit`` and ``vmap``.

    Raises:
      ValueError: a formula over unknown propositions, or an unknown `chance`.

    Example:
      >>> from jaxltl import from_dense, make_game
      >>> world = from_dense([[[0, 1.0], [1.0, 0]], [[1.0, 0], [0, 1.0]]], label={"a": [1]})
      >>> winning_region(make_game(world, [False, True]), buchi(world, "a")).region.tolist()
      [False, True]
    """
    if chance not in ("random", "adversarial"):
        raise ValueError(f"chance={chance!r}; choose random or adversarial.")
    arena = as_game(game) if chance == "random" else as_padded_game(game)
    arena, objective = on_states(arena, formula)
    if chance == "adversarial":
        arena, origin = adversarial_chance(arena)
        objective = objective_at(objective, origin)
    return solve(arena, objective)


def solve(game: Game, objective: Parity | GR1, moves: jax.Array | None = None) -> Winning:
    """:func:`winning_region` of an objective, restricted to some moves."""
    form, _ = compiled_form(game)
    graph = graph_of(form, objective, moves)
    owner, goal, moves = take(graph, (form.system, _flat(form, objective), moves))
    if isinstance(objective, GR1):
        arrays: Sequence[Array] = solve_gr1(graph, owner, goal, moves)
    else:
        region, action = solve_parity(graph, owner, goal, moves)
        arrays = region, action, action
    if form.state_shape != game.state_shape:
        arrays = [x.reshape(*game.state_shape, *x.shape[1:]) for x in arrays]
    return Winning(game, objective, *to_jax(tuple(arrays)))


def _flat(form: Game, objective: Parity | GR1) -> PyTree:
    """The objective with the states of a compiled form, which may number those of a product."""
    more = objective.lost.ndim - len(form.state_shape)
    if not more:
        return objective
    return jax.tree.map(
        lambda x: x.reshape(*x.shape[: x.ndim - 1 - more], *form.state_shape), objective
    )


def almost_sure_buchi(game: Model, accepting: States) -> Winning:
    """Almost-sure winning region of a Buchi objective.

    Args:
      game, accepting: the game, and ``bool[S]`` or a Boolean formula.

    Returns:
      :class:`Winning`, of the objective :func:`buchi`.

    Raises:
      ValueError: see :func:`buchi`.

    Example:
      >>> from jaxltl import from_dense
      >>> world = from_dense([[[1.0, 0, 0]], [[0.5, 0.5, 0]], [[0, 0, 1.0]]])
      >>> almost_sure_buchi(world, np.arange(3) == 0).region.tolist()
      [True, True, False]
    """
    return winning_region(game, buchi(game, accepting))


def on_states(
    game: Game, formula: Parity | GR1 | Automaton | Formula | str
) -> tuple[Game, Parity | GR1]:
    """A game and an objective on its states; of a formula or an automaton, :func:`task_game`."""
    return (game, formula) if isinstance(formula, Parity | GR1) else task_game(game, formula)


def task_game(game: Game, formula: Automaton | Formula | str) -> tuple[Game, Parity]:
    """The product of a game with a task, and the task as a parity objective on its states."""
    joint = product(game, formula, label_on="exit")
    automaton, letter = joint.mdp.automaton, joint.mdp.letter
    none = to_jax(np.zeros(joint.state_shape, bool))
    if automaton.has_final_states:
        xp, final = namespace(joint.mdp.final)
        cosafe = automaton.is_cosafe
        return joint, Parity(
            priority=to_jax(np.full(joint.state_shape, int(cosafe), np.int32)),
            won=to_jax(final) if cosafe else none,
            lost=none if cosafe else to_jax(xp.logical_not(final)),
            num_priorities=1 + int(cosafe),
        )
    _, priority, letter = namespace(automaton.priority, letter)
    highest = int(np.max(np.asarray(automaton.priority)))
    return joint, Parity(to_jax(priority[:, letter].T), none, none, highest + 1)


def objective_at(objective: Parity | GR1, origin: jax.Array | np.ndarray) -> PyTree:
    """The objective on states of another game, each with an original state."""
    _, arrays, origin = namespace(objective, origin)
    states = objective.lost.ndim

    def pick(x: Array) -> jax.Array:
        return jax_array(x.reshape(*x.shape[: x.ndim - states], -1)[..., origin])

    return jax.tree.map(pick, arrays)


def adversarial_chance(game: Game) -> tuple[Game, jax.Array]:
    """The deterministic game in which the environment chooses random successors, on the host."""
    model = to_sparse(game.mdp)
    host, width = model.host, np.diff(model.host.entry_start)
    random = np.flatnonzero(width > 1)
    choices, _ = row_entries(host.entry_start, random)
    target = host.successor[host.entry_start[:-1]]
    target[random] = host.num_states + np.arange(random.size)
    origin = np.concatenate([np.arange(host.num_states), host.state[random]])
    count = np.concatenate([np.diff(host.row_start), width[random]])
    action = model.rank if model.action is None else np.asarray(model.action)
    split = make_sparse(
        offsets_from_counts(count),
        np.arange(count.sum() + 1),
        np.concatenate([target, host.successor[choices]]),
        np.ones(count.sum()),
        initial=np.append(np.asarray(model.initial), np.zeros(random.size)),
        label=np.asarray(model.label)[origin],
        propositions=model.propositions,
        action=np.concatenate([action, concatenated_ranges(np.zeros_like(random), width[random])]),
    )
    system = np.append(np.asarray(game.system).ravel(), np.zeros(random.size, bool))
    return Game(to_padded(split), to_jax(system)), to_jax(origin.astype(np.int32))


# --- parity -----------------------------------------------------------------------------------


class _Found(NamedTuple):
    """A winning region, with the system's moves inside and the environment's outside."""

    region: Array
    action: Array


class _Arena(NamedTuple):
    """A game graph with its owners and its objective."""

    graph: Graph
    system: Array
    objective: Parity


_MAX_TRACED = 64  # priorities in a traced game, whose loops are nested as deeply


def solve_parity(
    graph: Graph, system: Array, objective: Parity, moves: Array | None = None
) -> _Found:
    """Winning region of a parity game, with moves of both players."""
    if graph.xp is not np and objective.num_priorities > _MAX_TRACED:
        raise ValueError(
            f"the objective has {objective.num_priorities} priorities; inside of jit at most "
            f"{_MAX_TRACED} are supported. Solve the game outside of jit."
        )
    moves = graph.available if moves is None else moves & graph.available
    start = _Found(objective.won & ~objective.lost, graph.first(moves)[1])
    open_ = ~(objective.won | objective.lost)
    return _solved(_Arena(graph, system, objective), _Level(0, start, open_, moves))


class _Level(NamedTuple):
    """Undecided states with priorities of at least p, in which reaching `won` is winning."""

    p: int
    won: _Found
    open_: Array
    allowed: Array


# Levels yield the levels below them and are sent their solutions.
_Solving: TypeAlias = Generator[_Level, PyTree, PyTree]


def _solved(arena: _Arena, level: _Level) -> _Found:
    """The undecided states from which the system wins, with levels on a stack of their own."""
    stack: list[_Solving] = []
    solution: PyTree = None
    task: _Level | None = level
    while True:
        if task is not None:
            p = _next_priority(arena, task)
            if p == arena.objective.num_priorities:
                solution, task = task.won, None
            else:
                solve = _even if p % 2 == 0 else _odd
                stack.append(solve(arena, p, *task[1:]))
                solution = None
        if task is None and not stack:
            return cast(_Found, solution)
        try:
            task = stack[-1].send(solution)
        except StopIteration as stop:
            stack.pop()
            solution, task = stop.value, None


def _next_priority(arena: _Arena, level: _Level) -> int:
    """The least priority from p on; of many, the least one that undecided states have.

    An odd level relies on an even one around it, without undecided states of its priority or with.
    Levels of few priorities are not skipped, so that strategies are those of a traced game.
    """
    count = arena.objective.num_priorities
    if arena.graph.xp is not np or count <= _MAX_TRACED:
        return level.p
    p = int(arena.objective.priority[level.open_].min(initial=count))
    return p - 1 if p < count and p % 2 == 1 and level.p % 2 == 0 else p


def _repeat(arena: _Arena, body: Callable[[PyTree], _Solving], carry: PyTree) -> _Solving:
    """Repeats `body` while the last entry of the carry is true."""
    if arena.graph.xp is not np:
        return arena.graph.repeat(lambda x: _drained(arena, body(x)), carry)
    while carry[-1]:
        carry = yield from body(carry)
    return carry


def _drained(arena: _Arena, solving: _Solving) -> PyTree:
    """The result of a level, whose levels below are traced in it."""
    solution: PyTree = None
    while True:
        try:
            solution = _solved(arena, solving.send(solution))
        except StopIteration as stop:
            return stop.value


def _even(arena: _Arena, p: int, won: _Found, open_: Array, allowed: Array) -> _Solving:
    """Greatest fixpoint: the system can remain, and meeting p infinitely often is winning."""
    graph, system, objective = arena
    xp = graph.xp
    here = open_ & (objective.priority == p)

    def body(carry: PyTree) -> _Solving:
        inside, solution, _ = carry
        # The environment can force the play out with positive probability.
        escaped = attract(graph, ~inside, allowed, rule=~system, among=open_ & inside)
        action = xp.where(inside & escaped.region, escaped.action, solution.action)
        inside = inside & ~escaped.region
        good = _Found(won.region | (here & inside), action)
        deeper = yield _Level(p + 1, good, open_ & ~here & inside, allowed)
        return deeper.region, deeper, xp.any(deeper.region != inside)

    inside = won.region | open_
    inside, solution, _ = yield from _repeat(arena, body, (inside, won, xp.asarray(True)))
    stays = graph.first(allowed & graph.forall(inside))[1]
    return _Found(inside, xp.where(here & inside & system, stays, solution.action))


def _odd(arena: _Arena, p: int, won: _Found, open_: Array, allowed: Array) -> _Solving:
    """Least fixpoint: the system can avoid meeting p infinitely often."""
    graph, system, objective = arena
    xp = graph.xp
    here = open_ & (objective.priority == p)
    # The system makes no move that may leave what an even priority above has it remain in.
    allowed = allowed & (graph.forall(won.region | open_) | ~graph.on_choices(system))

    def body(carry: PyTree) -> _Solving:
        solution, _ = carry
        drawn = attract(graph, solution.region, allowed, rule=system, among=open_)
        new = drawn.region & ~solution.region & system
        attracted = _Found(drawn.region, xp.where(new, drawn.action, solution.action))
        remain = open_ & ~here & ~attracted.region
        # The environment's other moves help the system.
        closer = graph.exists(attracted.region) & ~graph.on_choices(system)
        deeper = yield _Level(p + 1, attracted, remain, allowed & ~closer)
        return deeper, xp.any(deeper.region != attracted.region)

    solution, _ = yield from _repeat(arena, body, (won, xp.asarray(True)))
    avoids = graph.first(allowed & ~graph.exists(solution.region))[1]
    refused = here & ~solution.region & ~system
    return _Found(solution.region, xp.where(refused, avoids, solution.action))
