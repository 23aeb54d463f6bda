"""Strategies of games as finite-memory policies of the game's world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.games.objective import GR1
from jaxltl.core.games.permissive import Permissive, pursuing
from jaxltl.core.games.winning import Winning, objective_at
from jaxltl.core.models.action_numbers import named_actions
from jaxltl.core.models.construct.lifting import with_named_actions
from jaxltl.core.models.construct.restrict import restrict
from jaxltl.core.models.game import Game, as_padded_game
from jaxltl.core.models.mdp import support
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import base_model
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.sparse.rows import concatenated_ranges


class ReachedNodes(NamedTuple):
    """The N nodes that are reached under a strategy, with a state of the world and a memory each."""

    game: Game  # with successor lists, and the moves that the strategy allows
    state: Integers  # int[N]
    memory: Integers  # int[N]


def strategy_policy(
    game: Game,
    strategy: Winning | Permissive,
    *,
    player: str = "system",
    actions: Sequence[str] = (),
) -> FiniteMemoryPolicy:
    """A strategy of a game as a finite-memory policy of its world, to run and to save.

    The policy draws uniformly among the moves that the strategy allows; in the opponent's states,
    among all. It holds in runs from the initial states that the player wins.

    Args:
      game: the game that was solved, or its product.
      strategy: of :func:`~jaxltl.core.games.winning.winning_region` or
        :func:`~jaxltl.core.games.permissive.permissive_strategy`.
      player: ``"system"``, or ``"environment"`` for the counter-strategy of a `Winning`.
      actions: names of the actions; default: those of a sparse model.

    Returns:
      :class:`~jaxltl.core.policies.finite_memory.FiniteMemoryPolicy`; its memory is the automaton's
      where that suffices.

    Raises:
      ValueError: a player that wins from no initial state, or moves with a memory that depends on more
        than the states that are met.

    Example:
      >>> import jaxltl as jl
      >>> world = jl.from_dense([[[0, 1.0], [1.0, 0]], [[1.0, 0], [0, 1.0]]], label={"a": [1]})
      >>> game = jl.make_game(world, [False, True])
      >>> policy = strategy_policy(game, jl.winning_region(game, "G F a"))
      >>> policy.act(np.random.default_rng(0), policy.start(1)).item()
      1
    """
    part, count = explored(strategy, player), base_model(game.mdp).num_states
    if (part.state >= count).any():
        raise ValueError(
            f"strategy: its game has states beyond the {count} of the world, in which an adversary "
            "resolves random moves; solve the game with chance='random'."
        )
    task = strategy.game.mdp
    if not isinstance(task, Product) or not {*task.automaton.propositions} <= {*game.propositions}:
        task = None
    policy = policy_of_nodes(part, count, task=task, actions=actions)
    world = base_model(game.mdp)
    rows = getattr(world, "nominal", world)
    if actions or not isinstance(rows, SparseMDP):
        return policy
    weight = np.asarray(with_named_actions(rows, policy.action))
    weight = weight / weight.sum(-1, keepdims=True)  # where it is not reached, over the choices
    return policy.replace(action=weight, actions=named_actions(rows)[1])


def explored(strategy: Winning | Permissive, player: str = "system") -> ReachedNodes:
    """The part of a game that a player's strategy reaches from the initial states that it wins."""
    validation.choice("player", player, ("system", "environment"))
    if isinstance(strategy, Permissive):
        permissive, region = strategy, np.asarray(strategy.region)
        base, old = np.asarray(permissive.base_state), np.asarray(permissive.automaton_state)
        game, allowed = permissive.game, np.asarray(permissive.allowed)
        if player != "system":
            raise ValueError("player: a permissive strategy is the system's.")
    else:
        game, region, allowed, base, old = _moves(strategy, player == "system")
    initial = np.where(region, np.asarray(game.initial), 0)
    if not initial.any():
        raise ValueError(f"the {player} wins from no initial state, so it has no strategy there.")
    part = restrict(game, initial / initial.sum(), allowed=allowed)
    at, memory = np.asarray(part.base_state), np.asarray(part.memory)
    _, key = np.unique(np.stack([old[at], memory]), axis=1, return_inverse=True)
    return ReachedNodes(part.model, base[at], memory if not old.any() else key.ravel())


