"""What the numerical tests share: the library's models from reference models, and gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.automata.automaton import make_automaton
from jaxltl.core.environments.environment import Box, Finite, some_action
from jaxltl.core.models.mdp import MDP, DenseMDP, make_mdp, to_dense
from jaxltl.core.models.product import Product, product
from tests import reference

REPRESENTATIONS = ("sparse", "dense", "product")


def counts(few: int, many: int, *, slow: int | None = None) -> pytest.MarkDecorator:
    """A law of random cases, given as ``count``: few by default, many with the exhaustive ones."""
    some = [] if slow is None else [pytest.param(slow, marks=pytest.mark.slow)]
    whole = pytest.param(many, marks=pytest.mark.exhaustive)
    return pytest.mark.parametrize("count", [few, *some, whole])


def seeds(few: int, slow: int, many: int) -> list[Any]:
    """Seeds of a law: few by default, up to `slow` with ``-m slow``, many with the exhaustive ones."""
    return [
        *range(few),
        *(pytest.param(i, marks=pytest.mark.slow) for i in range(few, slow)),
        *(pytest.param(i, marks=pytest.mark.exhaustive) for i in range(slow, many)),
    ]


def as_mdp(model: reference.Model, **labels: Any) -> MDP:
    """The library's model of a reference model."""
    return make_mdp(
        model.successor,
        model.probability,
        available=model.available,
        initial=model.initial,
        **labels,
    )


def replaced(text: str, *replacements: tuple[str, str]) -> str:
    """A text with parts replaced, each of which stands in it."""
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    return text


def stack(trees: Sequence[Any]) -> Any:
    """Trees of one shape as a batch."""
    return jax.device_put(jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *trees))


def lane(tree: Any, i: int) -> Any:
    """One of several, taken on the host; slices of arrays would each be compiled."""

    def one(x: Any) -> Any:
        if isinstance(x, np.ndarray):
            return x[i]
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(np.asarray(jax.random.key_data(x))[i])
        return jax.device_put(np.asarray(x)[i])

    return jax.tree.map(one, tree)


def bit_labels(letter: np.ndarray, num_bits: int) -> np.ndarray:
    """Letter numbers as rows of bits."""
    return (np.asarray(letter)[:, None] >> np.arange(num_bits) & 1).astype(bool)


def random_product(
    rng: np.random.Generator,
    *,
    num_states: int = 3,
    num_actions: int = 2,
    num_successors: int = 2,
    num_memory: int = 3,
    acceptance: str = "cosafe",
    label_on: str = "entry",
    certainty: float | None = None,
) -> tuple[Product, reference.Model]:
    """A random product over four letters, and the same copied out."""
    world = reference.random_model(rng, num_states, num_actions, num_successors, certainty)
    letter = rng.integers(4, size=num_states)
    delta, final = reference.random_acceptor(rng, num_memory, 4, acceptance)
    start = int(rng.integers(num_memory))
    names = ("a", "b")
    automaton = make_automaton(
        delta, start, bit_labels(np.arange(4), 2), names, final=final, acceptance=acceptance
    )
    lazy = product(
        as_mdp(world, label=bit_labels(letter, 2), propositions=names),
        automaton,
        label_on=label_on,
    )
    return lazy, reference.explicit_product(world, delta, start, letter, label_on)


def random_representation(
    rng: np.random.Generator, kind: str, **options: Any
) -> tuple[MDP | DenseMDP | Product, reference.Model]:
    """A model of the given kind, and the explicit reference model."""
    options = {"num_states": 4, "num_actions": 3, "num_successors": 2, **options}
    if kind == "product":
        return random_product(rng, **options)
    model = reference.random_model(rng, **options)
    mdp = as_mdp(model)
    return (to_dense(mdp) if kind == "dense" else mdp), model


def assert_encloses(solution: Any, exact: np.ndarray) -> None:
    """The exact numbers (fractions, or floats without error) lie within the enclosure."""
    lower, upper = np.ravel(solution.lower), np.ravel(solution.upper)
    for i, true in enumerate(np.ravel(exact)):
        low, high = lower[i], upper[i]
        if isinstance(true, Fraction):
            low, high = (Fraction(float(x)) if np.isfinite(x) else float(x) for x in (low, high))
        assert low <= true <= high, f"entry {i}: {float(true)!r} is not in [{lower[i]}, {upper[i]}]"


