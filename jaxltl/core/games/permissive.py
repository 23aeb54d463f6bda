"""Permissive strategies: masks of moves of which every choice wins (Wen 2019, 5.4.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import chex
import jax
import numpy as np
from jaxltl.core import struct

from jaxltl.core.array_types import Booleans
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.pretty_print import brief
from jaxltl.core.games.generalized_reactivity import NEVER, gr1_layers, solve_gr1
from jaxltl.core.games.objective import GR1, Parity
from jaxltl.core.games.winning import objective_at, on_states, solve_parity
from jaxltl.core.graphs.attractor import attract
from jaxltl.core.graphs.graph import graph_of
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.models.construct.restrict import Restriction, restrict
from jaxltl.core.models.game import Game, as_padded_game
from jaxltl.core.models.mesh.sharded import refuse_sharded
from jaxltl.core.models.ops import operators
from jaxltl.core.models.ops.array_namespace import jax_array, namespace, to_jax
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array, Model, PyTree
from jaxltl.core.sparse.graph.row_graph import RowGraph
from jaxltl.core.sparse.rows import first_action

METHODS = ("auto", "stay", "rank", "counter", "parity")


@brief(drawn=True)
@struct.dataclass
class Permissive:
    """A permissive strategy: its allowed moves, on the game with its memory.

    Attributes:
      game: the game itself, or a Game on a Product with the strategy's memory.
      region: ``bool[S]`` (``[S, Q]``), the winning region of the strategy.
      allowed: ``bool[S, A]``: in the region the allowed moves, with all of the environment's;
        False elsewhere.
      base_state, automaton_state: ``int32[S]``, the state of the world and of the task's
        automaton for each of the game's world states.
      maximal: True if it includes every winning strategy; static.
      reason: the strategies that it includes, in words; static.

    Example:
      >>> import jaxltl as jl
      >>> fork = jl.from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 0]]], initial=[1, 0],
      ...                      label={"crash": [1]})
      >>> found = jl.permissive_strategy(fork, "G !crash")
      >>> found.region[0].tolist(), found.allowed[0].any(0).tolist(), found.maximal
      ([True, False], [True, False], True)
    """

    game: Game
    region: jax.Array
    allowed: jax.Array
    base_state: jax.Array
    automaton_state: jax.Array
    maximal: bool = struct.field(pytree_node=False)
    reason: str = struct.field(pytree_node=False)


def permissive_strategy(
    game: Model,
    formula: Parity | GR1 | Automaton | Formula | str,
    *,
    method: str = "auto",
    bound: int | None = None,
) -> Permissive:
    """Permissive strategy: a mask of moves of which every choice wins; on the host.

    - ``"stay"``: every move that surely stays in the winning region. Wins if staying does, as for
      safety, and then includes every winning strategy (dissertation, proposition 1).
    - ``"rank"``, for Buchi and GR(1): away from the goal, moves that come nearer to it.
    - ``"counter"``, for Buchi: paths that meet the accepting states again within `bound` of
      the system's moves (dissertation, example 3).
    - ``"parity"``: paths that meet a state of odd priority at most `bound` times before one of
      a lower even priority (Bernet, Janin and Walukiewicz 2002); default: the number of such
      states, which includes every memoryless winning strategy.
    - ``"auto"``: ``"stay"`` if it wins; else ``"counter"`` if there is a bound and the
      objective is Buchi; else ``"rank"``, or ``"parity"`` for other objectives.

    Args:
      game: a Game, an MDP or a Product.
      formula: an objective, a formula or an automaton, as for
        :func:`~jaxltl.core.games.winning.winning_region`.
      method: see above.
      bound: for ``"counter"`` and ``"parity"``.

    Returns:
      :class:`Permissive`. In stochastic games ``"rank"`` wins almost surely, and the counts
      of ``"counter"`` and ``"parity"`` hold surely.

    Raises:
      ValueError: the specification is unrealizable from every initial state, or the method
        does not fit the objective.

    Example:
      >>> from jaxltl import from_dense
      >>> world = from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 0]]],
      ...                    label={"crash": [1]}, initial=[1, 0])
      >>> permissive_strategy(world, "G !crash").allowed[0].any(0).tolist()
      [True, False]
    """
    if not isinstance(method, str) or method not in METHODS:
        raise ValueError(f"method={method!r}; choose one of {', '.join(METHODS)}.")
    if bound is not None and bound < 1:
        raise ValueError(f"bound={bound}; it must be at least 1.")
    world, goal = on_states(as_padded_game(game), formula)
    graph = concrete_graph(world, goal)
    objective: PyTree
    world, objective = jax.tree.map(np.asarray, (world, goal))
    if isinstance(objective, Parity) and not _closed(graph, objective.won):
        world, objective, origin = _remember_won(world, objective)
        strategy = permissive_strategy(world, objective, method=method, bound=bound)
        state = np.asarray(strategy.base_state)
        return replace(
            strategy,
            base_state=to_jax(origin.base_state[state]),
            automaton_state=to_jax(origin.memory[state]),
        )
    if isinstance(objective, Parity):
        objective = _without_won(objective)
    arena = _PermissiveArena(world, graph, objective)
    region = _region(arena)
    _require_start(world, region)
    stay = staying(graph, region)
    maximal = _always_wins(arena, region, stay)
    if method == "auto":
        method = _choose(objective, maximal, bound)
    if method == "stay":
        if not maximal:
            raise ValueError(
                'method="stay": some run that stays in the winning region for ever does not '
                "win, so no strategy includes every winning one; choose rank, counter or parity."
            )
        return _on(
            world,
            region,
            stay,
            True,
            "maximal: every run that stays in the winning region wins, so it includes "
            "every winning strategy",
        )
    build = {"rank": _by_rank, "counter": _by_counter, "parity": _by_parity}[method]
    return build(arena, region, stay, bound)


def apply_strategy(strategy: Permissive) -> Restriction:
    """The game restricted to the moves of a permissive strategy (dissertation, algorithm 3, step 2).

    The part reachable from initial states in the winning region; every run of it wins.

    Args:
      strategy: of :func:`permissive_strategy`, winning from some initial state.

    Returns:
      A :class:`~jaxltl.core.models.construct.restrict.Restriction`; ``base_state`` and ``memory`` number the
      states of ``strategy.game``.

    Raises:
      ValueError: as of :func:`~jaxltl.core.models.construct.restrict.restrict`.

    Example:
      >>> import jaxltl as jl
      >>> fork = jl.from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 0]]], initial=[1, 0],
      ...                      label={"crash": [1]})
      >>> apply_strategy(permissive_strategy(fork, "G !crash")).model.available.tolist()
      [[True, False]]
    """
    region, initial = np.asarray(strategy.region), np.asarray(strategy.game.initial)
    initial = np.where(region, initial, 0)
    return restrict(strategy.game, initial / initial.sum(), allowed=strategy.allowed)


def shield_policy(policy: jax.Array, allowed: jax.Array) -> jax.Array:
    """A policy restricted to the allowed moves of a mask.

    Args:
      policy: ``float[S, A]``, or ``int32[S]`` for a deterministic policy.
      allowed: ``bool[S, A]``, a mask of moves.

    Returns:
      A policy of the same kind. Distributions are scaled to the allowed moves, uniform if their mass
      there is zero; a deterministic move that is not allowed becomes the first allowed one. States
      without allowed moves are unchanged. Differentiable in the policy.

    Raises:
      ValueError: the mask allows nothing at all, or the shapes differ.

    Example:
      >>> shield_policy(np.array([[0.5, 0.25, 0.25]]), np.array([[False, True, True]])).tolist()
      [[0.0, 0.5, 0.5]]
    """
    xp, policy, allowed = namespace(policy, allowed)
    if xp is np and not allowed.any():
        raise ValueError(
            "the mask allows no move in any state; the specification is "
            "unrealizable, or the mask is of another game."
        )
    first_of: Callable[..., tuple[Array, Array]] = (
        first_action if xp is np else operators.first_action
    )
    some, first = first_of(allowed)
    if operators.is_deterministic(policy):
        if policy.shape != allowed.shape[:-1]:
            raise ValueError(
                f"policy has shape {policy.shape}; the mask's states have {allowed.shape[:-1]}."
            )
        inside = xp.take_along_axis(allowed, policy[..., None], axis=-1)[..., 0]
        return jax_array(xp.where(inside | ~some, policy, first.astype(policy.dtype)))
    if policy.shape != allowed.shape:
        raise ValueError(f"policy has shape {policy.shape}; the mask has {allowed.shape}.")
    masked = xp.where(allowed, policy, 0)
    total = masked.sum(-1, keepdims=True)
    uniform = (allowed / xp.maximum(allowed.sum(-1, keepdims=True), 1)).astype(policy.dtype)
    shielded = xp.where(total > 0, masked / xp.where(total > 0, total, 1), uniform)
    return jax_array(xp.where(some[..., None], shielded, policy))


# --- shared by all methods -------------------------------------------------------------------


class _PermissiveArena(NamedTuple):
    """A game in NumPy arrays, its graph, and the system's objective."""

    game: Game
    graph: RowGraph
    objective: PyTree


