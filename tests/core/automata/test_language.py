"""Languages of automata: emptiness, differences, products, against naive references."""

import random
from dataclasses import replace

import numpy as np
import pytest

from jaxltl.core.automata.automaton import ACCEPTANCES, accepts_lasso, complement, make_automaton
from jaxltl.core.automata.language import (
    difference,
    find_accepted,
    find_difference,
    find_not_included,
    intersection,
    is_empty,
    is_equivalent,
    is_included,
    is_universal,
    union,
)
from jaxltl.core.automata.runs import align, live_states, universal_states
from tests.reference_logic import random_lasso, subsets, words

EVEN, ODD = 0, 1


# --- random automata and the naive reference ------------------------------------------------


def bits(names):
    """All letters over the names, by binary number."""
    return np.array(
        [[bool(number >> p & 1) for p in range(len(names))] for number in range(2 ** len(names))]
    )


def random_automaton(rng, acceptance, states=4, names=("a", "b"), rows=None, density=0.3):
    """A random automaton; the acceptance is sparse, so that verdicts differ."""
    rows = bits(names) if rows is None else np.asarray(rows, bool)
    width = len(rows)
    delta = np.array([[rng.randrange(states) for _ in range(width)] for _ in range(states)])
    given = {}
    if acceptance in ("cosafe", "safety"):
        absorbing = np.array([rng.random() < density for _ in range(states)])
        inside = np.flatnonzero(absorbing)
        delta[absorbing] = inside[delta[absorbing] % len(inside)] if len(inside) else 0
        final = absorbing if acceptance == "cosafe" else ~absorbing
        given = {"final": final, "acceptance": acceptance}
    elif acceptance == "buchi":
        density = rng.choice([density / 3, 0.9])
        hits = [[rng.random() < density for _ in range(width)] for _ in range(states)]
        given = {"accepting": hits}
    else:
        kinds = rng.choice([[0, 1, 2, 3], [1, 2], [1, 2, 4, 7], [3, 1], [6]])
        given = {"priority": [[rng.choice(kinds) for _ in range(width)] for _ in range(states)]}
    return make_automaton(delta, rng.randrange(states), rows, names, **given)


def random_automata(seed, count, **options):
    rng = random.Random(seed)
    for i in range(count):
        states = rng.randint(1, 5)
        yield random_automaton(rng, ACCEPTANCES[i % 4], **{"states": states, **options})


def random_pairs(seed, count, **options):
    rng = random.Random(seed)
    for _ in range(count):
        yield tuple(
            random_automaton(rng, rng.choice(ACCEPTANCES), rng.randint(1, 4), **options)
            for _ in range(2)
        )


def edges_of(*automata):
    """Every joint transition: source, end, and the priority that each automaton reads."""
    found = []
    tables = [(x.delta.tolist(), x.priority.tolist()) for x in automata]
    nodes = [()]
    for x in automata:
        nodes = [(*node, q) for node in nodes for q in range(len(x.delta))]
    for node in nodes:
        for letter in range(automata[0].delta.shape[1]):
            joint = list(zip(node, tables, strict=True))
            end = tuple(delta[q][letter] for q, (delta, _) in joint)
            found.append((node, end, tuple(priority[q][letter] for q, (_, priority) in joint)))
    return found


def after(edges, start):
    """The nodes on paths of at least one transition."""
    reached, queue = set(), [start]
    for node in queue:
        for end in {end for source, end, _ in edges if source == node} - reached:
            reached.add(end)
            queue.append(end)
    return reached


def nodes_of_good_cycles(edges, wanted):
    """Nodes on a cycle set whose least priorities have the wanted parities, by removal.

    A transition whose priority is the least of its strong component and has a wrong parity is
    on no good cycle; without any such, the whole component is good.
    """
    reach = {source: after(edges, source) for source, _, _ in edges}
    cyclic = [e for e in edges if e[0] in reach.get(e[1], ()) or e[0] == e[1]]
    good = set()
    left = {source for source, _, _ in cyclic}
    while left:
        node = left.pop()
        component = {m for m in reach[node] if node in reach.get(m, ())} | {node}
        left -= component
        inner = [e for e in cyclic if e[0] in component and e[1] in component]
        least = [min(values) for values in zip(*(e[2] for e in inner), strict=True)]
        wrong = [k for k, parity in enumerate(wanted) if least[k] % 2 != parity]
        if not wrong:
            good |= component
            continue
        rest = [e for e in inner if all(e[2][k] != least[k] for k in wrong)]
        good |= nodes_of_good_cycles(rest, wanted)
    return good


