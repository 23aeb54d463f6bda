"""Gradient transformations of optax by name, steps of gradient descent, and L-BFGS with a line search."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax

from jaxltl.algos.common.trees import either, strong
from jaxltl.core import struct
from jaxltl.core.array_types import Numeric, PyTree

_SCALINGS = {
    "adam": optax.scale_by_adam,
    "rmsprop": optax.scale_by_rms,
    "sgd": optax.identity,
    "sign": optax.scale_by_sign,
}
_KNOWN = (
    "adabelief adadelta adafactor adagrad adam adamax adamaxw adamw adan amsgrad fromage lamb lars "
    "lion nadam nadamw novograd optimistic_adam_v2 optimistic_gradient_descent radam rmsprop rprop "
    "sgd sign_sgd signum sm3 yogi"
)
NAMES = tuple(name for name in _KNOWN.split() if hasattr(optax, name))  # with a learning rate alone


class Descent(NamedTuple):
    """A gradient step: the loss and its parts before it, parameters and optimizer's state after it."""

    loss: jax.Array
    parts: PyTree
    gradient_norm: jax.Array
    parameters: PyTree
    optimizer: PyTree


def optimizer_of(hparams: PyTree) -> optax.GradientTransformationExtraArgs:
    """The optimizer of hyperparameters ``optimizer``, by default Adam, and ``learning_rate``."""
    return optimizer(getattr(hparams, "optimizer", "adam"), hparams.learning_rate)


def start(hparams: PyTree, parameters: PyTree) -> PyTree:
    """The initial state of the optimizer of hyperparameters."""
    return strong(optimizer_of(hparams).init(parameters))


def descend(
    objective: Callable[[PyTree], tuple[jax.Array, PyTree]], state: PyTree, hparams: PyTree
) -> Descent:
    """A step on the loss of `objective`, from the parameters and the optimizer of a `state`."""
    (loss, parts), gradient = jax.value_and_grad(objective, has_aux=True)(state.parameters)
    line_search = {"value": loss, "grad": gradient, "value_fn": lambda x: objective(x)[0]}
    updates, memory = optimizer_of(hparams).update(
        gradient, state.optimizer, state.parameters, **line_search
    )
    parameters = optax.apply_updates(state.parameters, updates)
    return Descent(loss, parts, optax.tree.norm(gradient), parameters, memory)


def optimizer(name: str, learning_rate: Numeric) -> optax.GradientTransformationExtraArgs:
    """An optimizer of optax, or ``"sign"`` of the gradient's signs; ``"lbfgs"`` ignores the rate."""
    if name == "lbfgs":
        return optax.lbfgs()
    if name in _SCALINGS:
        rate = optax.scale_by_learning_rate(learning_rate)
        return optax.with_extra_args_support(optax.chain(_SCALINGS[name](), rate))
    if name not in NAMES:
        raise ValueError(f"optimizer={name!r}; choose one of {', '.join(('lbfgs', *NAMES))}.")
    return optax.with_extra_args_support(getattr(optax, name)(learning_rate))


# --- L-BFGS with a weak Wolfe line search, whose program evaluates the loss at one place ------------


_MAX_EVALUATIONS = 16  # evaluations for one step
_DECREASE, _CURVATURE = 1e-4, 0.9  # Wolfe's constants
_MEMORY = 10


@struct.dataclass
class Point:
    """Parameters with the loss, its gradient and its terms."""

    parameters: PyTree
    loss: jax.Array
    gradient: PyTree
    parts: PyTree


@struct.dataclass
class OptimizerSearch:
    """State of the search; `known` is True if the point was evaluated."""

    point: Point
    direction: PyTree
    memory: PyTree
    known: jax.Array


class _Trial(NamedTuple):
    base: Point
    direction: PyTree
    known: jax.Array
    best: Point  # the lowest loss so far
    moved: jax.Array  # whether that is another point than the base
    size: jax.Array
    low: jax.Array  # the largest step that was too short
    high: jax.Array  # the least one that was too long
    done: jax.Array
    n: jax.Array


