"""Checked sets and rewards of states, solutions from values with an error, and means of bounds."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from typing import cast

import jax
import numpy as np
from jax.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.models.action_numbers import row_actions
from jaxltl.core.models.construct.state_formulas import states_satisfying
from jaxltl.core.models.protocols import ActionModel, Array, Model, SuccessorModel, base_model
from jaxltl.core.models.sparse import Reward, Rewards, SparseMDP, choice_reward, reward_structure
from jaxltl.core.sparse.exact.model import double_bounds
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure
from jaxltl.core.types import Solution, Status, require_shape, require_states

Span = tuple[float, float]  # the least and the largest number of a quantity
PROBABILITY: Span = (0.0, 1.0)
TOLERANCE = 1e-6  # half the width of an enclosure up to which it counts as narrow, relative


def reduction_for(objective: str) -> np.ufunc:
    """``np.maximum`` or ``np.minimum``; ValueError if the objective is neither "max" nor "min"."""
    if not isinstance(objective, str) or objective not in ("max", "min"):
        raise ValueError(f'objective={validation.shorten(objective)}; it must be "max" or "min".')
    return np.maximum if objective == "max" else np.minimum


def state_mask(model: SparseMDP, states: Array | str, name: str) -> np.ndarray:
    """A set of states as ``bool[S]``, from one in the model's shape or a Boolean formula of labels."""
    if isinstance(states, str):
        return states_satisfying(model, states, name)
    shape = np.shape(states)
    fits = shape and int(np.prod(shape)) == model.num_states
    require_states(name, states, shape if fits else (model.num_states,))
    mask = np.asarray(states).reshape(-1)
    if mask.dtype != bool:
        raise ValueError(f"{name} is {mask.dtype}[{mask.size}]; give booleans, or a label.")
    return mask


def row_reward(model: Model, sparse: SparseMDP, reward: Reward) -> Reward:
    """A reward of states, actions ``[S, A]`` or padded transitions ``[S, A, K]``, on the model's rows.

    Names and structures, and arrays in the order of the rows, are returned as they are.
    """
    if isinstance(reward, str | Rewards | None):
        return reward
    earned, shape = validation.float_array("reward", reward), model.state_shape
    if earned.shape == shape:
        return Rewards(state=earned.ravel())
    by_rows = hasattr(base_model(model), "rewards")
    if earned.shape[:-1] == shape and earned.shape not in ((sparse.num_rows,),):
        number = row_actions(sparse)
        if by_rows and earned.shape[-1] <= number.max():
            raise ValueError(
                f"reward has shape {earned.shape}, and actions are 0 to {number.max()}; give one number "
                "for each of them."
            )
        if not by_rows:
            require_shape("reward", earned, (*shape, cast(ActionModel, model).num_actions))
        pairs = earned.reshape(sparse.num_states, -1)
        return Rewards(choice=pairs[sparse.host.state, number])
    if not by_rows:
        padded = cast(SuccessorModel, model)
        actions = (*shape, padded.num_actions)
        if earned.shape == (*actions, padded.num_successors):
            weight = np.asarray(padded.successor_probability, np.float64)
            sums = (weight * np.where(weight > 0, earned, 0)).sum(-1)
            pairs = (sums / np.where(sums != 0, weight.sum(-1), 1)).reshape(sparse.num_states, -1)
            return Rewards(choice=pairs[sparse.host.state, row_actions(sparse)])
        if earned.shape not in ((sparse.num_rows,), (sparse.num_transitions,)):
            require_shape("reward", earned, actions)
    return earned


def state_reward(model: SparseMDP, reward: Reward) -> np.ndarray:
    """The rewards of states, ``float64[S]``; ValueError without any, or if some are not finite."""
    rewards = reward_structure(model, reward)
    if rewards.state is None:
        raise ValueError(
            "the reward of a state after so many steps needs a reward on states, and "
            "this one has none; give an array of one number a state."
        )
    return finite_reward(model, Rewards(state=rewards.state))[0][model.host.row_start[:-1]]


def finite_reward(model: SparseMDP, reward: Reward) -> tuple[np.ndarray, np.ndarray]:
    """Expected rewards of rows, and those of absolute values: ``float64[R]``; ValueError if not finite."""
    rewards = reward_structure(model, reward)
    earned = choice_reward(model, rewards)
    if not np.isfinite(earned).all():
        row = int(np.flatnonzero(~np.isfinite(earned))[0])
        state = int(model.host.state[row])
        raise ValueError(
            f"the reward of state {state}, choice {row - int(model.row_start[state])} "
            f"is {earned[row]}; make it finite."
        )
    return earned, choice_reward(model, jax.tree.map(np.abs, rewards))


