"""Emerson-Lei conditions and parity automata for them, against direct simulation."""

import random
from itertools import product

import numpy as np
import pytest

from jaxltl.core.automata import emerson_lei
from jaxltl.core.automata.emerson_lei import holds, parity_condition, strong_components, to_parity


def random_condition(rng, colors, size):
    if size <= 1:
        if rng.random() < 0.05:
            return (rng.choice(["true", "false"]),)
        return (rng.choice(["inf", "fin"]), rng.randrange(colors))
    left = rng.randint(1, size - 1)
    return (
        rng.choice(["and", "or"]),
        random_condition(rng, colors, left),
        random_condition(rng, colors, size - left),
    )


def random_tables(rng, states, width, marks):
    delta = np.array([[rng.randrange(states) for _ in range(width)] for _ in range(states)])
    return delta, np.array([[marks() for _ in range(width)] for _ in range(states)], np.int64)


def recurring(delta, marks, initial, prefix, cycle):
    """What the run on prefix·cycle^ω reads again and again."""
    state = initial
    for letter in prefix + cycle * len(delta):
        state = delta[state, letter]
    read = set()
    for letter in cycle * len(delta):
        read.add(int(marks[state, letter]))
        state = delta[state, letter]
    return read


def simulated(delta, colors, initial, condition, prefix, cycle):
    """Truth of the condition by the text of its definition, on sets of colors."""
    met = {
        c
        for mask in recurring(delta, colors, initial, prefix, cycle)
        for c in range(8)
        if mask >> c & 1
    }

    def true(f):
        match f[0]:
            case "true" | "false":
                return f[0] == "true"
            case "inf":
                return f[1] in met
            case "fin":
                return f[1] not in met
            case "and":
                return all(map(true, f[1:]))
        return any(map(true, f[1:]))

    return true(condition)


def lassos(rng, width, count):
    for _ in range(count):
        prefix = [rng.randrange(width) for _ in range(rng.randint(0, 4))]
        yield prefix, [rng.randrange(width) for _ in range(rng.randint(1, 6))]


def reachable(delta, initial):
    seen = {initial}
    for state in (queue := [initial]):
        for successor in delta[state].tolist():
            if successor not in seen:
                seen.add(successor)
                queue.append(successor)
    return seen


def test_holds_by_definition():
    rng = random.Random(0)
    for _ in range(300):
        condition = random_condition(rng, 4, rng.randint(1, 8))
        for mask in range(16):
            one_state = np.array([[0]]), np.array([[mask]])
            assert holds(condition, mask) == simulated(*one_state, 0, condition, [], [0])
    with pytest.raises(ValueError, match="unknown condition 'xor'"):
        holds(("xor", ("inf", 0)), 1)


def test_parity_condition():
    for count in range(7):
        for mask in range(1, 2**count):
            least = min(c for c in range(count) if mask >> c & 1)
            assert holds(parity_condition(count), mask) == (least % 2 == 0)


@pytest.mark.few(2)
@pytest.mark.parametrize("seed", range(4))
def test_parity_automaton_keeps_the_language(seed):
    rng = random.Random(seed)
    verdicts, grown, most = [], 0, 0
    for _ in range(120):
        states, width = rng.randint(1, 5), rng.randint(1, 3)
        colors = rng.randint(1, 4)
        condition = random_condition(rng, colors, rng.randint(1, 7))
        density = rng.choice([0.15, 0.5])
        delta, marks = random_tables(
            rng,
            states,
            width,
            lambda colors=colors, density=density: sum(
                (rng.random() < density) << c for c in range(colors)
            ),
        )
        initial = rng.randrange(states)
        new, priority, start, base = to_parity(delta, marks, initial, condition)
        assert start == 0 and base[0] == initial
        assert set(base.tolist()) == reachable(delta, initial)
        assert (base[new] == delta[base]).all(), "each new state follows an old one"
        assert reachable(new, 0) == set(range(len(new)))
        grown += len(new) > len(set(base.tolist()))
        most = max(most, int(priority.max()))
        for prefix, cycle in lassos(rng, width, 25):
            verdicts.append(simulated(delta, marks, initial, condition, prefix, cycle))
            least = min(recurring(new, priority, 0, prefix, cycle))
            assert (least % 2 == 0) == verdicts[-1], (delta, marks, condition, prefix, cycle)
    assert 0.2 < np.mean(verdicts) < 0.8 and grown and most >= 2


def test_transient_transitions_have_priority_one():
    rng = random.Random(5)
    seen = 0
    for _ in range(80):
        delta, marks = random_tables(rng, 5, 2, lambda: rng.randrange(4))
        new, priority, _, _ = to_parity(delta, marks, 0, random_condition(rng, 2, 3))
        component = strong_components(np.repeat(np.arange(len(new)), 2), new.ravel(), len(new))
        leaving = component[new] != component[:, None]
        assert (priority[leaving] == 1).all()
        seen += int(leaving.sum())
    assert seen > 40


