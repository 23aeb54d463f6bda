"""The explicit game that R-max plays: a game with its task's automaton beside it, on the host."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos.common.play import (
    check_distributions,
    check_reward,
)
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.games.objective import Parity
from jaxltl.core.games.winning import objective_at, task_game
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.models.construct.restrict import restrict
from jaxltl.core.models.game import Game
from jaxltl.core.models.mdp import MDP
from jaxltl.core.types import require_shape
from jaxltl.core.values.discounted.minimax import minimax_value


def shaped_reward(game: Game, reward: Any) -> np.ndarray:
    """The reward checked against the game, as an array of one of its two shapes."""
    if not isinstance(game.mdp, MDP):
        raise ValueError(
            f"the game's model is a {type(game.mdp).__name__}; learning plays in an explicit MDP: "
            "pass restrict(game).model, or convert it."
        )
    reward = np.asarray(reward, float)
    shape = game.mdp.probability.shape
    require_shape("reward", reward, shape if reward.ndim == 3 else shape[:2])
    return reward


def joint_game(game: Game, spec: Any, start: np.ndarray):
    """The explicit game of the task, its accepting states, and whose states they are."""
    game = Game(game.mdp.replace(initial=jnp.asarray(start, game.dtype)), game.system)
    own = np.arange(game.num_states)
    if not isinstance(spec, Parity | Automaton | Formula | str):
        accepting = np.asarray(spec)
        require_shape("spec", accepting, (game.num_states,))
        return game, accepting.astype(bool), (own, np.zeros_like(own))
    if isinstance(spec, Parity):
        return game, _accepting(spec), (own, np.zeros_like(own))
    joint, objective = task_game(game, spec)
    found = restrict(joint)
    base, memory = np.asarray(found.base_state), np.asarray(found.memory)
    number = base * joint.state_shape[1] + memory
    accepting = _accepting(objective_at(objective, jnp.asarray(number)))
    return found.model, accepting, (base, memory)


def _accepting(objective: Parity) -> np.ndarray:
    """States to be met infinitely often: those of priority 0, and those that have won."""
    if objective.num_priorities > 2:
        raise ValueError(
            f"the task needs {objective.num_priorities} priorities, and only conditions met by "
            "visiting states infinitely often can be learned; strengthen it, for example to G F."
        )
    won = np.asarray(objective.won)
    return ((np.asarray(objective.priority) == 0) | won) & ~np.asarray(objective.lost)


def merge_successors(game: Game, reward: np.ndarray) -> tuple[Game, jax.Array]:
    """The game with each successor of a move once, for only successors are seen."""
    observed = check_reward(game, reward)
    successor, weight = np.asarray(game.mdp.successor), np.asarray(game.mdp.probability)
    same = (successor[..., :, None] == successor[..., None, :]) & (weight[..., None, :] > 0)
    first = same.argmax(-1) == np.arange(successor.shape[-1])
    merged = np.where(first & (weight > 0), (same * weight[..., None, :]).sum(-1), 0)
    mdp = game.mdp.replace(
        successor=jnp.asarray(np.where(merged > 0, successor, 0), jnp.int32),
        probability=jnp.asarray(merged, game.dtype),
    )
    return Game(mdp, game.system), observed


def require_start(game: Game, region: jax.Array, base: np.ndarray, memory: np.ndarray) -> None:
    """Raises a ValueError that names an initial state that is not won."""
    outside = np.flatnonzero((np.asarray(game.initial) > 0) & ~np.asarray(region))
    if outside.size == 0:
        return
    named = ", ".join(
        f"{base[i]}" + (f" (automaton state {memory[i]})" if memory.any() else "")
        for i in outside[:5]
    ) + (", ..." if outside.size > 5 else "")
    raise ValueError(
        f"{outside.size} of the states where runs start lie outside of the almost-surely winning "
        f"region: {named}. From there the task is lost, or the environment can keep the accepting "
        "states from being met again with positive probability (winning_region(...).counter_action "
        "shows how); "
        "start elsewhere, or weaken the task."
    )


def environment_rows(game, base, played, reward, allowed, environment, discount) -> np.ndarray:
    """How the environment plays, one row a state; zero at the system's states."""
    mask = np.asarray(played.available)
    system = np.asarray(played.system)
    if isinstance(environment, str):
        if environment == "random":
            rows = mask / np.maximum(mask.sum(-1, keepdims=True), 1)
        elif environment == "adversarial" and discount is not None:
            found = minimax_value(played, reward, discount, allowed=allowed)
            rows = np.eye(mask.shape[1])[np.asarray(found.policy)]
        else:
            raise ValueError(
                f"environment={environment!r}; choose random, adversarial (with discount=), or "
                "give a policy."
            )
        return np.where(system[:, None], 0, rows)
    environment = np.asarray(environment)
    if environment.ndim == 1:
        require_shape("environment", environment, (game.num_states,))
        environment = np.eye(mask.shape[1])[environment]
    require_shape("environment", environment, game.available.shape)
    rows = environment[base]
    check_distributions("environment", rows, mask, system)
    return np.where(system[:, None], 0, rows)
