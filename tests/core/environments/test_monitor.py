"""Verdicts on finite traces, against what continuations show, and the compiled monitor."""

import random
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.automata.automaton import ACCEPTANCES, accepts_lasso, make_automaton, run
from jaxltl.core.environments.monitor import (
    Monitor,
    Verdict,
    make_monitor,
    monitor_step,
    monitor_verdict,
    trace_verdicts,
    verdict,
)
from jaxltl.core.models.mdp import from_dense
from jaxltl.core.models.product import product
from tests.core.automata.test_language import (
    EVEN,
    ODD,
    letter_sets,
    may,
    random_automata,
    random_automaton,
    small_lassos,
)

REACH = make_automaton(
    [[0, 1], [1, 1]], 0, [[False], [True]], ["a"], final=[False, True], acceptance="cosafe"
)
RECUR = make_automaton([[0, 0]], 0, [[False], [True]], ["a"], accepting=[[False, True]])


def expected(automaton):
    """The verdict in each state, by the naive reference."""
    accepting, rejecting = may([automaton], (EVEN,)), may([automaton], (ODD,))
    return [
        Verdict.SATISFIED
        if (q,) not in rejecting
        else Verdict.VIOLATED
        if (q,) not in accepting
        else Verdict.UNDECIDED
        for q in range(len(automaton.delta))
    ]


def random_trace(rng, automaton, length):
    return [rng.randrange(automaton.delta.shape[1]) for _ in range(length)]


def as_word(automaton, trace):
    said = letter_sets(automaton)
    return [said[letter] for letter in trace]


def test_verdicts_against_the_reference():
    rng = random.Random(20)
    seen = set()
    for automaton in random_automata(21, 160):
        table = expected(automaton)
        for _ in range(5):
            word = as_word(automaton, random_trace(rng, automaton, rng.randint(0, 5)))
            told = verdict(automaton, word)
            assert isinstance(told, Verdict) and told == table[run(automaton, word)[-1]]
            seen.add((automaton.acceptance, told))
    assert len(seen) == len(ACCEPTANCES) * len(Verdict)


def test_verdicts_are_what_continuations_agree_on():
    rng = random.Random(22)
    seen = set()
    for automaton in random_automata(23, 25, names=("a",)):
        word = as_word(automaton, random_trace(rng, automaton, rng.randint(0, 3)))
        told = verdict(automaton, word)
        seen.add(told)
        results = {
            accepts_lasso(automaton, [*word, *prefix], cycle)
            for prefix, cycle in small_lassos(letter_sets(automaton), 4, 5)
        }
        agreed = {Verdict.SATISFIED: {True}, Verdict.VIOLATED: {False}}
        assert results == agreed.get(told, {True, False})
    assert seen == set(Verdict)


def test_recurrence_is_never_decided():
    for word in ([], [{"a"}] * 5, [set()] * 5):
        assert verdict(RECUR, word) == Verdict.UNDECIDED


def test_a_decided_trace_stays_decided():
    rng = random.Random(24)
    decided = 0
    for automaton in random_automata(25, 60, states=4):
        monitor = make_monitor(automaton)
        told = np.asarray(trace_verdicts(monitor, random_trace(rng, automaton, 12)))
        for now, then in pairwise(told):
            assert now in (Verdict.UNDECIDED, then)
        decided += told[-1] != Verdict.UNDECIDED
    assert decided > 20


def test_the_monitor_agrees_with_the_host():
    rng = random.Random(26)
    seen = set()
    for automaton in random_automata(27, 24, states=4):
        monitor = make_monitor(automaton)
        traces = [random_trace(rng, automaton, 6) for _ in range(4)]
        told = trace_verdicts(monitor, jnp.array(traces))
        assert told.shape == (4, 7) and told.dtype == jnp.int32
        for trace, row in zip(traces, told.tolist(), strict=True):
            word = as_word(automaton, trace)
            assert row == [verdict(automaton, word[:t]) for t in range(7)]
            seen |= set(row)
    assert seen == set(Verdict)


def test_tables_and_steps_of_any_shape():
    automaton = random_automaton(random.Random(28), "parity", 5)
    monitor = make_monitor(automaton)
    assert [x.dtype for x in jax.tree.leaves(monitor)] == [jnp.int32] * 3
    assert monitor.delta.shape == (5, 4) and monitor.initial.shape == ()
    states, letters = np.arange(5)[:, None], np.arange(4)[None, :]
    assert np.array_equal(monitor_step(monitor, states, letters), automaton.delta)
    assert monitor_step(monitor, 2, 3) == automaton.delta[2, 3]
    assert monitor_verdict(monitor, np.zeros((2, 3, 1), int)).shape == (2, 3, 1)


