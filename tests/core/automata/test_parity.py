"""Small parity automata, against enumeration of loops and differences of languages."""

import random
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from jaxltl.core.automata.automaton import accepts_lasso, make_automaton
from jaxltl.core.automata.language import find_difference, is_equivalent
from jaxltl.core.automata.parity import (
    ParityTable,
    components,
    language_classes,
    reduce_table,
    simplify,
)
from jaxltl.core.automata.translate import to_automaton
from tests.reference_logic import random_formula, random_lasso, subsets

A = [[False], [True]]


def random_parity(rng, states, priorities, rows=A, names=("a",)):
    width = len(rows)
    delta = [[rng.randrange(states) for _ in range(width)] for _ in range(states)]
    priority = [[rng.choice(priorities) for _ in range(width)] for _ in range(states)]
    return make_automaton(delta, 0, rows, names, priority=priority)


# --- the reference: all loops ----------------------------------------------------------------


def successors_of(edges):
    after = {}
    for q, _, target in edges:
        after.setdefault(q, set()).add(target)
    return after


def reached_from(state, after):
    seen = {state}
    for q in (queue := [state]):
        for target in after.get(q, ()):
            if target not in seen:
                seen.add(target)
                queue.append(target)
    return seen


def reachable_edges(automaton):
    delta = automaton.delta.tolist()
    every = {(q, k, t) for q, row in enumerate(delta) for k, t in enumerate(row)}
    seen = reached_from(int(automaton.initial), successors_of(every))
    return [edge for edge in sorted(every) if edge[0] in seen]


def loops(automaton):
    """All sets of transitions that a run can repeat for ever, with their verdicts."""
    edges, found = reachable_edges(automaton), {}
    assert len(edges) <= 12, "2^12 sets"
    for size in range(1, len(edges) + 1):
        for chosen in combinations(edges, size):
            after = successors_of(chosen)
            if all(q in reached_from(t, after) for q, _, t in chosen):
                starts = {q for q, _, _ in chosen}
                if starts <= reached_from(chosen[0][0], after):
                    least = min(automaton.priority[q, k] for q, k, _ in chosen)
                    found[frozenset(chosen)] = least % 2 == 0
    return found


def kind_by_loops(automaton):
    """The simplest acceptance, by Landweber's criteria.

    Co-safe (open): what is reached from an accepting loop accepts; safety (closed): what is
    reached from a rejecting loop rejects; deterministic Buchi: a loop that holds an accepting
    one accepts.
    """
    found = loops(automaton)
    after = successors_of(reachable_edges(automaton))

    def decided(verdict):
        for loop, accepts in found.items():
            if accepts == verdict:
                inside = reached_from(next(iter(loop))[0], after)
                for other, other_accepts in found.items():
                    if other_accepts != verdict and next(iter(other))[0] in inside:
                        return False
        return True

    if decided(True):
        return "cosafe"
    if decided(False):
        return "safety"
    accepting = [loop for loop, accepts in found.items() if accepts]
    rejecting = [loop for loop, accepts in found.items() if not accepts]
    buchi = not any(small < large for small in accepting for large in rejecting)
    return "buchi" if buchi else "parity"


def residuals(automaton):
    """The number of languages that the reachable states have, by pairs."""
    states = sorted({edge[0] for edge in reachable_edges(automaton)})
    kept = []
    for q in states:
        started = replace(automaton, initial=np.int32(q))
        if all(find_difference(started, other) is not None for other in kept):
            kept.append(started)
    return len(kept)


# --- tests -----------------------------------------------------------------------------------


CASES = [
    (1, [0, 1, 2, 3], 15),
    (2, [0, 1], 30),
    (3, [0, 1], 30),
    (3, [1, 2], 20),
    (4, [0, 1, 2], 25),
    (5, [0, 1, 2, 3], 20),
    (5, [0, 1], 15),
]


@pytest.mark.parametrize(("states", "priorities", "count"), CASES)
def test_the_language_stays_and_the_acceptance_is_the_simplest(states, priorities, count):
    rng = random.Random(states * 10 + len(priorities))
    kinds = []
    for _ in range(count):
        automaton = random_parity(rng, states, priorities)
        small = simplify(automaton)
        assert len(small.delta) <= len(automaton.delta)
        assert is_equivalent(automaton, small)
        for _ in range(15):
            lasso = random_lasso(rng, subsets("a"))
            assert accepts_lasso(small, *lasso) == accepts_lasso(automaton, *lasso)
        kinds.append(small.acceptance)
        assert small.acceptance == kind_by_loops(automaton), (automaton.delta, automaton.priority)
    assert len(set(kinds)) >= 2


