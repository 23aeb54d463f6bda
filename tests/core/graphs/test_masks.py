"""Sets of states and of choices as arguments: 0 and 1 are False and True, other shapes are refused."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models.protocols import base_model
from tests import reference
from tests.support import as_mdp

S, A = 4, 2
KINDS = {
    "padded": lambda mdp: mdp,
    "dense": jl.models.to_dense,
    "sparse": jl.to_sparse,
    "product": lambda mdp: jl.product(mdp, "G F a"),
    "game": lambda mdp: jl.make_game(mdp, np.arange(S) % 2),
}
SETS = {
    "attractor": lambda model, set_, part: jl.graphs.attractor(model, set_, among=part),
    "attractor with a rule": lambda model, set_, part: jl.graphs.attractor(model, set_, rule=part),
    "avoidable": lambda model, set_, _: jl.graphs.avoidable(model, set_),
    "almost surely": lambda model, set_, _: jl.graphs.almost_surely_reaching(model, set_),
    "end components": lambda model, set_, _: jl.graphs.end_components(model, set_),
    "exists": lambda model, set_, _: jl.models.exists_successor(model, set_),
    "forall": lambda model, set_, _: jl.models.forall_successor(model, set_),
}
CHOICES = {
    "attractor": lambda model, set_, rows: jl.graphs.attractor(model, set_, rows),
    "avoidable": lambda model, set_, rows: jl.graphs.avoidable(model, set_, rows),
    "almost surely": lambda model, set_, rows: jl.graphs.almost_surely_reaching(model, set_, rows),
    "end components": lambda model, set_, rows: jl.graphs.end_components(model, set_, rows),
}


def models(number=6):
    rng = np.random.default_rng(0)
    for _ in range(number):
        label = np.arange(S)[:, None] < 2
        mdp = replace(
            as_mdp(reference.random_model(rng, S, A, 2)), label=label, propositions=("a",)
        )
        for kind, make in KINDS.items():
            model = make(mdp)
            masks = [rng.random(model.state_shape) < share for share in (0.3, 0.7)]
            rows = (model.num_rows,) if kind == "sparse" else np.shape(model.available)
            yield model, *masks, rng.random(rows) < 0.8


def equal(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.parametrize("name", SETS)
def test_masks_of_zeros_and_ones_are_masks(name):
    for model, mask, part, _ in models(2):
        expected = SETS[name](model, mask, part)
        for convert in (np.int64, np.uint8, np.float64, np.ndarray.tolist, jnp.int32):
            equal(SETS[name](model, convert(mask), convert(part)), expected)


@pytest.mark.parametrize("name", CHOICES)
def test_masks_of_choices_are_masks(name):
    for model, mask, _, rows in models():
        expected = CHOICES[name](model, mask, rows)
        equal(CHOICES[name](model, mask, rows.astype(int)), expected)
        for wrong in (rows[:1], rows[..., None], rows + 2, rows.astype("U1")):
            with pytest.raises(ValueError, match="allowed"):
                CHOICES[name](model, mask, wrong)


@pytest.mark.parametrize("name", SETS)
def test_other_masks_are_refused(name):
    for model, mask, part, _ in models(1):
        for wrong in (mask[:1], mask[None], mask[..., None], mask + 2, np.nan * mask, "p0"):
            with pytest.raises(ValueError, match=r"goal|region"):
                SETS[name](model, wrong, part)
        with pytest.raises(ValueError, match=r"goal|region"):  # whose values are unknown
            jax.jit(lambda x, model=model, part=part: SETS[name](model, x, part))(mask.astype(int))


@pytest.mark.parametrize("name", ["attractor", "avoidable", "almost surely", "end components"])
def test_sets_are_labels_and_formulas_too(name):
    for model, _, part, _ in models(1):
        first, start = np.arange(S) < 2, np.asarray(base_model(model).initial) > 0
        shape = (S, *[1] * (len(model.state_shape) - 1))
        for text, states in (
            ("a", first),
            ("!a", ~first),
            ("a | init", first | start),
        ):
            mask = np.broadcast_to(states.reshape(shape), model.state_shape)
            expected = SETS[name](model, mask, part)
            equal(SETS[name](model, text, part), expected)
        compiled = jax.jit(lambda m, text=text, part=part: SETS[name](m, text, part))
        equal(compiled(model), expected)  # the last of them
        with pytest.raises(ValueError, match="Boolean"):
            SETS[name](model, "F a", part)