def reward_span(rewards: Rewards, num_steps: int = 1) -> Span:
    """Bounds of the sum of rewards of some steps."""
    low = high = Fraction(0)
    for part in (rewards.state, rewards.choice, rewards.transition):
        if part is not None:
            numbers = np.asarray(part, np.float64)
            low, high = low + Fraction(float(numbers.min())), high + Fraction(float(numbers.max()))
    return double_bounds(num_steps * low)[0], double_bounds(num_steps * high)[1]


def discounted_span(rewards: Rewards, discount: float) -> Span:
    """Bounds of discounted sums of the rewards of steps."""
    least, largest = (Fraction(x) / (1 - Fraction(discount)) for x in reward_span(rewards))
    return double_bounds(least)[0], double_bounds(largest)[1]


def clipped(solution: Solution, span: Span) -> Solution:
    """A solution of NumPy arrays within the span of its quantity."""
    parts: dict[str, Array] = {
        name: np.clip(getattr(solution, name), *span) + 0.0 for name in ("value", "lower", "upper")
    }
    return replace(solution, **parts)


def nonnegative_reward(
    model: SparseMDP, reward: Reward, use: str, name: str = "the reward"
) -> np.ndarray:
    """Expected rewards of rows, ``float64[R]``; ValueError if some are negative or not finite."""
    earned = choice_reward(model, reward)
    bad = np.flatnonzero(~(np.isfinite(earned) & (earned >= 0)))
    if bad.size:
        row, state = bad[0], model.host.state[bad[0]]
        raise ValueError(
            f"{name} of state {state}, choice {row - model.host.row_start[state]} is "
            f"{earned[row]:.6g}; {use} need finite rewards of at least 0."
        )
    return earned


def transition_reward(model: SparseMDP, rewards: Rewards) -> np.ndarray:
    """The reward of each entry, ``float64[T]``."""
    mdp = model.host
    earned = np.zeros(mdp.num_transitions)
    if rewards.transition is not None:
        earned += np.asarray(rewards.transition, np.float64)
    if rewards.choice is not None:
        earned += np.asarray(rewards.choice, np.float64)[mdp.row]
    if rewards.state is not None:
        earned += np.asarray(rewards.state, np.float64)[mdp.state[mdp.row]]
    if not np.isfinite(earned).all():
        e = int(np.flatnonzero(~np.isfinite(earned))[0])
        raise ValueError(
            f"the reward is {earned[e]} from state {mdp.state[mdp.row[e]]} to "
            f"{mdp.successor[e]}; make it finite."
        )
    return earned


def solution_from_error(
    value: np.ndarray,
    error: ArrayLike,
    policy: Array,
    num_steps: int,
    *,
    span: Span = (-math.inf, math.inf),
    enough: ArrayLike | None = None,
) -> Solution:
    """A :class:`Solution` from a value and its error, CONVERGED if that is at most `enough`.

    Value and bounds are clipped to the `span` of the quantity.
    """
    enough = TOLERANCE * np.maximum(np.abs(value), 1) if enough is None else enough
    error = np.broadcast_to(np.asarray(error, np.float64), value.shape)
    out = error > 0
    lower = np.where(out, np.nextafter(value - error, -np.inf), value)
    upper = np.where(out, np.nextafter(value + error, np.inf), value)
    if span != (-math.inf, math.inf):
        lower, upper, value = (np.clip(x, *span) for x in (lower, upper, value))
    finite = bool(np.isfinite(value).all())
    narrow = bool((error <= enough).all())
    status = Status.CONVERGED if narrow else Status.PRECISION if finite else Status.NONFINITE
    fields: dict[str, Array] = {
        "value": value + 0.0,
        "policy": policy,
        "lower": lower,
        "upper": upper,
        "residual": np.float64(0),
        "num_steps": np.int32(min(num_steps, 2**31 - 1)),
        "status": np.int32(status),
    }
    return Solution(**fields)


def safe_mean(share: np.ndarray, bound: ArrayLike, *, up: bool, highest: float = np.inf) -> float:
    """The weighted mean of nonnegative bounds, rounded up or down."""
    bound = np.asarray(bound, np.float64)
    if (bound == bound[0]).all():
        return float(bound[0])
    slack = (share.size + 4) * float(np.finfo(np.float64).eps)
    mean = float(share @ bound / share.sum())
    return min(mean * (1 + slack), highest) if up else mean * (1 - slack)


def safe_ends(
    model: Model,
    enclosure: Solution | Enclosure,
    *,
    highest: float = np.inf,
) -> tuple[float, float]:
    """Enclosure of the mean over the initial distribution, from `lower` and `upper`."""
    share = np.asarray(model.initial, np.float64).ravel()
    start = np.flatnonzero(share)
    low, high = (
        safe_mean(share[start], np.asarray(x).ravel()[start], up=up, highest=highest)
        for x, up in ((enclosure.lower, False), (enclosure.upper, True))
    )
    return low, high
