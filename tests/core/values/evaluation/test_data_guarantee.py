"""What data guarantee holds as often as it says, and tightens with more of them."""

from fractions import Fraction

import numpy as np
import pytest

from jaxltl.core.models.construct.counts import make_counts, model_from_counts
from jaxltl.core.models.interval import make_interval
from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.statistics.confidence_sets import (
    LeastProbability,
    describe_graph,
    intervals_from_counts,
)
from jaxltl.core.values.evaluation.data_guarantee import guarantee_curve, learn_guarantee, safe_mean
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from tests.reference_intervals import random_model

METHODS = ["clopper-pearson", "hoeffding", "weissman", "anytime"]
TASKS = ["F a", "!b U a", "G F a", "F G a | F b", "G !b"]


def labelled(rng, num_states=5):
    host = random_model(rng, num_states, unit=12).mdp
    return make_sparse(
        host.row_start,
        host.entry_start,
        host.successor,
        host.probability,
        initial=np.eye(num_states)[0],
        label=rng.random((num_states, 2)) < 0.4,
        propositions=["a", "b"],
    )


def drawn(rng, model, size):
    """So many samples of each choice."""
    return np.concatenate(
        [
            rng.multinomial(size, model.probability[i:j] / model.probability[i:j].sum())
            for i, j in zip(model.entry_start[:-1], model.entry_start[1:], strict=True)
        ]
    )


