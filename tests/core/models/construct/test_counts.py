"""Counted transitions: put together, beside the entries of models, and as models."""

import collections

import numpy as np
import pytest

from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.construct.counts import (
    action_names,
    align_counts,
    in_order,
    make_counts,
    model_from_counts,
    state_names,
)
from jaxltl.core.models.game import make_game
from jaxltl.core.models.interval import make_interval
from jaxltl.core.models.mdp import from_dense, make_mdp, to_dense
from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.statistics.confidence_sets import intervals_from_counts
from tests.sparse_models import random_sparse


def slowly(counts):
    columns = counts.state, counts.action, counts.successor, counts.count
    return {
        (counts.states[s], counts.actions[a], counts.states[t]): n
        for s, a, t, n in zip(*(x.tolist() for x in columns), strict=True)
    }


def test_transitions_put_together():
    rng = np.random.default_rng(0)
    for _ in range(20):
        size = int(rng.integers(1, 60))
        s, a, t = rng.integers(0, 5, (3, size))
        n = rng.integers(0, 4, size)
        wanted = collections.Counter()
        for key, many in zip(zip(s, a, t, strict=True), n, strict=True):
            wanted[tuple(map(str, key))] += int(many)
        counts = make_counts(s, a, t, n)
        assert slowly(counts) == dict(wanted) and counts.num_samples == n.sum()
        order = rng.permutation(size)
        again = make_counts(s[order], a[order], t[order], n[order].astype(np.uint8))
        assert (again.count == counts.count).all() and (again.successor == counts.successor).all()


def model_and_counts(rng, num_states=6):
    """A model and counts of some of its transitions."""
    model = random_sparse(rng, num_states)
    model = model.replace(action=np.arange(model.num_rows) - model.host.row_start[model.host.state])
    host, count = model.host, rng.integers(0, 9, model.num_transitions)
    row = np.repeat(np.arange(host.num_rows), np.diff(host.entry_start))
    kept = rng.permutation(np.flatnonzero(count))
    return (
        model,
        count,
        make_counts(
            host.state[row][kept],
            model.action[row][kept],
            host.successor[kept],
            count[kept],
            states=[str(i) for i in range(num_states)],
        ),
    )


def test_beside_the_entries_of_a_model():
    rng = np.random.default_rng(1)
    for _ in range(20):
        model, count, counts = model_and_counts(rng)
        assert (align_counts(model, counts) == count).all()
        assert (align_counts(model.replace(action=None), counts) == count).all(), "ranks of choices"
        renamed = model.replace(
            valuation={"state": 10 * np.arange(model.num_states)}, action_names=tuple("abcdefgh")
        )
        named = make_counts(
            counts.state,
            counts.action,
            counts.successor,
            counts.count,
            states=[f"{i}0" if i else "0" for i in range(model.num_states)],
            actions="abcdefgh",
        )
        assert (align_counts(renamed, named) == count).all()
        assert state_names(renamed)[1] == "10" and action_names(renamed)[1] == "b"


def test_beside_padded_entries():
    rng = np.random.default_rng(2)
    weight = rng.random((4, 3, 4)) * (rng.random((4, 3, 4)) < 0.6)
    weight[:, 0, 0] += 0.1
    total = weight.sum(-1, keepdims=True)
    mdp = from_dense(np.divide(weight, total, out=np.zeros_like(weight), where=total > 0))
    sparse = to_sparse(mdp)
    count = rng.integers(1, 9, sparse.num_transitions)
    row = np.repeat(np.arange(sparse.num_rows), np.diff(sparse.entry_start))
    counts = make_counts(sparse.host.state[row], sparse.action[row], sparse.successor, count)
    assert (align_counts(sparse, counts) == count).all()
    padded, dense = align_counts(mdp, counts), align_counts(to_dense(mdp), counts)
    used = np.asarray(mdp.probability) > 0
    assert padded.shape == used.shape and (padded[used] == count).all() and not padded[~used].any()
    for s, a, t, n in zip(counts.state, counts.action, counts.successor, counts.count, strict=True):
        assert dense[s, a, t] == n
    assert dense.sum() == count.sum()


def test_what_no_model_has():
    model = make_sparse([0, 2, 3], [0, 2, 3, 4], [0, 1, 1, 1], [0.5, 0.5, 1, 1])
    for numbers, names, message in (
        (([0], [1], [0]), None, "action '1' in state '0' cannot lead to '0'"),
        (([1], [1], [1]), None, "state '1' has no action '1'"),
        (([0], [0], [0]), ["x"], "the model has no state 'x'; it has 2: '0', '1'"),
        (([0], [2], [0]), None, "the model has no action '2'"),
    ):
        with pytest.raises(ValueError, match=message):
            align_counts(model, make_counts(*numbers, states=names))
    counts = make_counts([0], [0], [1])
    twice = model.replace(action=np.array([0, 0, 0]))
    with pytest.raises(ValueError, match="choices 0 and 1 of the model have the same names"):
        align_counts(twice, counts)
    mdp = make_mdp([[[0, 0]]], [[[0.5, 0.5]]])
    with pytest.raises(ValueError, match="successors 0 and 1 of the model have the same"):
        align_counts(mdp, counts)
    with pytest.raises(ValueError, match=r"Game has no transitions to count; .*of a game, its mdp"):
        align_counts(make_game(model, [True, False]), counts)


