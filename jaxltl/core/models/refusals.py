"""Refusals of models: of games where one player chooses, and of traced arrays on the host."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

from jaxltl.core import validation
from jaxltl.core.models.game import Game
from jaxltl.core.models.product import Product

P = ParamSpec("P")
R = TypeVar("R")

_VALUE = "optimal_value(game, reward, discount), or policy_value of a strategy of the system"
_FORMULA = "winning_region(game, formula), or optimal_satisfaction of the game with the formula or of its product"

# What to ask of a game instead, for each solver; games have no counterpart of the others.
_INSTEAD = {
    "soft_value": _VALUE,
    "boltzmann_value": _VALUE,
    "occupancy_measure": _VALUE,
    "hitting_time": "total_reward(game, reward, target, policy=...), a reward of 1 for each step",
    "prepare": "reachability_probability or total_reward of the game",
    "optimal_actions": "permissive_strategy(game, formula), whose actions keep the system winning; "
    + _FORMULA,
    "task_performance": _FORMULA,
}
_OTHERWISE = (
    "reachability_probability, total_reward, optimal_value, average_reward, optimal_satisfaction or "
    "solve_property of the game, or winning_region"
)


def refuse_game(function: str, arguments: Iterable[tuple[str, object]]) -> None:
    """Raises ValueError if an argument is a game or a POMDP, with what to ask instead."""
    for name, value in arguments:
        if hasattr(value, "fully_observable"):
            raise ValueError(f"{function}: {validation.unsupported_model(value)}")
        if not isinstance(value, Game | Product):
            continue
        if isinstance(value, Game) or isinstance(value.mdp, Game):
            instead = _INSTEAD.get(function, _OTHERWISE)
            raise ValueError(
                f"{function}: {name} is a Game, and the actions here are those of one player; ask "
                f"for {instead}. If one player chooses all actions, give game.mdp."
            )


def refuse_traced(function: str, arguments: Iterable[tuple[str, object]]) -> None:
    """Raises ValueError if an argument has traced arrays."""
    for name, value in arguments:
        if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(value)):
            raise ValueError(
                f"{function}: {name} has traced arrays, and this is computed on the host; call it "
                "outside jit and vmap, on concrete arrays. Inside, there are solve_prepared and the "
                "values of an MDP, a DenseMDP, and products of them."
            )


def of_one_player(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator of functions that refuse games, by :func:`refuse_game`."""

    @wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        refuse_game(function.__name__, _named(args, kwargs))
        return function(*args, **kwargs)

    return wrapper


def on_host(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator of functions that refuse games, and traced arrays, by :func:`refuse_traced`."""

    @wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        refuse_game(function.__name__, _named(args, kwargs))
        refuse_traced(function.__name__, _named(args, kwargs))
        return function(*args, **kwargs)

    return wrapper


def _named(args: tuple[object, ...], kwargs: dict[str, object]) -> list[tuple[str, object]]:
    """Arguments of functions whose first one is the model, by name."""
    places = ["model"] + [f"argument {i + 1}" for i in range(1, len(args))]
    return [*zip(places, args, strict=False), *kwargs.items()]
