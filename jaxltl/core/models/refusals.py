"""Refusals of models: of games where one player chooses, and of traced arrays on the host."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

from jaxltl.core.models.game import Game
from jaxltl.core.models.product import Product

P = ParamSpec("P")
R = TypeVar("R")

_ROWS = (
    "of a game on a SparseMDP or an IntervalMDP "
    "(make_game(to_sparse(game.mdp), game.system.ravel()) if it is on padded actions)"
)
_DISCOUNTED = (
    "minimax_value(game, reward, discount), or robust_discounted_value of one on intervals"
)
_STRATEGY = "strategy_value(game, strategy, reward, discount), the worst case of a strategy"
_REACHING = (
    f"winning_region(game, objective), or robust_reachability(game, target, policy=...), {_ROWS}"
)
_REWARD = f"robust_total_reward(game, reward, target), {_ROWS}"
_FORMULA = "winning_region(game, formula), or optimal_satisfaction(game, formula), without product"

# What to ask of a game instead, for each solver; games have no counterpart of the others.
_INSTEAD = {
    "optimal_value": _DISCOUNTED,
    "policy_value": _STRATEGY,
    "soft_value": _DISCOUNTED,
    "boltzmann_value": _DISCOUNTED,
    "occupancy_measure": _STRATEGY,
    "total_reward": _REWARD,
    "hitting_time": _REWARD,
    "reachability_probability": _REACHING,
    "prepare": _REACHING,
    "satisfaction_probability": _FORMULA,
    "optimal_satisfaction": _FORMULA,
    "optimal_actions": "permissive_strategy(game, formula), whose actions keep the system winning; "
    + _FORMULA,
    "solve_property": _FORMULA,
    "task_performance": _FORMULA,
}
_OTHERWISE = (
    "minimax_value, strategy_value, average_reward, bounded_reachability, winning_region, or "
    "robust_reachability, robust_total_reward, robust_discounted_value and optimal_satisfaction "
    f"with a formula, {_ROWS}"
)


def refuse_game(function: str, arguments: Iterable[tuple[str, object]]) -> None:
    """Raises ValueError if an argument is a game, with what to ask instead."""
    for name, value in arguments:
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