def assert_solutions_agree(one: Any, other: Any, tolerance: float = 1e-11) -> None:
    """Same value and evidence up to rounding, and the same status."""
    np.testing.assert_array_equal(one.status, other.status)
    for field in ("value", "lower", "upper"):
        np.testing.assert_allclose(
            np.ravel(getattr(one, field)),
            np.ravel(getattr(other, field)),
            rtol=tolerance,
            atol=tolerance,
            err_msg=field,
        )


@contextmanager
def counted_traces() -> Iterator[list[str]]:
    """The list of functions that JAX traces meanwhile grows in the yielded list."""
    traced: list[str] = []

    def listener(event: str, _: float, **details: Any) -> None:
        if event.endswith("jaxpr_trace_duration"):
            traced.append(str(details.get("fun_name", event)))

    jax.monitoring.register_event_duration_secs_listener(listener)
    try:
        yield traced
    finally:
        jax.monitoring.unregister_event_duration_listener(listener)


# --- gradients ---------------------------------------------------------------------------------


def assert_gradients(
    function: Callable[[dict[str, jax.Array]], Any],
    point: dict[str, Any],
    directions: dict[str, Any],
    *,
    step: float = 1e-5,
    tolerance: float = 1e-6,
) -> None:
    """Forward mode, reverse mode and central differences agree along every direction.

    `directions` holds one direction for each argument that is to be checked; the function's
    results are compared entry by entry, relative to the largest.
    """
    point = {name: np.asarray(x, float) for name, x in point.items()}

    def flat(arguments: dict[str, jax.Array]) -> jax.Array:
        return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(function(arguments))])

    # One program, and of the derivative one copy, whose lanes are the directions.
    @jax.jit
    def derivatives(x, tangents):
        value, forward = jax.linearize(flat, x)
        weights = jax.random.normal(jax.random.key(0), value.shape)
        (gradient,) = jax.linear_transpose(forward, x)(weights)
        return value, jax.vmap(forward)(tangents), weights, gradient

    zero = {name: np.zeros_like(x) for name, x in point.items()}
    tangents = [{**zero, name: np.asarray(x, float)} for name, x in directions.items()]
    tangents = {name: np.stack([tangent[name] for tangent in tangents]) for name in zero}
    _, forward, weights, gradient = derivatives(point, tangents)
    weights = np.asarray(weights)
    for (name, direction), found in zip(directions.items(), forward, strict=True):
        ahead, behind = (
            derivatives({**point, name: point[name] + shift * direction}, tangents)[0]
            for shift in (step, -step)
        )
        expected = (np.asarray(ahead) - np.asarray(behind)) / (2 * step)
        scale = np.abs(expected).max()
        assert scale > 1e-3, f"{name}: the direction does not change anything"
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * scale, err_msg=name)
        reverse = np.vdot(gradient[name], direction)
        size_of_terms = np.abs(weights * expected).sum()
        assert abs(reverse - weights @ np.asarray(found)) <= 1e-9 * size_of_terms, name
        assert abs(reverse - weights @ expected) <= tolerance * size_of_terms, name


def mass_preserving(rng: np.random.Generator, probability: np.ndarray) -> np.ndarray:
    """A direction in which rows keep their sum and their support, and stay positive for a while."""
    used = np.asarray(probability) > 0
    noise = np.where(used, rng.normal(size=used.shape), 0)
    count = np.maximum(used.sum(axis=-1, keepdims=True), 1)
    return np.where(used, noise - noise.sum(axis=-1, keepdims=True) / count, 0)


def nature_word(objective, direction):
    """The word for a nature that maximises (``"max"``) or minimises under an objective."""
    return "cooperative" if objective == direction else "adversarial"


def random_action(key: jax.Array, actions: Finite | Box, allowed: Any = None) -> jax.Array:
    """A uniform random available action; normal in unbounded directions of a box."""
    if isinstance(actions, Finite):
        weight = jnp.zeros(actions.num) if allowed is None else jnp.where(allowed, 0, -jnp.inf)
        return jax.random.categorical(key, weight).astype(jnp.int32)
    space = some_action(actions)
    low, high = (jnp.broadcast_to(x, space.shape) for x in (actions.low, actions.high))
    bounded = jnp.isfinite(low) & jnp.isfinite(high)
    share = jax.random.uniform(key, space.shape, space.dtype)
    inside = jnp.where(bounded, low, 0) + share * jnp.where(bounded, high - low, 0)
    normal = jax.random.normal(key, space.shape, space.dtype)
    return jnp.where(bounded, inside, jnp.clip(normal, low, high))