def concrete_graph(game: Game, objective: Parity | GR1 | None = None) -> RowGraph:
    """The graph of a concrete padded game; ValueError for others."""
    refuse_sharded(game)
    graph = graph_of(game, objective)
    if not isinstance(graph, RowGraph) or not graph.is_padded:
        raise ValueError(
            "permissive strategies are built on the host: call permissive_strategy "
            "outside of jit and vmap, on an MDP, a DenseMDP or a Product."
        )
    return graph


def _region(arena: _PermissiveArena) -> np.ndarray:
    solve: Callable[..., PyTree] = solve_gr1 if isinstance(arena.objective, GR1) else solve_parity
    result: np.ndarray = solve(arena.graph, arena.game.system, arena.objective).region
    return result


def staying(graph: RowGraph, region: np.ndarray) -> np.ndarray:
    """``bool[S, A]``: the moves that surely stay in a region."""
    result: np.ndarray = graph.available & region[..., None] & graph.forall(region)
    return result


def _wins_somewhere(game: Game, region: np.ndarray) -> bool:
    return bool(np.asarray(region)[np.asarray(game.initial) > 0].any())


def _require_start(game: Game, region: np.ndarray) -> None:
    if not _wins_somewhere(game, region):
        state, *memory = np.argwhere(np.asarray(game.initial) > 0)[0].tolist()
        name = f"{state}, with memory state {memory[0]}" if memory else state
        raise ValueError(
            "the specification is unrealizable: the environment wins from every initial state, "
            f"for example state {name}. winning_region(...).counter_action shows how; weaken the "
            "task, or assume something of the environment."
        )


