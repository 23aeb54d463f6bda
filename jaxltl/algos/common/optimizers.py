"""Gradient transformations of optax by name."""

from __future__ import annotations

import inspect
from collections.abc import Iterator

import optax

from jaxltl.core.array_types import Numeric, PyTree

_SCALINGS = {"adam": optax.scale_by_adam, "rmsprop": optax.scale_by_rms, "sgd": optax.identity}
# With their own search, with a random key, deprecated.
_OTHERS = ("lbfgs", "noisy_sgd", "optimistic_adam")


def _names() -> Iterator[str]:
    """The optimizers of optax that need a learning rate alone."""
    for name in dir(optax):
        made = getattr(optax, name)
        if name in _OTHERS or name.startswith("scale") or not callable(made):
            continue
        if inspect.isclass(made):
            continue
        try:
            first, *rest = inspect.signature(made).parameters.values()
        except ValueError:  # no signature, or no parameters
            continue
        if first.name == "learning_rate" and all(x.default is not x.empty for x in rest):
            yield name


NAMES = tuple(_names())


def optimizer_of(hparams: PyTree) -> optax.GradientTransformationExtraArgs:
    """The optimizer of hyperparameters ``optimizer`` and ``learning_rate``."""
    return optimizer(hparams.optimizer, hparams.learning_rate)


def descended(
    hparams: PyTree, gradient: PyTree, state: PyTree, **more: PyTree
) -> tuple[PyTree, PyTree]:
    """Parameters of a learner's state, and its optimizer's state, after a step along a gradient."""
    updates, memory = optimizer_of(hparams).update(
        gradient, state.optimizer, state.parameters, **more
    )
    return optax.apply_updates(state.parameters, updates), memory


def optimizer(name: str, learning_rate: Numeric) -> optax.GradientTransformationExtraArgs:
    """An optimizer of optax; ``"lbfgs"`` ignores the rate."""
    if name == "lbfgs":
        return optax.lbfgs()
    if name not in NAMES:
        raise ValueError(f"optimizer={name!r}; choose one of {', '.join(('lbfgs', *NAMES))}.")
    if name not in _SCALINGS:
        return optax.with_extra_args_support(getattr(optax, name)(learning_rate))
    rate = optax.scale_by_learning_rate(learning_rate)
    return optax.with_extra_args_support(optax.chain(_SCALINGS[name](), rate))