def _moves(winning: Winning, system: bool) -> tuple[Game, Booleans, Booleans, Integers, Integers]:
    """The game with the strategy's memory, region and moves; world and automaton states."""
    game, region = as_padded_game(winning.game), np.asarray(winning.region) == system
    action = np.asarray(winning.action if system else winning.counter_action)
    base = np.arange(base_model(game.mdp).num_states)
    old = np.zeros_like(base)
    goal = winning.objective
    if isinstance(goal, GR1):
        if isinstance(game.mdp, Product):  # its nodes, as states
            part = restrict(game, np.full(game.state_shape, 1 / game.num_states))
            base, old = np.asarray(part.base_state), np.asarray(part.memory)
            number, game = base * winning.game.state_shape[1] + old, part.model
            goal = objective_at(goal, number)
            region = region.ravel()[number]
            action = action.reshape(-1, action.shape[-1])[number]
        game = pursuing(game, np.asarray(goal.guarantees if system else goal.assumptions))
        region = np.broadcast_to(region[:, None], game.state_shape)
    available = np.asarray(game.available)
    chosen = np.arange(available.shape[-1]) == action[..., None]
    own = region & (np.asarray(game.system) == system)
    return game, region, np.where(own[..., None], chosen, available), base, old


def policy_of_nodes(
    part: ReachedNodes,
    num_states: int,
    *,
    skipped: Booleans | None = None,
    task: Product | None = None,
    actions: Sequence[str] = (),
) -> FiniteMemoryPolicy:
    """The policy of a world of moves in the nodes of a game.

    Nodes that are `skipped`, in which an adversary resolves a random move, are no states of the
    world. The memory is the node's, of the automaton of `task` if that fits, or else the node.
    """
    game, state = part.game, part.state
    real = np.ones(len(state), bool) if skipped is None else ~skipped
    source, target = _edges(game, real)
    for memory in (part.memory, np.arange(len(state))):
        count = int(memory.max()) + 1
        if np.unique(state[real] * count + memory[real]).size == real.sum():
            updates = _updates(memory, source, target, state)
            if updates is not None:
                break
    else:
        raise ValueError(
            "the strategy's memory depends on more than the states that are met: on which random "
            "move an adversary has resolved. Solve the game with chance='random'."
        )
    label_on, read, before, after = updates
    automatic = task is not None and memory is part.memory and label_on == task.label_on
    automatic = automatic and task is not None and count <= task.num_memory
    count = task.num_memory if task is not None and automatic else count
    weight = np.zeros((num_states, count, len(actions) or game.num_actions), np.float32)
    weight[state[real], memory[real]] = np.asarray(game.available)[real][:, : weight.shape[-1]]
    total = weight.sum(-1, keepdims=True)
    action = np.where(total > 0, weight / np.maximum(total, 1), 1 / weight.shape[-1])
    action = action.astype(np.float32)
    start = np.flatnonzero(np.asarray(game.initial) > 0)
    initial = np.full(num_states, memory[start[0]], np.int32)
    initial[state[start]] = memory[start]
    if task is not None and automatic:
        return FiniteMemoryPolicy(
            action,
            task.initial_memory,
            task.next_memory,
            task.label_on,
            task.automaton,
            task.letter,
            tuple(actions),
        )
    step = np.tile(np.arange(count, dtype=np.int32), (num_states, 1))
    step[read, before] = after
    return FiniteMemoryPolicy(action, initial, step, label_on, actions=tuple(actions))


def _updates(
    memory: Integers, source: Integers, target: Integers, state: Integers
) -> tuple[str, Integers, Integers, Integers] | None:
    """Updates of a memory that reads the state left or entered: states, memories before and after."""
    before, after = memory[source], memory[target]
    for label_on, read in (("exit", state[source]), ("entry", state[target])):
        _, first, place = np.unique(
            np.stack([read, before]), axis=1, return_index=True, return_inverse=True
        )
        if (after == after[first][place.ravel()]).all():
            return label_on, read, before, after
    return None


def _edges(game: Game, real: Booleans) -> tuple[Integers, Integers]:
    """The pairs of real nodes that moves connect, also through one other node."""
    used = np.asarray(support(game.mdp)) & np.asarray(game.available)[:, :, None]
    source, target = np.nonzero(used)[0], np.asarray(game.mdp.successor)[used]
    through = ~real[target]
    width = np.bincount(source, minlength=len(real))[target[through]]
    onward = concatenated_ranges(np.searchsorted(source, target[through]), width)
    direct = real[source] & ~through
    return (
        np.concatenate([source[direct], source[through].repeat(width)]),
        np.concatenate([target[direct], target[onward]]),
    )
