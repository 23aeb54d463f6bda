"""Reductions over a state's choices: rows against loops, and the same of padded actions."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.ops.choices import choice_shape, choices
from tests.sparse_models import random_sparse
from tests.support import assert_gradients

COUNT = 8


def uneven(seed=0):
    """A model whose states have one to six choices, of one to eight successors."""
    rng = np.random.default_rng(seed)
    return rng, random_sparse(rng, COUNT, most=6, width=8)


def by_state(model, quantity):
    return np.split(np.asarray(quantity), model.row_start[1:-1])


@jax.jit
def reductions(model, x, w, rows):
    over = choices(model)
    condition = x > 0.5
    return {
        "sum": over.sum(x),
        "max": over.max(x),
        "argmax": over.argmax(x)[1],
        "top": over.top(over.logits(x)),
        "logsumexp": over.logsumexp(over.logits(x)),
        "softmax": over.softmax(over.logits(x)),
        "mean": over.mean(w, x),
        "of rows": over.mean(rows, x),
        "first": over.first(condition),
        "all": over.all(condition),
        "some": over.max(x, condition),
        "broadcast": over.broadcast(over.sum(x)),
        "one hot": over.one_hot(rows, x.dtype),
        "best": over.best(x)[1],
        "count": over.sum(condition),
    }


def test_reductions_equal_loops():
    rng, model = uneven()
    assert len(set(np.diff(model.row_start))) > 3
    x, w = rng.normal(size=(2, model.num_rows)).round(1)
    rows = model.row_start[1:] - 1
    found = reductions(model, x, w, rows)
    groups, weights = by_state(model, x), by_state(model, w)
    hits = [np.flatnonzero(g > 0.5) for g in groups]
    expected = {
        "sum": [g.sum() for g in groups],
        "max": [g.max() for g in groups],
        "argmax": [g.argmax() for g in groups] + model.row_start[:-1],
        "top": [g.max() for g in groups],
        "logsumexp": [np.log(np.exp(g).sum()) for g in groups],
        "softmax": np.concatenate([np.exp(g) / np.exp(g).sum() for g in groups]),
        "mean": [a @ b for a, b in zip(weights, groups, strict=True)],
        "of rows": [g[-1] for g in groups],
        "all": [(g > 0.5).all() for g in groups],
        "some": [g[h].max() if h.size else -np.inf for g, h in zip(groups, hits, strict=True)],
        "broadcast": np.concatenate([np.full(g.size, g.sum()) for g in groups]),
        "one hot": np.concatenate([np.arange(g.size) == g.size - 1 for g in groups]),
        "best": np.concatenate([np.arange(g.size) == g.argmax() for g in groups]),
        "count": [h.size for h in hits],
    }
    for name, exact in expected.items():
        np.testing.assert_allclose(found[name], exact, rtol=0, atol=1e-14, err_msg=name)
    np.testing.assert_array_equal(found["first"][0], [h.size > 0 for h in hits])
    first = [h[0] if h.size else 0 for h in hits] + model.row_start[:-1]
    np.testing.assert_array_equal(found["first"][1], first)


def test_what_is_no_number_is_not_lost():
    rng, model = uneven()
    x = rng.normal(size=model.num_rows)
    state = int(np.argmax(np.diff(model.row_start)))
    x[model.row_start[state + 1] - 1] = np.nan  # not the first of its choices
    found = reductions(model, x, x, model.row_start[:-1])
    for name in ("sum", "max", "top", "logsumexp"):
        assert np.isnan(found[name]).tolist() == (np.arange(COUNT) == state).tolist(), name


def test_derivatives_of_reductions():
    rng, model = uneven()
    point = {"x": rng.normal(size=model.num_rows), "w": rng.random(model.num_rows)}

    def reduced(given):
        over = choices(model)
        x = given["x"]
        return over.max(x), over.logsumexp(x), over.softmax(x), over.mean(given["w"], x)

    assert_gradients(reduced, point, {n: rng.normal(size=x.shape) for n, x in point.items()})


def test_padded_actions_are_reduced_alike():
    rng, model = uneven()
    padded = to_padded(model)
    x = rng.normal(size=model.num_rows)
    state, start = model.host.state, model.row_start
    place = state, np.arange(model.num_rows) - start[state]
    wide = np.full((COUNT, padded.num_actions), 7.0)  # what stands elsewhere is not read
    wide[place] = x
    assert choice_shape(model) == (model.num_rows,)
    assert choice_shape(padded) == wide.shape

    @jax.jit
    def some(model, x):
        over = choices(model)
        logits = over.logits(x)
        return (
            over.max(x),
            over.logsumexp(logits),
            over.softmax(logits),
            over.argmax(x)[1],
            over.layout.max(over.columns(logits)),
            over.whole(over.columns(x)),
        )

    found, expected = some(model, x), [np.asarray(y) for y in some(padded, wide)]
    for i in (0, 1, 4):
        np.testing.assert_allclose(found[i], expected[i], rtol=0, atol=1e-14)
    np.testing.assert_allclose(found[2], expected[2][place], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(found[3] - start[:-1], expected[3])
    np.testing.assert_array_equal(found[5], x)
    np.testing.assert_array_equal(expected[5], wide)


def test_lanes_are_an_axis_behind_the_choices():
    rng, model = uneven()
    x, w = rng.normal(size=(model.num_rows, 3)), rng.random(model.num_rows)
    over = jax.jit(choices)(model)
    both = over.mean(w, x)
    for i in range(3):
        np.testing.assert_allclose(both[:, i], over.mean(w, x[:, i]), atol=1e-14)
    discount = jnp.asarray([0.5, 0.6, 0.7])
    assert over.broadcast(discount, x) is discount, "one number for each lane"
