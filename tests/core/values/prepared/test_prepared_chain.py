"""Values of prepared chains without bounds: those of the host engine, and their slopes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.types import Status
from jaxltl.core.values.prepared import prepared as module
from jaxltl.core.values.prepared.prepared import (
    evaluate_prepared,
    is_direct,
    prepare,
    solve_prepared,
)
from tests.sparse_models import random_sparse

SIZE = 12


def case(seed, kind, trap=-1):
    """A chain, its target and rewards or None; with circles, or with loops only."""
    rng = np.random.default_rng(seed)
    start, successor = [0], []
    for s in range(SIZE):
        pool = np.arange(SIZE - 1) if kind == "circles" else np.arange(s + 1, SIZE)
        ahead = rng.choice(pool, min(pool.size, 3), replace=False)
        if s == SIZE - 1:
            successor.append(s)
        elif kind == "circles":  # rewards are finite but for a trap
            successor += [*ahead, SIZE - 1] if s != trap else [s]
        else:
            successor += [s, *ahead] if s % 3 == 0 else [*ahead]
        start.append(len(successor))
    count = np.diff(start)
    model = make_sparse(None, start, successor, 1 / np.repeat(count, count))
    target = np.arange(SIZE) == SIZE - 1
    return rng, model, target, rng.random(SIZE) * (rng.random(SIZE) < 0.8)


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", ["circles", "loops"])
@pytest.mark.parametrize("asks_reward", [False, True])
def test_values_are_those_of_the_host_engine(kind, asks_reward):
    rng, model, target, reward = case(1, kind, trap=-1 if asks_reward else 3)
    prepared = prepare(model, target, reward=reward if asks_reward else None)
    assert prepared.cyclic == (kind == "circles") and is_direct(prepared)
    evaluate = jax.jit(evaluate_prepared)
    for _ in range(4):
        p = np.asarray(model.probability) * np.exp(rng.normal(size=model.num_transitions))
        p = p / np.add.reduceat(p, model.entry_start[:-1])[model.host.row]
        host = model.replace(probability=p).host
        expected = (
            optimal.total_reward(host, reward, target, maximize=True)
            if asks_reward
            else optimal.reachability(host, target, maximize=True)
        )
        given = {"reward": jnp.asarray(reward)} if asks_reward else {}
        value, status = evaluate(prepared, probability=p, **given)
        np.testing.assert_allclose(value, expected.value, rtol=1e-6, atol=1e-9)
        assert status == Status.UNCERTIFIED
        bounded = solve_prepared(prepared, probability=p, **given)
        assert (bounded.lower <= value * (1 + 1e-12)).all()
        assert (value <= bounded.upper * (1 + 1e-12)).all()


@pytest.mark.slow
def test_elimination_and_passes_say_the_same(monkeypatch):
    _, model, target, _ = case(1, "circles", trap=3)
    prepared = prepare(model, target)

    def slopes():
        def first(p):  # a new function, which is traced anew
            return jnp.sum(evaluate_prepared(prepared, probability=p)[0])

        module._evaluate.clear_cache()
        return jax.value_and_grad(first)(prepared.probability)

    one = slopes()
    monkeypatch.setattr(module, "ELIMINATED", 0)
    assert not is_direct(prepared)
    other = slopes()
    module._evaluate.clear_cache()
    for x, y in zip(one, other, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-10)
    bounded = jax.grad(lambda p: jnp.sum(solve_prepared(prepared, probability=p).value))
    np.testing.assert_allclose(one[1], bounded(prepared.probability), rtol=1e-5, atol=1e-6)


def test_values_far_below_what_bounds_tell_apart_are_right():
    """Ruin of a gambler: the odds are (q / p) ** 20."""
    size = 21
    start = np.concatenate([[0, 1], 1 + 2 * np.arange(1, size - 1), [2 * size - 2]])
    inner = np.stack([np.arange(size - 2), np.arange(2, size)], 1).ravel()
    p = np.array([1, *[0.9, 0.1] * (size - 2), 1])
    model = make_sparse(None, start, [0, *inner, size - 1], p)
    value, _ = evaluate_prepared(prepare(model, np.arange(size) == size - 1))
    ratio = 9.0 ** np.arange(size)
    np.testing.assert_allclose(value, (ratio - 1) / (ratio[-1] - 1), rtol=1e-10)


def test_numbers_that_are_none_are_told():
    _, model, target, reward = case(1, "circles")
    prepared = prepare(model, target, reward=reward)
    p = prepared.probability
    for wrong, status in ((p * 0.9, Status.INVALID), (p * jnp.nan, Status.NONFINITE)):
        assert evaluate_prepared(prepared, probability=wrong)[1] == status
    assert evaluate_prepared(prepared, reward=prepared.reward - 1)[1] == Status.INVALID
    with pytest.raises(ValueError, match=r"probability has shape \(3,\)"):
        evaluate_prepared(prepared, probability=p[:3])
    with pytest.raises(ValueError, match="takes Markov chains"):
        evaluate_prepared(prepare(model, target, objective="policy"))
    choices = random_sparse(np.random.default_rng(0), 3)
    if not choices.is_chain:
        with pytest.raises(ValueError, match="takes Markov chains"):
            evaluate_prepared(prepare(choices, np.arange(3) == 0))
