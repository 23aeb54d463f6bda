"""Gradient transformations of optax by name, and steps of gradient descent."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import optax

from jaxltl.algos.common.trees import strong
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