def test_parity_input_keeps_its_states():
    rng = random.Random(6)
    for _ in range(150):
        states = rng.randint(1, 6)
        delta, priority = random_tables(rng, states, 2, lambda: rng.randrange(5))
        new, changed, _, base = to_parity(delta, 1 << priority, 0, parity_condition(5))
        assert sorted(base.tolist()) == sorted(reachable(delta, 0))
        assert (changed <= np.maximum(priority[base], 1)).all(), "no priority grows, but 0 to 1"
        assert new.shape == (len(base), 2)


@pytest.mark.parametrize("count", range(2, 7))
def test_generalised_buchi_on_one_state(count):
    """All n colors: n states, because each but the last visited waits in turn."""
    delta = np.zeros((1, 2**count), int)
    marks = np.arange(2**count)[None]
    condition = ("and", *(("inf", c) for c in range(count)))
    new, priority, _, base = to_parity(delta, marks, 0, condition)
    assert len(new) == count and set(priority.ravel()) == {0, 1} and not base.any()
    # The dual: some color only finitely often.
    dual = ("or", *(("fin", c) for c in range(count)))
    new, priority, _, _ = to_parity(delta, marks, 0, dual)
    assert len(new) == count and set(priority.ravel()) == {1, 2}


@pytest.mark.parametrize(
    ("condition", "states", "priorities"),
    [
        (("inf", 0), 1, {0, 1}),
        (("fin", 0), 1, {1, 2}),
        # One Rabin pair, one Streett pair: a parity chain of three.
        (("and", ("fin", 0), ("inf", 1)), 1, {1, 2, 3}),
        (("or", ("fin", 0), ("inf", 1)), 1, {0, 1, 2}),
        # A chain of pairs in which the conditions imply one another is parity as it stands.
        (("or", ("inf", 0), ("and", ("fin", 1), ("inf", 2))), 1, {0, 1, 2, 3}),
        (("true",), 1, {0}),
        (("false",), 1, {1}),
        (("and", ("inf", 0), ("fin", 0)), 1, {1}),
        (("or", ("inf", 0), ("fin", 0)), 1, {0}),
    ],
)
def test_small_conditions(condition, states, priorities):
    """One state that reads every set of three colors."""
    new, priority, _, _ = to_parity(np.zeros((1, 8), int), np.arange(8)[None], 0, condition)
    assert len(new) == states and set(priority.ravel().tolist()) == priorities


def leaves_by_definition(condition, colors, mask):
    """The leaves of the Zielonka tree below a set, which is the least memory on one state."""
    verdict = holds(condition, mask)
    other = [m for m in range(mask) if m & ~mask == 0 and m and holds(condition, m) != verdict]
    largest = [m for m in other if not any(m & ~n == 0 and m != n for n in other)]
    return sum(leaves_by_definition(condition, colors, m) for m in largest) or 1


@pytest.mark.parametrize("kind", ["rabin", "streett"])
@pytest.mark.parametrize("pairs", [1, 2, 3])
def test_rabin_and_streett(kind, pairs):
    """Against Zielonka trees drawn by the definition, which are of size n! for n pairs."""
    below, outer = ("and", "or") if kind == "rabin" else ("or", "and")
    condition = (outer, *((below, ("fin", 2 * i), ("inf", 2 * i + 1)) for i in range(pairs)))
    colors = 2 * pairs
    expected = leaves_by_definition(condition, colors, 2**colors - 1)
    new, priority, _, _ = to_parity(
        np.zeros((1, 2**colors - 1), int), np.arange(1, 2**colors)[None], 0, condition
    )
    assert len(new) == expected == {1: 1, 2: 2, 3: 6}[pairs]
    assert len(set(priority.ravel().tolist())) == 2 * pairs


def test_random_conditions_need_their_zielonka_leaves():
    rng = random.Random(7)
    sizes = set()
    for _ in range(150):
        condition = random_condition(rng, 4, rng.randint(1, 8))
        new, _, _, _ = to_parity(np.zeros((1, 15), int), np.arange(1, 16)[None], 0, condition)
        assert len(new) == leaves_by_definition(condition, 4, 15)
        sizes.add(len(new))
    assert len(sizes) >= 4


def test_twin_letters_are_copied():
    rng = random.Random(8)
    condition = ("and", ("inf", 0), ("inf", 1))
    delta, marks = random_tables(rng, 4, 3, lambda: rng.randrange(4))
    new, _, _, _ = to_parity(delta, marks, 0, condition)
    pick = [2, 0, 0, 1, 2, 1]
    wide, wide_priority, _, _ = to_parity(delta[:, pick], marks[:, pick], 0, condition)
    assert len(wide) == len(new)
    for first, second in product(range(6), repeat=2):
        if pick[first] == pick[second]:
            assert (wide[:, first] == wide[:, second]).all()
            assert (wide_priority[:, first] == wide_priority[:, second]).all()


def test_limits(monkeypatch):
    delta, marks = np.zeros((1, 32), int), np.arange(32)[None]
    condition = ("and", *(("inf", c) for c in range(5)))
    assert len(to_parity(delta, marks, 0, condition, max_states=5)[0]) == 5
    with pytest.raises(ValueError, match="more than 4 states"):
        to_parity(delta, marks, 0, condition, max_states=4)
    monkeypatch.setattr(emerson_lei, "MAX_SUBSETS", 3)
    with pytest.raises(ValueError, match="more than 3 sets of transitions"):
        to_parity(delta, marks, 0, condition)
