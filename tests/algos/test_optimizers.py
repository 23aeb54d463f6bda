"""Optimizers of optax by name."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxltl.algos import mlirl, todirl
from jaxltl.algos.common import optimizers
from jaxltl.algos.common.settings import require_hparams


def test_the_names_are_those_of_optax():
    assert {"adam", "adamw", "lion", "nadam", "rmsprop", "sgd", "yogi"} <= set(optimizers.NAMES)
    assert not {"lbfgs", "noisy_sgd", "scale_by_adam", "chain"} & set(optimizers.NAMES)
    for hparams in (mlirl.Hparams(discount=0.9), todirl.Hparams(discount=0.9)):
        for name in ("lbfgs", "lion"):
            require_hparams(type(hparams)(discount=0.9, optimizer=name))
        with pytest.raises(ValueError, match="optimizer='newton'; choose one of lbfgs, ada"):
            require_hparams(type(hparams)(discount=0.9, optimizer="newton"))
    with pytest.raises(ValueError, match="optimizer='chain'; choose one of lbfgs, ada"):
        optimizers.optimizer("chain", 0.1)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in ("adamw", "lion") else pytest.mark.slow)
        for name in optimizers.NAMES
    ],
)
def test_each_descends_with_a_traced_rate(name):
    def loss(x):
        return jnp.sum((x - 1) ** 2)

    @jax.jit
    def after(rate):
        made = optimizers.optimizer(name, rate)
        x = jnp.array([2.0, -1.5])

        def step(carry, _):
            x, state = carry
            updates, state = made.update(jax.grad(loss)(x), state, x)
            return (optax.apply_updates(x, updates), state), None

        (x, _), _ = jax.lax.scan(step, (x, made.init(x)), None, 30)
        return loss(x)

    assert after(0.02) < loss(jnp.array([2.0, -1.5]))


def test_the_optimizers_of_before_are_unchanged():
    gradient, x = jnp.array([1.0, -2.0]), jnp.array([0.5, 0.5])
    for name in ("adam", "sgd"):
        ours, theirs = optimizers.optimizer(name, 0.1), getattr(optax, name)(0.1)
        first, _ = ours.update(gradient, ours.init(x), x)
        second, _ = theirs.update(gradient, theirs.init(x), x)
        np.testing.assert_array_equal(first, second)