def _always_wins(arena: _PermissiveArena, region: np.ndarray, mask: np.ndarray) -> bool:
    """True if every path within a mask achieves the objective."""
    _, graph, objective = arena
    if isinstance(objective, Parity) and objective.num_priorities == 1:
        return True  # nothing but safety
    within = replace(objective, lost=objective.lost | ~region)
    solve = solve_gr1 if isinstance(objective, GR1) else solve_parity
    hostile = np.zeros(graph.state_shape, bool)
    return bool(np.all(solve(graph, hostile, within, mask).region | ~region))


def _is_buchi(objective: Parity | GR1) -> bool:
    return isinstance(objective, Parity) and objective.num_priorities == 2


def _choose(objective: Parity | GR1, maximal: bool, bound: int | None) -> str:
    if maximal:
        return "stay"
    if _is_buchi(objective):
        return "rank" if bound is None else "counter"
    return "rank" if isinstance(objective, GR1) else "parity"


def _on(
    game: Game,
    region: Array,
    mask: Array,
    maximal: bool,
    reason: str,
    origin: Restriction | None = None,
) -> Permissive:
    """The strategy with JAX arrays."""
    base = np.arange(game.mdp.mdp.num_states if _is_lazy(game) else game.num_states, dtype=np.int32)
    state, memory = (base, np.zeros_like(base)) if origin is None else origin[1:]
    game, region, mask, state, memory = to_jax((game, region, mask, state, memory))
    return Permissive(game, region, mask, state, memory, maximal, reason)