def may(automata, wanted):
    """The joint states from which some word gives the wanted parities."""
    edges = edges_of(*automata)
    good = nodes_of_good_cycles(edges, wanted)
    return {node for node in {e[0] for e in edges} if (after(edges, node) | {node}) & good}


def start(*automata):
    return tuple(int(x.initial) for x in automata)


def small_lassos(letters, prefix, cycle):
    return [(u, v) for u in words(letters, 0, prefix) for v in words(letters, 1, cycle)]


# --- the reference itself ---------------------------------------------------------------------


def test_the_reference_agrees_with_words():
    """On one letter a run is one word, so the reference can be checked by reading it."""
    seen = set()
    for automaton in random_automata(1, 80, names=(), rows=[[]]):
        for q in range(len(automaton.delta)):
            accepted = accepts_lasso(replace(automaton, initial=q), [], [set()])
            assert ((q,) in may([automaton], (EVEN,))) == accepted
            seen.add(accepted)
    assert seen == {True, False}


# --- emptiness --------------------------------------------------------------------------------


def test_emptiness_and_universality_against_the_reference():
    seen = set()
    for automaton in random_automata(2, 240):
        live, rejecting = may([automaton], (EVEN,)), may([automaton], (ODD,))
        states = [(q,) for q in range(len(automaton.delta))]
        assert live_states(automaton).tolist() == [q in live for q in states]
        assert universal_states(automaton).tolist() == [q not in rejecting for q in states]
        assert is_empty(automaton) == (start(automaton) not in live)
        assert is_universal(automaton) == (start(automaton) not in rejecting)
        assert live_states(automaton).dtype == universal_states(automaton).dtype == bool
        seen.add((automaton.acceptance, is_empty(automaton), is_universal(automaton)))
    for acceptance in ACCEPTANCES:
        assert {(acceptance, True, False), (acceptance, False, False)} <= seen, acceptance
        assert (acceptance, False, True) in seen, acceptance