@pytest.mark.few(2)
@pytest.mark.parametrize("count", [20, pytest.param(2000, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("method", METHODS)
def test_guarantees_hold(method, count):
    """For the policy that is returned, too; at most one in ten may fail, and few come near it."""
    rng = np.random.default_rng(METHODS.index(method))
    failed, loose = 0, 0.0
    for i in range(count):
        model, task = labelled(rng), TASKS[i % len(TASKS)]
        found = learn_guarantee(
            model,
            drawn(rng, model, int(rng.integers(1, 300))),
            task,
            0.9,
            graph="given",
            method=method,
        )
        true = optimal_satisfaction(model, task).value[0]
        own = under(model, found)
        failed += found.bound > own + 1e-9 or found.optimistic < true - 1e-9
        assert own <= true + 1e-9
        loose += true - found.bound
    assert failed <= 0.1 * count
    assert loose < 0.75 * count


def under(model, found):
    """The true probability under the policy, whose memory is the automaton's state."""
    product = found.satisfaction.product_policy.product
    points = make_interval(model, model.probability, model.probability)
    whole = optimal_satisfaction(
        points, found.satisfaction.product_policy.automaton, nature="cooperative"
    )
    np.testing.assert_array_equal(whole.product_policy.product.base_state, product.base_state)
    host = whole.product_policy.product.host
    taken = (
        whole.product_policy.product.base_row
        == np.asarray(found.satisfaction.product_policy.row)[host.state]
    )
    rows = np.flatnonzero(taken)
    entries = np.isin(host.row, rows)
    state, memory = product.base_state, product.memory
    letter = found.satisfaction.product_policy.letter[state]
    chain = make_sparse(
        None,
        np.concatenate([[0], np.diff(host.entry_start)[rows].cumsum()]),
        host.successor[entries],
        host.probability[entries],
        initial=np.eye(state.size)[product.start[0]],
    )
    automaton = found.satisfaction.product_policy.automaton
    if automaton.acceptance in ("buchi", "parity"):
        # Labels name the priorities that are read.
        level = np.asarray(automaton.priority)[memory, letter]
        good = [
            f"(G F p{p})" + "".join(f" & F G !p{q}" for q in range(p))
            for p in range(0, level.max() + 1, 2)
        ]
        label = level[:, None] == np.arange(level.max() + 1)
        names = [f"p{p}" for p in range(level.max() + 1)]
        task = " | ".join(f"({x})" for x in good)
    else:
        final = np.asarray(automaton.final)[memory]
        label, names = final[:, None], ["final"]
        task = "F final" if automaton.acceptance == "cosafe" else "G final"
    chain = make_sparse(
        None,
        chain.entry_start,
        chain.successor,
        chain.probability,
        initial=chain.initial,
        label=label,
        propositions=names,
    )
    return optimal_satisfaction(chain, task).value[0]


def test_more_data_guarantee_more():
    rng = np.random.default_rng(5)
    model = labelled(np.random.default_rng(12))
    true = optimal_satisfaction(model, "!b U a").value[0]
    counts = drawn(rng, model, 10**6)
    for method in METHODS:
        found = learn_guarantee(model, counts, "!b U a", 0.99, graph="given", method=method)
        assert true - 0.02 < found.bound <= true <= found.optimistic < true + 0.02
    worst = learn_guarantee(model, counts, "!b U a", 0.99, graph="given", objective="min")
    least = optimal_satisfaction(model, "!b U a", objective="min").value[0]
    assert worst.optimistic <= least + 1e-9
    assert least <= worst.bound < least + 0.02


def coins():
    """Two tosses in a row, of which one was seen more often."""
    return make_sparse(
        None,
        [0, 2, 4, 5, 6],
        [1, 3, 2, 3, 2, 3],
        [0.9, 0.1, 0.8, 0.2, 1, 1],
        initial=[1, 0, 0, 0],
        label=[[0], [0], [1], [0]],
        propositions=["a"],
    )


def test_where_more_samples_help():
    """The gain is the change of the bound if a choice becomes known, while it is small."""
    model = coins()
    counts = np.array([900_000, 100_000, 8_000, 2_000, 0, 0])
    found = learn_guarantee(model, counts, "F a", 0.9, graph="given")
    assert found.gain.argmax() == 1
    assert (found.gain >= 0).all()
    sets = found.sets
    for row, of in ((0, slice(0, 2)), (1, slice(2, 4))):
        lower, upper = sets.lower.copy(), sets.upper.copy()
        lower[of] = upper[of] = sets.center[of]
        known = optimal_satisfaction(make_interval(model, lower, upper), "F a").value[0]
        assert known - found.bound == pytest.approx(found.gain[row], rel=0.05)


def test_the_curve_of_a_log():
    counts = np.array([9000, 1000, 8000, 2000, 0, 0])
    curve = guarantee_curve(
        coins(), counts, "F a", 0.9, [0, 100, 5000, 20_000], graph="given", seed=1
    )
    assert curve[0] == 0
    assert (np.diff(curve) > 0).all()
    whole = learn_guarantee(coins(), counts, "F a", 0.9, graph="given").bound
    assert curve[-1] == whole
    again = guarantee_curve(coins(), counts, "F a", 0.9, [20_000, 100], graph="given", seed=1)
    assert again[0] == whole
    with pytest.raises(ValueError, match=r"sizes\[1\] is 20001; there are 20000 transitions"):
        guarantee_curve(coins(), counts, "F a", 0.9, [5, 20_001], graph="given")
    for numbers, sizes, message in (
        (counts, [0.5], "sizes is float64"),
        (counts, 5, "sizes is int64"),
        (counts + 0.5, [5], "counts is float64"),
        (-counts, [5], "none is negative"),
    ):
        with pytest.raises(ValueError, match=message):
            guarantee_curve(coins(), numbers, "F a", 0.9, sizes, graph="given")


def test_counts_by_name():
    counts = make_counts([0, 0, 1, 1], [0] * 4, [1, 3, 2, 3], [90, 10, 80, 20])
    found = learn_guarantee(coins(), counts, "F a", 0.9, graph="given")
    same = learn_guarantee(coins(), np.array([90, 10, 80, 20, 0, 0]), "F a", 0.9, graph="given")
    assert found.bound == same.bound > 0.4
    with pytest.raises(ValueError, match="confidence"):
        learn_guarantee(coins(), counts, "F a", 1.0, graph="given")


def test_means_are_rounded_to_the_safe_side():
    rng = np.random.default_rng(5)
    for _ in range(200):
        share, value = rng.dirichlet(np.ones(4)), rng.random(4)
        weights = [Fraction(x) for x in share.tolist()]
        mean = sum(w * Fraction(x) for w, x in zip(weights, value.tolist(), strict=True))
        low, high = (safe_mean(share, value, up=up) for up in (False, True))
        assert Fraction(low) <= mean / sum(weights) <= Fraction(high) <= low + Fraction(1, 10**14)
    assert safe_mean(share, np.ones(4), up=False) == 1


def test_a_transition_that_was_not_observed_is_not_taken_for_impossible():
    """A rare fall into the pit: half of the logs do not contain it, so no bound may exclude it."""
    rng, num_logs, size, rare = np.random.default_rng(0), 20, 1500, 0.0005
    graphs = {
        "seen": "seen",
        "complete": "complete",
        "least": LeastProbability(rare, failure=0.01),
        "too large": LeastProbability(0.05, failure=0.01),
    }
    wrong = dict.fromkeys(graphs, 0)
    for _ in range(num_logs):
        fall = int(rng.binomial(size, rare))
        counts = make_counts(
            [0, 0], [0, 0], [1, 2], [size - fall, fall], states=["dock", "bay", "pit"]
        )
        counts = counts if fall else make_counts([0], [0], [1], [size], states=counts.states)
        for name, graph in graphs.items():
            model, count = model_from_counts(
                counts,
                initial="dock",
                labels={"bay": ["bay"]},
                terminal=["bay", "pit"],
                graph=graph,
            )
            if name == "too large" and fall:  # the log refutes it
                with pytest.raises(ValueError, match="assume a smaller one"):
                    learn_guarantee(model, count, "F bay", 0.95, graph=graph)
                continue
            found = learn_guarantee(model, count, "F bay", 0.95, graph=graph)
            assert found.confidence == 0.95 and found.optimistic > 1 - rare
            assert found.assumption == describe_graph(graph)
            wrong[name] += found.bound > 1 - rare
    assert wrong["complete"] <= 0.05 * num_logs and wrong["least"] <= 0.05 * num_logs
    # Assumptions that do not hold.
    assert wrong["seen"] > 0.3 * num_logs and wrong["too large"] > 0.3 * num_logs


@pytest.mark.few(2, 2)
@pytest.mark.parametrize("seed", range(4))
def test_an_assumption_never_guarantees_less_than_none(seed):
    """A least probability only shrinks the confidence sets of the complete graph."""
    rng = np.random.default_rng(seed)
    true = rng.dirichlet(np.ones(4), (3, 2)) * 0.9 + 0.025
    pairs = np.argwhere(np.ones((3, 2), bool))
    drawn = np.array([rng.multinomial(10 ** rng.integers(1, 5), true[s, a]) for s, a in pairs])
    row, successor = np.nonzero(drawn)
    counts = make_counts(*pairs[row].T, successor, drawn[row, successor], states=list("abcd"))
    made = {"initial": "a", "labels": {"d": ["d"], "c": ["c"]}, "terminal": ["d"]}
    for formula in ("F d & G !c", "G !d"):
        bounds = []
        for graph in ("complete", *(LeastProbability(p) for p in (1e-6, 0.001, 0.01, 0.025))):
            model, count = model_from_counts(counts, graph=graph, **made)
            found = learn_guarantee(model, count, formula, 0.95, graph=graph)
            bounds.append(found.bound)
        assert (np.diff(bounds) >= -1e-6).all()
    counts = make_counts([0, 0], [0, 0], [0, 1], [10**6, 1], states=["a", "b"])
    model, count = model_from_counts(counts, initial="a", labels={"b": ["b"]}, graph=graph)
    with pytest.raises(ValueError, match=r"graph: .* state 1 .* assume a smaller one"):
        learn_guarantee(model, count, "F b", 0.9, graph=graph)


@pytest.mark.parametrize(("value", "num_choices"), [(0.3, 1), (0.05, 7), (0.6, 3)])
def test_sufficient_samples_show_all_transitions(value, num_choices):
    graph = LeastProbability(value, failure=0.02)
    samples = graph.sufficient_samples(num_choices)
    width = int(1 / value)  # the most transitions that a choice can have
    if width > 1:
        assert num_choices * width * (1 - value) ** samples <= graph.failure
        assert num_choices / value * (1 - value) ** (samples - 3) > graph.failure
    rng = np.random.default_rng(1)
    drawn = rng.multinomial(samples, [value] * width + [1 - value * width], size=10_000)
    missed = (drawn[:, :width] == 0).any(1).mean() if width > 1 else 0
    assert missed * num_choices <= graph.failure * 1.5


def test_assumptions_that_are_refused():
    counts = np.array([90, 10, 80, 20, 0, 0])
    with pytest.raises(TypeError, match="graph"):
        learn_guarantee(coins(), counts, "F a", 0.9)
    with pytest.raises(ValueError, match="graph='all'; choose one of given, seen, complete"):
        learn_guarantee(coins(), counts, "F a", 0.9, graph="all")
    with pytest.raises(ValueError, match="graph='complete', but choice 0 has 2 of"):
        learn_guarantee(coins(), counts, "F a", 0.9, graph="complete")
    with pytest.raises(ValueError, match=r"graph.failure=0.1; it must be below 1 - confidence"):
        learn_guarantee(coins(), counts, "F a", 0.95, graph=LeastProbability(0.1, failure=0.1))
    with pytest.raises(ValueError, match=r"value=0; it must be above 0"):
        LeastProbability(0)


def test_confidence_sets_in_place_of_counts():
    coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1], initial=[1, 0, 0],
                       label=[[0], [1], [0]], propositions=["a"])  # fmt: skip
    counts = np.array([900, 100, 0, 0])
    sets = intervals_from_counts(counts, 0.95, method="anytime", entry_start=coin.entry_start)
    found = [learn_guarantee(coin, x, "F a", 0.95, graph="given") for x in (counts, sets)]
    assert found[0].bound == found[1].bound and found[0].optimistic == found[1].optimistic
    for option in ({"confidence": 0.99}, {"confidence": 0.95, "method": "anytime"}):
        with pytest.raises(ValueError, match="counts are confidence sets by anytime"):
            learn_guarantee(coin, sets, "F a", graph="given", **option)
    graph = LeastProbability(0.1, failure=0.01)
    with pytest.raises(ValueError, match=r"confidence of at least 0\.96"):
        learn_guarantee(coin, sets, "F a", 0.95, graph=graph)