@pytest.mark.parametrize("graph", ["seen", "complete"])
def test_a_model_of_counts(graph):
    rng = np.random.default_rng(3)
    for _ in range(20):
        num_states = int(rng.integers(2, 7))
        size = int(rng.integers(1, 20))
        s, t = rng.integers(0, num_states, (2, size))
        states = [f"s{i}" for i in range(num_states)]
        counts = make_counts(
            s,
            rng.integers(0, 3, size),
            t,
            rng.integers(0, 5, size),
            states=states,
            actions=["x", "y", "z"],
        )
        stays = [x for i, x in enumerate(states) if not (s == i).any()][::2]
        model, count = model_from_counts(
            counts,
            initial=[states[0], states[-1]],
            terminal=stays,
            graph=graph,
            labels={"last": [states[-1]], "none": []},
        )
        seen = slowly(counts)
        found = {}
        host = model.host
        for r in range(host.num_rows):
            entries = range(host.entry_start[r], host.entry_start[r + 1])
            key = states[host.state[r]], model.action_names[model.action[r]]
            assert key not in found
            found[key] = {states[host.successor[e]]: int(count[e]) for e in entries}
        wanted = {}
        for (a, b, c), n in seen.items():
            wanted.setdefault((a, b), {})[c] = n
        for name in states:
            if not any(a == name for a, _ in wanted):
                wanted[name, "any"] = {name: 0} if name in stays else dict.fromkeys(states, 0)
        if graph == "complete":
            wanted = {
                key: row if key[0] in stays else dict.fromkeys(states, 0) | row
                for key, row in wanted.items()
            }
        assert found == wanted
        # The probabilities are frequencies, and positive.
        for r in range(host.num_rows):
            part = slice(host.entry_start[r], host.entry_start[r + 1])
            more = count[part] + (count[part].min() == 0)
            assert np.allclose(host.probability[part], more / more.sum())
        assert model.states_with_label("last").tolist() == [x == states[-1] for x in states]
        assert not model.states_with_label("none").any()
        assert model.initial.sum() == 1 and set(np.flatnonzero(model.initial)) <= {
            0,
            num_states - 1,
        }
        assert state_names(model) == tuple(states)
        assert align_counts(model, counts).tolist() == count.tolist()


def test_from_counts_to_an_interval_model():
    counts = make_counts(
        [0, 0, 0, 1], [0, 0, 1, 0], [0, 1, 2, 1], [70, 30, 4, 9], states=["start", "goal", "lost"]
    )
    model, count = model_from_counts(
        counts,
        initial="start",
        labels={"goal": ["goal"]},
        terminal=["lost", "goal"],
        graph="complete",
    )
    for method in ("clopper-pearson", "hoeffding", "weissman", "anytime"):
        sets = intervals_from_counts(count, 0.9, entry_start=model.entry_start, method=method)
        assert sets.num_claims == (2 if method == "weissman" else 6)
        interval = make_interval(model, sets.lower, sets.upper)
        assert interval.num_transitions == model.num_transitions
        assert (interval.lower == sets.lower).all() and (interval.upper == sets.upper).all()


def test_integers_as_names():
    counts = make_counts([0, 1], [0, 0], [1, 1], states=["3", "-12"])
    model, _ = model_from_counts(
        counts, initial={3: 0.25, "-12": 0.75}, graph="seen", terminal=[-12]
    )
    assert model.valuation["state"].tolist() == [3, -12] and model.initial.tolist() == [0.25, 0.75]
    assert in_order({"b", "a"}) == ("a", "b") and in_order(["2", "10", "-3"]) == ("-3", "2", "10")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"initial": "x"}, "initial: there is no state 'x'; there are 2: '0', '1'"),
        ({"initial": {"0": 0.5}}, "the initial distribution sums to 0.5"),
        ({"initial": []}, "the initial distribution sums to 0"),
        ({"labels": {"goal": ["y"]}}, "label 'goal': there is no state 'y'"),
        ({"terminal": ["7"]}, "terminal: there is no state '7'"),
        ({"terminal": ["0"]}, "terminal state '0' was left to '1'"),
        ({"graph": "known"}, "graph='known'; choose one of seen, complete"),
    ],
)
def test_models_that_are_refused(arguments, message):
    counts = make_counts([0, 1], [0, 0], [1, 1])
    with pytest.raises(ValueError, match=message):
        model_from_counts(counts, **{"initial": "0", "graph": "seen"} | arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([], [], []), "state is float64"),
        (([0], [0, 1], [0]), "action is int64"),
        (([0], [0], [0.0]), "successor is float64"),
        (([0], [0], [0], [-1]), "count.0. is -1; none is negative"),
        (([0], [-2], [0]), "action.0. is -2"),
        (([10**12], [0], [0]), "states go up to 1000000000000; number them from 0"),
        (([0, 0], [0, 0], [0, 0], [2**62, 2**62]), "count adds up to 9223372036854775808; at most"),
    ],
)
def test_counts_that_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_counts(*arguments)
    with pytest.raises(ValueError, match="there are 1 names of states; number 1 has none"):
        make_counts([0], [0], [1], states=["a"])
    with pytest.raises(ValueError, match="states: the name 'a' stands twice"):
        make_counts([0], [0], [1], states=["a", "a"])


def test_graphs_that_are_too_large():
    size = 20_000
    counts = make_counts(np.arange(size), 0 * np.arange(size), np.arange(size))
    with pytest.raises(ValueError, match="20000 choices that may lead to each of 20000 states"):
        model_from_counts(counts, initial=0, graph="complete")