def weak(automaton):
    """Whether no two loops of one component have different verdicts, by enumeration."""
    found = loops(automaton)
    component = components(ParityTable(automaton.delta, automaton.priority, 0))
    verdicts = {}
    for loop, accepts in found.items():
        verdicts.setdefault(component[next(iter(loop))[0]], set()).add(accepts)
    return all(len(both) == 1 for both in verdicts.values())


def test_weak_results_have_one_state_for_each_language():
    """A weak language is recognised on its residuals, so that no automaton has fewer states."""
    rng = random.Random(1)
    seen = []
    for _ in range(400):
        automaton = random_parity(rng, rng.randint(2, 6), [0, 1, 1, 2][: rng.choice([2, 4])])
        automaton = replace(
            automaton,
            delta=np.maximum(
                automaton.delta, np.arange(len(automaton.delta))[:, None] - rng.randint(0, 1)
            ).astype(np.int32),
        )  # many small components
        if rng.random() < 0.5:  # one color for each state
            automaton = replace(automaton, priority=automaton.priority[:, :1].repeat(2, axis=1))
        if weak(automaton):
            small = simplify(automaton)
            assert len(small.delta) == residuals(automaton), (automaton.delta, automaton.priority)
            seen.append((small.acceptance, len(small.delta)))
    assert len(seen) > 60 and {kind for kind, _ in seen} >= {"cosafe", "safety", "buchi"}
    assert max(count for _, count in seen) >= 4


def test_transient_states_do_not_spoil_safety():
    """The first step is on no cycle, so that its color says nothing of the language."""
    # 0 -a-> 1 (everything), 0 -!a-> 2 (nothing): decided after one letter.
    for priority in (0, 1, 2, 3):
        table = [[priority, priority], [0, 0], [1, 1]]
        automaton = make_automaton([[2, 1], [1, 1], [2, 2]], 0, A, ["a"], priority=table)
        assert simplify(automaton).acceptance == "cosafe"
    # 0 -> 1, then G a: safety, with 0 transient.
    for priority in (0, 1, 2, 3):
        table = [[priority, priority], [0, 0], [1, 1]]
        automaton = make_automaton([[1, 1], [2, 1], [2, 2]], 0, A, ["a"], priority=table)
        small = simplify(automaton)
        assert small.acceptance == "safety" and len(small.delta) == 3
        assert small.final.tolist() == [True, True, False]
    # 0 -a-> 1 -> G a, 0 -!a-> false: the first state sees the sink.
    for priority in (0, 1):
        table = [[priority, priority], [0, 0], [1, 1]]
        automaton = make_automaton([[2, 1], [2, 1], [2, 2]], 0, A, ["a"], priority=table)
        assert simplify(automaton).acceptance == "safety"
        table = [[priority, priority], [priority, priority], [0, 0], [1, 1]]
        automaton = make_automaton([[3, 1], [2, 2], [3, 2], [3, 3]], 0, A, ["a"], priority=table)
        small = simplify(automaton)
        assert small.acceptance == "safety" and len(small.delta) == 4
        assert sorted(small.final.tolist()) == [False, True, True, True]
    # !a W (a & X a): the state after the first a is transient, below an accepting component.
    for priority in (0, 1):
        table = [[0, priority], [priority, priority], [0, 0], [1, 1]]
        automaton = make_automaton([[0, 1], [3, 2], [2, 2], [3, 3]], 0, A, ["a"], priority=table)
        small = simplify(automaton)
        assert small.acceptance == "safety" and len(small.delta) == 4
        assert sorted(small.final.tolist()) == [False, True, True, True]


def test_priorities_are_compressed_and_transient_ones_are_plain():
    rng = random.Random(2)
    for _ in range(120):
        automaton = random_parity(rng, rng.randint(1, 5), [0, 3, 4, 7, 8])
        small = simplify(automaton)
        used = sorted(set(small.priority.ravel().tolist()))
        assert used == list(range(used[0], used[-1] + 1)) and used[0] <= 1
        if small.acceptance in ("cosafe", "safety", "buchi"):
            assert used[-1] <= 1
        if small.acceptance == "parity":
            assert used[-1] >= 2
            again = replace(small, priority=small.priority + 6)
            assert set(simplify(again).priority.ravel().tolist()) == set(used)