def test_inside_scan_and_vmap():
    """Beside somebody else's loop, as an environment step would do it."""
    monitor = make_monitor(REACH)
    traces = jnp.array([[0, 0, 1], [0, 0, 0], [1, 0, 0]])

    @jax.jit
    def told(monitor, trace):
        def step(state, letter):
            state = monitor_step(monitor, state, letter)
            return state, monitor_verdict(monitor, state)

        return jax.lax.scan(step, monitor.initial, trace)[1]

    assert jax.vmap(told, (None, 0))(monitor, traces).tolist() == [[0, 0, 1], [0] * 3, [1] * 3]


def test_several_tasks_at_once():
    rng = random.Random(29)
    automata = [random_automaton(rng, acceptance, 4) for acceptance in ACCEPTANCES]
    monitors = [make_monitor(automaton) for automaton in automata]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *monitors)
    letters = jnp.array(random_trace(rng, automata[0], 8))
    told = jax.jit(jax.vmap(trace_verdicts, (0, None)))(stacked, letters)
    assert told.tolist() == [trace_verdicts(m, letters).tolist() for m in monitors]


def test_one_trace_of_one_shape():
    traced = []

    @jax.jit
    def told(monitor, letters, length):
        traced.append(letters.shape)
        return trace_verdicts(monitor, letters, length)

    other = Monitor(*(leaf + 0 for leaf in jax.tree.leaves(make_monitor(REACH))))
    for monitor in (make_monitor(REACH), other):
        for length in (0, 1, 3):
            told(monitor, jnp.array([0, 0, 1]), jnp.int32(length))
    assert traced == [(3,)]


@pytest.mark.parametrize("compiled", [False, True])
def test_padding_is_not_read(compiled):
    monitor = make_monitor(REACH)
    call = jax.jit(trace_verdicts) if compiled else trace_verdicts
    letters = jnp.array([[[0, 0, 1, 1], [0, 1, 99, -7]], [[1, 1, 1, 1], [0, 0, 0, 1]]])
    told = call(monitor, letters, jnp.array([[2, 2], [0, 4]]))
    assert told.tolist() == [[[0] * 5, [0, 0, 1, 1, 1]], [[0] * 5, [0, 0, 0, 0, 1]]]
    assert call(monitor, letters[0, 0], jnp.array(3)).tolist() == [0, 0, 0, 1, 1]


def test_empty_traces():
    monitor = make_monitor(REACH)
    assert trace_verdicts(monitor, []).tolist() == [0]
    assert trace_verdicts(monitor, jnp.zeros((3, 0), jnp.int32)).shape == (3, 1)


def test_letters_of_a_world():
    """A chain of three states, the last absorbing; only the middle one shows a."""
    world = from_dense(
        [[[0, 1.0, 0]], [[0, 0, 1.0]], [[0, 0, 1.0]]], label=[[0], [1], [0]], propositions=["a"]
    )
    model = product(world, REACH)
    monitor = make_monitor(model.automaton)
    assert trace_verdicts(monitor, model.letter[jnp.array([0, 1, 2])]).tolist() == [0, 0, 1, 1]


def test_a_truncated_trace_gets_no_guess_where_termination_decides():
    """`F a` without a so far: undecided when cut off, rejected when the last letter repeats."""
    trace = [set(), set()]
    assert verdict(REACH, trace) == Verdict.UNDECIDED
    assert not accepts_lasso(REACH, trace, [trace[-1]])


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (([0, 2],), ValueError, r"letters\[1\] = 2 is no letter. .* letters 0..1"),
        (([[0, 1], [-1, 0]],), ValueError, r"letters\[1, 0\] = -1 is no letter"),
        (([True, False],), TypeError, "letters has type bool. Pass integers"),
        (([0.0, 1.0],), TypeError, "letters has type float"),
        ((1,), ValueError, "letters is one number"),
        (([0, 1], 3), ValueError, r"length 3 with 2 letters. Pass one of 0..2"),
        (([0, 1], -1), ValueError, "length -1 with 2 letters"),
        (([0, 1], 1.0), TypeError, "length has type float"),
        (([0, 1], [1]), ValueError, r"length has shape \(1,\) for letters of shape \(2,\)"),
    ],
)
def test_bad_traces(arguments, error, message):
    with pytest.raises(error, match=message):
        trace_verdicts(make_monitor(REACH), *arguments)


def test_bad_letters():
    monitor = make_monitor(REACH)
    with pytest.raises(TypeError, match="monitor_step: letter has type bool"):
        monitor_step(monitor, 0, jnp.array([True]))
    only_a = make_automaton([[0]], 0, [[True]], ["a"], accepting=[True])
    with pytest.raises(ValueError, match=r"letter 1 is \{\}, which is not among the 1 letters"):
        verdict(only_a, [{"a"}, set()])
