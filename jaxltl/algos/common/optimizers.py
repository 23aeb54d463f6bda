"""Gradient transformations of optax by name."""

from __future__ import annotations

import chex
import optax

_SCALINGS = {
    "adam": optax.scale_by_adam,
    "rmsprop": optax.scale_by_rms,
    "sgd": optax.identity,
}


def optimizer(name: str, learning_rate: chex.Numeric) -> optax.GradientTransformationExtraArgs:
    """An optimizer of optax; ``"lbfgs"`` ignores the rate."""
    if name == "lbfgs":
        return optax.lbfgs()
    if name not in _SCALINGS:
        raise ValueError(f"optimizer={name!r}; choose one of {', '.join(('lbfgs', *_SCALINGS))}.")
    rate = optax.scale_by_learning_rate(learning_rate)
    return optax.with_extra_args_support(optax.chain(_SCALINGS[name](), rate))