def test_found_words_are_accepted_and_none_is_missed():
    empty = 0
    for automaton in random_automata(3, 160, names=("a",)):
        lasso = find_accepted(automaton)
        assert (lasso is None) == is_empty(automaton)
        if lasso is None:
            empty += 1
            tried = small_lassos(subsets(["a"]), 3, 4)
            assert not any(accepts_lasso(automaton, *word) for word in tried)
            continue
        assert accepts_lasso(automaton, *lasso)
        prefix, cycle = lasso
        assert isinstance(prefix, list) and all(isinstance(x, frozenset) for x in cycle)
        assert not prefix or prefix[-1] != cycle[-1], "the prefix could be shorter"
        for period in range(1, len(cycle)):
            assert cycle != cycle[:period] * (len(cycle) // period), "the cycle could be"
    assert 20 < empty < 140


def test_found_words_are_short():
    """A ring that must be left at its far end, and a loop that needs two marks."""
    size = 7
    delta = [[(q + 1) % size, q] for q in range(size)]
    only_last = [[1, 2 if q == size - 1 else 3] for q in range(size)]
    ring = make_automaton(delta, 0, [[False], [True]], ["a"], priority=only_last)
    assert find_accepted(ring) == ([frozenset()] * (size - 1), [frozenset({"a"})])
    even_step = [[0 if q == 2 else 1, 1] for q in range(size)]
    turning = make_automaton(delta, 0, [[False], [True]], ["a"], priority=even_step)
    assert find_accepted(turning) == ([], [frozenset()])
    far = [[1 if q == 5 else 2, 2] for q in range(size)]
    both = find_not_included(
        turning, make_automaton(delta, 0, [[False], [True]], ["a"], priority=far)
    )
    assert both == ([], [frozenset()])


@pytest.mark.parametrize(("near", "far"), [(0, 2), (2, 0)])
def test_the_nearest_of_several_loops_is_found(near, far):
    """Two loops of different even priorities: b soon, a only after three steps."""
    delta = [[1, 1, 1, 1], [2, 2, 1, 2], [3, 3, 3, 3], [3, 3, 3, 3]]
    priority = [[5] * 4, [5, 5, near, 5], [5] * 4, [5, far, 5, 5]]
    automaton = make_automaton(delta, 0, bits("ab"), ["a", "b"], priority=priority)
    prefix, cycle = find_accepted(automaton)
    assert len(prefix) == 1 and cycle == [frozenset({"b"})]


def test_many_priorities_need_the_right_threshold():
    """Every state loops on its own priority; only a cycle without the odd ones is accepted."""
    delta, priority = [[1, 0], [0, 1]], [[3, 4], [5, 7]]
    automaton = make_automaton(delta, 1, [[False], [True]], ["a"], priority=priority)
    assert find_accepted(automaton) == ([frozenset()], [frozenset({"a"})])
    odd = make_automaton(delta, 1, [[False], [True]], ["a"], priority=[[3, 5], [4, 7]])
    assert find_accepted(odd) is None and live_states(odd).tolist() == [False, False]


# --- two automata -----------------------------------------------------------------------------


def test_inclusion_and_difference_against_the_reference():
    seen = set()
    for a, b in random_pairs(4, 150, names=("a",)):
        here = start(a, b)
        outside, inside = here in may([a, b], (EVEN, ODD)), here in may([a, b], (ODD, EVEN))
        assert is_included(a, b) == (not outside) and is_included(b, a) == (not inside)
        assert is_equivalent(a, b) == (not outside and not inside)
        one_way, either = find_not_included(a, b), find_difference(a, b)
        assert (one_way is not None) == outside
        assert (either is not None) == (outside or inside)
        if one_way is not None:
            assert accepts_lasso(a, *one_way) and not accepts_lasso(b, *one_way)
        if either is not None:
            assert accepts_lasso(a, *either) != accepts_lasso(b, *either)
        seen.add((outside, inside))
    assert len(seen) == 4


def test_equal_languages_in_different_clothes():
    rng = random.Random(5)
    for automaton in random_automata(6, 40):
        count = len(automaton.delta)
        order = np.array(rng.sample(range(count), count))
        place = np.argsort(order)
        other = replace(
            automaton,
            delta=place[automaton.delta[order]],
            priority=automaton.priority[order] + 2,
            initial=place[int(automaton.initial)],
            acceptance="parity",
        )
        assert is_equivalent(automaton, other) and find_difference(automaton, other) is None
        assert not is_equivalent(automaton, complement(other))


def test_large_products():
    """Counters modulo 47 and 53: both say that a holds infinitely often."""

    def counter(size):
        delta = [[q, (q + 1) % size] for q in range(size)]
        wraps = [[False, q == size - 1] for q in range(size)]
        return make_automaton(delta, 0, [[False], [True]], ["a"], accepting=wraps)

    a, b = counter(47), counter(53)
    assert is_equivalent(a, b) and is_included(a, b)
    rejects = make_automaton(b.delta, 0, b.letters, ["a"], priority=1 - b.priority)
    assert find_difference(a, rejects) == ([], [frozenset()])
    assert not is_empty(intersection(a, b))
    table = np.random.default_rng(0).integers(900, size=(2, 900, 2))
    priority = 1 + 2 * (table % 3)
    big, other = (
        make_automaton(delta, 0, a.letters, ["a"], priority=values)
        for delta, values in zip(table, priority, strict=True)
    )
    assert is_equivalent(big, other) and is_empty(big)


# --- alignment --------------------------------------------------------------------------------


def letter_sets(automaton):
    return [
        frozenset(n for n, holds in zip(automaton.propositions, row, strict=True) if holds)
        for row in automaton.letters
    ]


def random_letters(rng, names):
    rows = bits(names)
    kept = rng.sample(range(len(rows)), rng.randint(1, len(rows)))
    return rows[kept]


def test_alignment_keeps_what_both_read():
    rng = random.Random(7)
    aligned = 0
    for i in range(120):
        names_a = tuple(rng.sample("abc", rng.randint(1, 3)))
        names_b = tuple(rng.sample("bcd", rng.randint(1, 3)))
        rows = [random_letters(rng, names) if i % 3 else None for names in (names_a, names_b)]
        a = random_automaton(rng, rng.choice(ACCEPTANCES), 3, names_a, rows[0])
        b = random_automaton(rng, rng.choice(ACCEPTANCES), 3, names_b, rows[1])
        shared = set(names_a) & set(names_b)
        joint = {x | y for x in letter_sets(a) for y in letter_sets(b) if x & shared == y & shared}
        if not joint:
            with pytest.raises(ValueError, match="no letter of one automaton agrees"):
                align(a, b)
            continue
        aligned += 1
        left, right = align(a, b)
        assert left.propositions == right.propositions == tuple(sorted({*names_a, *names_b}))
        assert np.array_equal(left.letters, right.letters)
        assert set(letter_sets(left)) == joint and len(left.letters) == len(joint)
        number = (left.letters * 2 ** np.arange(left.letters.shape[1])).sum(axis=1)
        assert (np.diff(number) > 0).all()
        for _ in range(10):
            lasso = random_lasso(rng, sorted(joint, key=sorted))
            assert accepts_lasso(left, *lasso) == accepts_lasso(a, *lasso)
            assert accepts_lasso(right, *lasso) == accepts_lasso(b, *lasso)
    assert 60 < aligned < 120


def test_alignment_of_automata_without_propositions():
    rng = random.Random(8)
    a = random_automaton(rng, "parity", 3, names=(), rows=[[]])
    left, right = align(a, a)
    assert np.array_equal(left.delta, a.delta) and right.letters.shape == (1, 0)


def test_too_many_or_no_joint_letters():
    def constant(names):
        rows = bits(names)
        return make_automaton(np.zeros((1, len(rows)), int), 0, rows, names, accepting=[True])

    a, b = constant([f"a{i}" for i in range(6)]), constant([f"b{i}" for i in range(7)])
    with pytest.raises(ValueError, match=r"8192 joint letters; the limit is 4096. .*letters="):
        align(a, b)
    assert align(a, constant([f"b{i}" for i in range(6)]))[0].letters.shape == (4096, 12)
    only = [make_automaton([[0]], 0, [[value]], ["a"], accepting=[True]) for value in (False, True)]
    for operation in (
        intersection,
        union,
        difference,
        is_included,
        is_equivalent,
        find_difference,
        find_not_included,
    ):
        with pytest.raises(ValueError, match="Build both with the same letters="):
            operation(*only)


def test_too_many_priorities():
    one = make_automaton(
        [[(q + 1) % 40] for q in range(40)],
        0,
        [[True]],
        ["a"],
        priority=list(range(40)),
    )
    with pytest.raises(ValueError, match=r"78 priorities .* the limit is 62"):
        union(one, one)


# --- operations -------------------------------------------------------------------------------


def test_operations_on_words():
    rng = random.Random(9)
    letters = subsets(["a", "b"])
    seen = set()
    for a, b in random_pairs(10, 60):
        both, either, only = intersection(a, b), union(a, b), difference(a, b)
        for _ in range(25):
            lasso = random_lasso(rng, letters)
            in_a, in_b = accepts_lasso(a, *lasso), accepts_lasso(b, *lasso)
            assert accepts_lasso(both, *lasso) == (in_a and in_b)
            assert accepts_lasso(either, *lasso) == (in_a or in_b)
            assert accepts_lasso(only, *lasso) == (in_a and not in_b)
            seen.add((a.acceptance, b.acceptance, in_a, in_b))
    assert len(seen) > 45


def test_laws():
    for a, b in random_pairs(11, 12):
        assert is_empty(intersection(a, complement(a)))
        assert is_universal(union(a, complement(a)))
        assert is_equivalent(complement(complement(a)), a)
        neither = intersection(complement(a), complement(b))
        assert is_equivalent(complement(union(a, b)), neither)
        assert is_equivalent(difference(a, b), intersection(a, complement(b)))
        assert is_included(intersection(a, b), a) and is_included(b, union(a, b))
        assert is_included(a, b) == is_empty(difference(a, b))
        assert is_equivalent(a, b) == (is_included(a, b) and is_included(b, a))
        assert is_equivalent(intersection(a, b), intersection(b, a))


def test_operations_over_different_propositions():
    rng = random.Random(12)
    for _ in range(20):
        a = random_automaton(rng, rng.choice(ACCEPTANCES), 3, ("a", "b"))
        b = random_automaton(rng, rng.choice(ACCEPTANCES), 3, ("c", "b"))
        both = intersection(a, b)
        assert both.propositions == ("a", "b", "c")
        for _ in range(10):
            lasso = random_lasso(rng, subsets(["a", "b", "c"]))
            expected = accepts_lasso(a, *lasso) and accepts_lasso(b, *lasso)
            assert accepts_lasso(both, *lasso) == expected


def test_results_have_the_simplest_acceptance_and_names():
    rows, names = [[False], [True]], ["a"]
    reach = make_automaton(
        [[0, 1], [1, 1]],
        0,
        rows,
        names,
        final=[False, True],
        acceptance="cosafe",
        state_names=["F a", "true"],
    )
    stay = make_automaton(
        [[1, 0], [1, 1]],
        0,
        rows,
        names,
        final=[True, False],
        acceptance="safety",
        state_names=["G a", "false"],
    )
    assert union(reach, reach).acceptance == "cosafe"
    assert intersection(stay, stay).acceptance == "safety"
    assert union(reach, reach).state_names[0] == "(F a) | (F a)"
    assert difference(reach, stay).state_names[0] == "(F a) & (!(G a))"
    nameless = replace(stay, state_names=())
    assert union(reach, nameless).state_names == ()


def test_nothing_is_changed():
    for a, b in random_pairs(13, 8):
        before = [np.array(x) for c in (a, b) for x in (c.delta, c.priority, c.letters)]
        union(a, b), find_difference(a, b), live_states(a)
        after_all = [x for c in (a, b) for x in (c.delta, c.priority, c.letters)]
        assert all(map(np.array_equal, before, after_all))