def _is_lazy(game: Game) -> bool:
    return isinstance(game.mdp, Product)


def _explicit(
    arena: _PermissiveArena, region: np.ndarray, mask: np.ndarray
) -> tuple[_PermissiveArena, Restriction | None]:
    """The game with explicit states, restricted to its winning region."""
    game, _, objective = arena
    if not _is_lazy(game):
        return arena, None
    start = np.where(region, game.initial, 0)
    restriction = jax.tree.map(np.asarray, restrict(game, start / start.sum(), allowed=mask))
    origin = restriction.base_state * game.state_shape[1] + restriction.memory
    model = restriction.model
    return _PermissiveArena(model, concrete_graph(model), _at(objective, origin)), restriction


def _at(objective: Parity | GR1, origin: np.ndarray) -> PyTree:
    return jax.tree.map(np.asarray, objective_at(objective, origin))


def _beside(game: Game, delta: np.ndarray, initial: int, letter: chex.Array, label_on: str) -> Game:
    """Product of the game with a memory that reads a letter of each state."""
    num_letters = delta.shape[1]
    automaton = Automaton(
        delta=delta.astype(np.int32),
        initial=initial,
        priority=np.zeros(delta.shape, np.int32),
        letters=np.eye(num_letters, dtype=bool),
        propositions=tuple(f"letter_{i}" for i in range(num_letters)),
        acceptance="parity",
    )
    joint = Product(game.mdp, automaton, np.asarray(letter, np.int32), label_on)
    system: Array = np.broadcast_to(game.system[:, None], joint.state_shape)
    return Game(joint, system)


def _closed(graph: RowGraph, region: Array) -> bool:
    return bool(np.all(~region[..., None] | ~graph.available | graph.forall(region)))


def _without_won(objective: Parity) -> Parity:
    """The objective with won states absorbing, of the best priority."""
    return replace(
        objective,
        priority=np.where(objective.won, 0, objective.priority),
        won=np.zeros_like(objective.won),
        lost=objective.lost & ~objective.won,
    )


def _remember_won(game: Game, objective: Parity) -> tuple[Game, Parity, Restriction]:
    """Product of the game with one bit: whether the objective is achieved already."""
    first = jax.tree.map(np.asarray, restrict(game))
    width = game.state_shape[1] if _is_lazy(game) else 1
    objective = _at(objective, first.base_state * width + first.memory)
    game = first.model
    joint = _beside(game, np.array([[0, 1], [1, 1]]), 0, objective.won, "exit")
    restriction = jax.tree.map(np.asarray, restrict(joint))
    origin = Restriction(
        restriction.model,
        first.base_state[restriction.base_state],
        first.memory[restriction.base_state],
    )
    objective = _at(objective, restriction.base_state)
    won = restriction.memory == 1
    return (
        restriction.model,
        Parity(
            priority=np.where(won, 0, objective.priority),
            won=won,
            lost=~won & objective.lost & ~objective.won,
            num_priorities=objective.num_priorities,
        ),
        origin,
    )


# --- the methods ------------------------------------------------------------------------------