def _directions() -> optax.GradientTransformation:
    return optax.scale_by_lbfgs(memory_size=_MEMORY)


def start_search(parameters: PyTree, point: Point) -> OptimizerSearch:
    """The state before the first evaluation; `point` gives the shapes."""
    zero = optax.tree.zeros_like(parameters)
    return OptimizerSearch(point, zero, strong(_directions().init(parameters)), jnp.bool_(False))


def search_step(
    evaluate: Callable[[PyTree, Point], Point], search: OptimizerSearch
) -> tuple[OptimizerSearch, Point]:
    """One step of L-BFGS (Liu and Nocedal 1989) to a point that satisfies Wolfe's conditions.

    The step size is bracketed and bisected or doubled (Lewis and Overton 2013), which terminates
    for every smooth loss; where rounding hides a decrease, the slope decides (Hager and Zhang
    2005). A loss of NaN counts as too long a step. `evaluate` maps parameters and the previous
    point to a point. Returns the search after the step, and the point before it.
    """
    eps = float(jnp.finfo(search.point.loss.dtype).eps)

    def trial(k: _Trial) -> _Trial:
        new = evaluate(_ahead(k.base, k.direction, k.size), k.base)
        slope = optax.tree.vdot(k.base.gradient, k.direction)
        ahead = optax.tree.vdot(new.gradient, k.direction)
        lower = new.loss <= k.base.loss + _DECREASE * k.size * slope  # false for NaN
        level = new.loss <= k.base.loss + 8 * eps * jnp.abs(k.base.loss)
        lower |= level & (ahead <= (2 * _DECREASE - 1) * slope)
        steep = ahead < _CURVATURE * slope
        good = lower & ~steep
        low = jnp.where(lower & steep, k.size, k.low)
        high = jnp.where(lower, k.high, k.size)
        size = jnp.where(jnp.isfinite(high), (low + high) / 2, 2 * low)
        better = good | (new.loss < k.best.loss)
        later = k._replace(
            best=either(better, new, k.best),
            moved=k.moved | better,
            size=size,
            low=low,
            high=high,
            done=good | (k.n + 1 >= _MAX_EVALUATIONS),
            n=k.n + 1,
        )
        # The first evaluation is of the initial parameters, and gives the first direction.
        scale = -jnp.minimum(1, 1 / optax.tree.norm(new.gradient))
        first = k._replace(
            base=new,
            best=new,
            known=jnp.bool_(True),
            direction=optax.tree.scale(scale, new.gradient),
            size=jnp.ones_like(size),
        )
        return either(k.known, later, first)

    one = jnp.ones((), search.point.loss.dtype)
    begin = _Trial(
        search.point,
        search.direction,
        search.known,
        search.point,
        jnp.bool_(False),
        jnp.where(search.known, one, 0),
        0 * one,
        jnp.inf * one,
        jnp.bool_(False),
        jnp.int32(0),
    )
    end = lax.while_loop(lambda k: ~k.done, trial, begin)
    new = end.best
    moved, memory = _directions().update(new.gradient, search.memory, new.parameters)
    # No descent direction, or no progress: restart from the gradient.
    fresh = ~(optax.tree.vdot(moved, new.gradient) > 0) | ~end.moved
    scale = jnp.minimum(1, 1 / optax.tree.norm(new.gradient))
    moved = either(fresh, optax.tree.scale(scale, new.gradient), moved)
    memory = either(
        fresh & ~jnp.isnan(new.loss), strong(_directions().init(new.parameters)), memory
    )
    return OptimizerSearch(new, optax.tree.scale(-1, moved), memory, jnp.bool_(True)), end.base


def _ahead(base: Point, direction: PyTree, size: jax.Array) -> PyTree:
    return jax.tree.map(lambda x, d: x + size.astype(x.dtype) * d, base.parameters, direction)