def test_priorities_are_as_few_as_the_chains_of_loops_ask():
    """As many as the longest chain of loops of alternating verdicts in some component."""
    rng = random.Random(3)
    most = 0
    for _ in range(80):
        small = simplify(random_parity(rng, rng.randint(1, 4), [0, 1, 2, 3, 4]))
        if small.acceptance not in ("buchi", "parity"):
            continue
        found = loops(small)
        longest = {}
        for loop in sorted(found, key=len):
            below = [longest[o] for o in longest if o < loop and found[o] != found[loop]]
            longest[loop] = 1 + max(below, default=0)
        chain = max(longest.values())
        count = len(set(small.priority.ravel().tolist()))
        assert chain <= count <= chain + 1, (small.delta, small.priority)
        most = max(most, count)
    assert most >= 4


def test_no_language_in_two_components():
    rng = random.Random(4)
    shrunk = 0
    for _ in range(120):
        automaton = random_parity(rng, rng.randint(2, 6), [0, 1, 2])
        small = simplify(automaton)
        component = components(ParityTable(small.delta, small.priority, 0))
        for p in range(len(small.delta)):
            for q in range(p):
                if component[p] != component[q]:
                    left, right = (replace(small, initial=np.int32(s)) for s in (p, q))
                    assert find_difference(left, right) is not None
        shrunk += len(small.delta) < len(automaton.delta)
    assert shrunk > 20


def test_language_classes_by_pairs():
    rng = random.Random(5)
    merged = 0
    for _ in range(80):
        automaton = random_parity(rng, rng.randint(1, 5), [0, 1, 2, 3])
        classes = language_classes(ParityTable(automaton.delta, automaton.priority, 0))
        for p in range(len(automaton.delta)):
            for q in range(p):
                left, right = (replace(automaton, initial=np.int32(s)) for s in (p, q))
                assert (classes[p] == classes[q]) == is_equivalent(left, right)
                merged += classes[p] == classes[q]
    assert merged > 20


def test_again_changes_nothing():
    rng = random.Random(6)
    for _ in range(80):
        small = simplify(random_parity(rng, rng.randint(1, 6), [0, 1, 2]))
        again = simplify(small)
        assert again.delta.shape == small.delta.shape and again.acceptance == small.acceptance
        assert (again.priority == small.priority).all()


def test_base_states_have_the_language():
    rng = random.Random(7)
    for _ in range(30):
        automaton = random_parity(rng, rng.randint(1, 6), [0, 1, 2])
        table = ParityTable(automaton.delta, automaton.priority, 0)
        for thorough in (True, False):
            (delta, priority, initial), kind, base = reduce_table(table, thorough)
            small = replace(
                automaton,
                delta=delta.astype(np.int32),
                acceptance="parity",
                priority=priority.astype(np.int32),
            )
            assert kind == simplify(automaton).acceptance and initial == 0
            for q, old in enumerate(base):
                left = replace(small, initial=np.int32(q))
                assert is_equivalent(left, replace(automaton, initial=np.int32(old)))


def test_names_follow_their_states():
    automaton = make_automaton(
        [[1, 1], [2, 2], [0, 0]],
        0,
        A,
        ["a"],
        accepting=[[False, True]] * 3,
        state_names=["x", "y", "z"],
    )
    small = simplify(automaton)
    assert small.delta.tolist() == [[0, 0]] and small.state_names[0] in ("x", "y", "z")


def test_translated_automata_have_the_acceptance_of_their_loops():
    rng = random.Random(8)
    seen = {"cosafe": 0, "safety": 0, "buchi": 0, "parity": 0}
    for _ in range(200):
        formula = random_formula(rng, rng.randint(3, 12), "a")
        automaton = to_automaton(formula, subsets("a"))
        if len(automaton.delta) <= 5:
            kind = kind_by_loops(automaton)
            assert automaton.acceptance == kind or (
                automaton.acceptance == "safety" and kind == "cosafe"  # both, by its syntax
            ), str(formula)
            seen[automaton.acceptance] += 1
    assert min(seen.values()) >= 3, seen