def _by_rank(arena: _PermissiveArena, region: Array, stay: Array, bound: int | None) -> Permissive:
    del bound
    game, graph, objective = arena
    if isinstance(objective, GR1):
        return _by_layers(arena, region, stay)
    if not _is_buchi(objective):
        raise ValueError('method="rank" is for Buchi and GR(1) objectives; choose parity.')
    goal = region & (objective.priority == 0)
    attracted: PyTree = attract(graph, goal, stay, rule=game.system, among=region)
    nearer = _some_nearer(graph, attracted.rank, region) | goal[..., None]
    mask = stay & (nearer | ~game.system[..., None])
    return _on(
        game,
        region,
        mask,
        False,
        "not maximal: away from the accepting states it allows the moves that come nearer "
        "to them, with positive probability where chance decides; at them, every move "
        "that stays in the winning region",
    )


def _some_nearer(graph: RowGraph, rank: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Moves with a successor in the region that has a smaller rank: ``bool[S, A]``."""
    rank = np.where(region, rank, NEVER)
    return graph.least(rank) < rank[..., None]


def _by_layers(arena: _PermissiveArena, region: Array, stay: Array) -> Permissive:
    arena, origin = _explicit(arena, region, stay)
    game, graph, objective = arena
    layers: PyTree = gr1_layers(graph, game.system, objective)
    region = layers.region
    stay = staying(graph, region)
    num_goals, num_assumptions = layers.round.shape[:2]
    masks = []
    for j in range(num_goals):
        rounds = layers.round[j]
        covered = rounds.min(0)  # the round of the first layer that covers a state
        mask = stay & (objective.guarantees[j][:, None] | _some_nearer(graph, covered, region))
        for i in range(num_assumptions):
            first = region & (rounds.argmin(0) == i) & ~objective.assumptions[i]
            latest = -graph.least(-np.where(region, rounds[i], NEVER))
            mask |= stay & first[:, None] & (latest <= covered[:, None])
        masks.append(mask | (stay & ~game.system[:, None]))
    joint = pursuing(game, objective.guarantees)
    both = np.broadcast_to(region[:, None], joint.state_shape)
    return _on(
        joint,
        both,
        np.stack(masks, 1),
        False,
        "not maximal: towards each guarantee in turn it allows the moves that come nearer "
        "to it, and where an assumption does not hold those that wait for it",
        origin,
    )


def pursuing(game: Game, sets: Booleans) -> Game:
    """Product of the game with the index of the one of the sets `[J, S]` that is pursued."""
    # A letter is the collection of sets that a state is in; few of them occur.
    rows, letter = np.unique(np.asarray(sets).T, axis=0, return_inverse=True)
    step = (np.arange(len(sets))[:, None] + rows.T) % len(sets)
    return _beside(game, step, 0, letter.ravel(), "exit")


def _by_counter(
    arena: _PermissiveArena, region: Array, stay: Array, bound: int | None
) -> Permissive:
    if not _is_buchi(arena.objective):
        raise ValueError('method="counter" is for Buchi objectives; choose parity.')
    if bound is None:
        raise ValueError(
            'method="counter" needs bound=m, the system\'s moves within which the '
            "accepting states are met again."
        )
    (game, _, objective), origin = _explicit(arena, region, stay)
    # Memory 2 c + b: c moves since the last accepting state, and b whether the state that is
    # left is the system's; 2 m is too late. Letters tell both of the state that is entered.
    count, mover = np.divmod(np.arange(2 * bound), 2)
    delta = np.full((2 * bound + 1, 4), 2 * bound)
    for letter in range(4):
        accepts, enters_system = divmod(letter, 2)
        moved = np.where(accepts, 0, count + mover)
        delta[:-1, letter] = np.where(moved >= bound, 2 * bound, 2 * moved + enters_system)
    letters = 2 * (objective.priority == 0) + game.system
    joint = _beside(game, delta, 0, letters, "entry")
    return _safe_beside(
        joint,
        objective,
        bound,
        origin,
        f"not maximal: it includes every strategy that surely meets the accepting states again "
        f"within {bound} of the system's moves",
    )


def _by_parity(
    arena: _PermissiveArena, region: Array, stay: Array, bound: int | None
) -> Permissive:
    if not isinstance(arena.objective, Parity):
        raise ValueError(
            'method="parity" is for parity objectives; GR(1) has rank, and as a '
            "formula it is a parity objective."
        )
    (game, _, objective), origin = _explicit(arena, region, stay)
    inside = np.ones(game.num_states, bool) if origin is not None else region
    priority = objective.priority
    odd = range(1, objective.num_priorities, 2)
    caps = [int((inside & (priority == p)).sum()) for p in odd]
    exact = bound is None or all(cap <= bound for cap in caps)
    caps = caps if bound is None else [bound] * len(caps)
    delta = budgets(caps, objective.num_priorities)
    joint = _beside(game, delta, len(delta) - 2, objective.priority, "exit")
    counts = ", ".join(f"{cap} of priority {p}" for p, cap in zip(odd, caps, strict=True))
    return _safe_beside(
        joint,
        objective,
        bound,
        origin,
        (
            "not maximal: it includes every memoryless winning strategy; "
            if exact
            else "not maximal: it includes every strategy that keeps to these counts; "
        )
        + f"between lower even priorities at most {counts} are met",
    )


def budgets(caps: list[int], num_priorities: int) -> np.ndarray:
    """Memory of the parity construction: remaining visits of odd priorities.

    State ``n`` writes the remaining counts of the priorities 1, 3, ... as digits, the first the
    most significant; in the last state they are spent. Meeting an odd priority takes one
    from the number down to its digit; meeting any priority restores all less significant ones.

    Raises:
      ValueError: more than a million states.
    """
    base = [cap + 1 for cap in caps]
    total = int(np.prod([float(b) for b in base]))
    if total > 1_000_000:
        raise ValueError(
            f"the parity construction needs {total} memory states here; give a smaller bound, "
            "which allows less."
        )
    # unit[k]: how much the k-th digit counts; unit[-1] is that of the whole number.
    unit = [int(np.prod(base[k + 1 :], dtype=int)) for k in range(len(base))]
    number = np.arange(total)
    delta = np.full((total + 1, num_priorities), total)
    for p in range(num_priorities):
        digits = (p + 1) // 2  # odd priorities up to p
        scale = unit[digits - 1] if digits else total
        remaining = number // scale - p % 2
        delta[:-1, p] = np.where(remaining >= 0, remaining * scale + scale - 1, total)
    return delta


def _safe_beside(
    joint: Game,
    objective: Parity,
    bound: int | None,
    origin: Restriction | None,
    reason: str,
) -> Permissive:
    """The strategy restricted to states that win without the last memory state."""
    spent = np.arange(joint.state_shape[1]) == joint.state_shape[1] - 1
    # The objective itself still counts: the environment may move for ever where the system
    # does not, and then no counter of the system's moves runs out.
    safe = Parity(
        priority=np.broadcast_to(objective.priority[:, None], joint.state_shape),
        won=np.zeros(joint.state_shape, bool),
        lost=spent | objective.lost[:, None],
        num_priorities=objective.num_priorities,
    )
    graph = concrete_graph(joint)
    region = _region(_PermissiveArena(joint, graph, safe))
    if not _wins_somewhere(joint, region):
        if bound is None:
            raise ValueError(
                "the system wins, but chance can put it off any number of times, so that no "
                "counts hold surely; choose rank for a Buchi objective, or one strategy by "
                "winning_region."
            )
        raise ValueError(
            f"bound={bound} is too small: the system wins, but not surely within it from any "
            "initial state; raise it."
        )
    return _on(joint, region, staying(graph, region), False, reason, origin)
