"""Probabilities of temporal formulas against Storm's own model checking, where it is installed."""

import random
from dataclasses import replace

import numpy as np
import pytest

from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.logic.ltl import Formula, negation_normal_form, subformulas
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.models.product import product
from jaxltl.core.values.undiscounted.satisfaction import (
    optimal_satisfaction,
    satisfaction_probability,
)
from tests.reference_logic import random_formula

pytest.importorskip("stormpy")
storm = pytest.importorskip("benchmarks.storm")

NAMES = ("a", "b")
STATES, ACTIONS, SUCCESSORS, MEMORY = 10, 2, 3, 24


def storm_text(formula: Formula) -> str:
    """The formula in Storm's syntax, which has no W, R and M."""
    texts: dict[Formula, str] = {}
    for node in subformulas(negation_normal_form(formula)):
        parts = [texts[f] for f in node.operands]
        match node.operator:
            case "true" | "false":
                text = node.operator
            case "ap":
                text = f'"{node.proposition}"'
            case "!" | "X" | "F" | "G":
                text = f"({node.operator} {parts[0]})"
            case "&" | "|" | "U":
                text = "(" + f" {node.operator} ".join(parts) + ")"
            case "W":
                text = f"(({parts[0]} U {parts[1]}) | (G {parts[0]}))"
            case "R":
                text = f"(({parts[1]} U ({parts[0]} & {parts[1]})) | (G {parts[1]}))"
            case "M":
                text = f"({parts[1]} U ({parts[0]} & {parts[1]}))"
        texts[node] = text
    return text


def random_world(rng: np.random.Generator):
    """Two actions, sparse supports; the last three are absorbing, so that chance decides."""
    shape = (STATES, ACTIONS, SUCCESSORS)
    successor = rng.integers(0, STATES, shape)
    weight = rng.random(shape) * (rng.random(shape) < 0.7)
    weight[..., 0] += 0.1
    successor[-3:] = np.arange(STATES - 3, STATES)[:, None, None]
    probability = weight / weight.sum(-1, keepdims=True)
    return make_mdp(
        successor,
        probability,
        initial=np.full(STATES, 1 / STATES),
        label=rng.random((STATES, len(NAMES))) < 0.5,
        propositions=list(NAMES),
    )


def storm_model(world):
    labels = {name: np.asarray(world.label)[:, i] for i, name in enumerate(NAMES)}
    return storm.build(world, np.zeros((STATES, ACTIONS)), labels)


def storm_values(model, objective: str, formula: Formula) -> np.ndarray | None:
    text = f"P{objective}=? [{storm_text(formula)}]"
    try:
        return storm.check(model, text, "sound_value_iteration", 1e-9)
    except RuntimeError as error:  # Storm misreads some of its own translator's output
        assert "acc-name" in str(error)
        return None


def padded(formula: Formula):
    """The parity automaton with idle states added, so that all products share one compilation."""
    automaton = to_automaton(
        formula,
        [{n for i, n in enumerate(NAMES) if k >> i & 1} for k in range(4)],
        acceptance="parity",
    )
    extra = MEMORY - len(automaton.delta)
    if extra < 0 or automaton.letters.shape[1] < 2:
        return None
    stay = np.arange(len(automaton.delta), MEMORY)[:, None].repeat(4, axis=1)
    return replace(
        automaton,
        delta=np.concatenate([automaton.delta, stay]).astype(np.int32),
        priority=np.concatenate([automaton.priority, np.ones_like(stay)]).astype(np.int32),
        state_names=(),
    )


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", range(4))
def test_largest_and_smallest_probabilities_are_storms(seed):
    rng, source = np.random.default_rng(seed), random.Random(seed)
    compared = between = 0
    while compared < 50:
        formula = random_formula(source, source.randint(5, 13), NAMES)
        automaton = padded(formula) if formula.propositions == NAMES else None
        if automaton is None:
            continue
        world = random_world(rng)
        model = product(world, automaton)
        peer = storm_model(world)
        start = np.asarray(model.initial_memory)
        for objective in ("max", "min"):
            ours = optimal_satisfaction(model, objective=objective, tolerance=1e-7)
            theirs = storm_values(peer, objective, formula)
            if theirs is None:
                continue
            here = (np.arange(STATES), start)
            lower, upper = np.asarray(ours.lower)[here], np.asarray(ours.upper)[here]
            assert (lower - 1e-6 <= theirs).all() and (theirs <= upper + 1e-6).all(), str(formula)
            assert (upper - lower).max() <= 2.1e-7
            attained = np.asarray(satisfaction_probability(model, ours.policy).value)
            assert np.abs(attained[here] - theirs).max() < 2e-6, str(formula)
            compared += objective == "max"
            between += int(((theirs > 1e-6) & (theirs < 1 - 1e-6)).sum())
    assert between > 30  # many probabilities are neither 0 nor 1
