"""Each acceptance condition is translated, written, drawn, solved and rewarded."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.automata.automaton import CONDITIONS, accepts_lasso, complement, condition_of
from jaxltl.core.automata.language import is_equivalent
from jaxltl.core.automata.runs import verdicts
from jaxltl.core.automata.text import from_dict, to_dict, to_dot, to_text
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.task_reward import REWARDS, make_task_reward
from jaxltl.io.hoa.hoa import read_hoa, write_hoa

# A formula of each condition: a condition without one fails here.
FORMULAS = {"cosafe": "F a", "safety": "G a", "buchi": "G F a", "parity": "G F a | F G b"}
CYCLES = ([{"a"}, set()], [{"b"}, set()], [{"a", "b"}], [{"b"}], [set()])


def assert_same(one, other):
    assert one.acceptance == other.acceptance
    for name in ("delta", "initial", "priority", "letters"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.fixture(params=CONDITIONS)
def automaton(request):
    result = to_automaton(FORMULAS[request.param], letters=[set(), {"a"}, {"b"}, {"a", "b"}])
    assert result.acceptance == request.param
    return result


def test_tables_and_files_restore_an_automaton(automaton):
    assert_same(from_dict(to_dict(automaton)), automaton)
    text = write_hoa(automaton)
    assert_same(read_hoa(text), automaton)
    # By another tool the acceptance is that of the marks alone.
    foreign = read_hoa(text.replace('tool: "jaxltl"', 'tool: "other"'))
    np.testing.assert_array_equal(foreign.priority, automaton.priority)
    assert foreign.acceptance == condition_of(automaton.priority)


def test_complements_reject_and_come_back(automaton):
    other = complement(automaton)
    for cycle in CYCLES:
        word = [set(c) & set(automaton.propositions) for c in cycle]
        assert accepts_lasso(automaton, [], word) != accepts_lasso(other, [], word)
    assert_same(read_hoa(write_hoa(other)), other)
    assert is_equivalent(complement(other), automaton)


def test_pictures_mark_what_decides_acceptance(automaton):
    for text in (to_text(automaton), to_dot(automaton)):
        number = "{0}" in text or "{1}" in text
        assert number == automaton.is_parity
        assert automaton.is_parity or "*" in text or "●" in text or "doublecircle" in text
    figure = jl.plot.automaton(automaton, layout="matplotlib")
    note = "".join(text.get_text() for text in figure.findobj(plt.Text))
    assert automaton.has_final_states or "a word is accepted if" in note.replace("\n", " ")
    plt.close(figure)


# Sets are written in an order that changes from process to process: the names sort them.
@pytest.mark.parametrize("cycle", CYCLES, ids=lambda cycle: str([sorted(held) for held in cycle]))
def test_solvers_agree_with_the_only_run_of_a_cycle(automaton, cycle):
    size = len(cycle)
    names = automaton.propositions
    labels = {p: [i for i, held in enumerate(cycle) if p in held] for p in names}
    chain = jl.from_dense(
        np.roll(np.eye(size), 1, 1)[:, None], initial=np.eye(size)[0], label=labels
    )
    accepted = accepts_lasso(automaton, [], [held & set(names) for held in cycle])
    start = 0, int(automaton.initial)
    task = jl.product(chain, automaton, label_on="exit")
    assert float(jl.optimal_satisfaction(task).value[start]) == pytest.approx(float(accepted))
    assert bool(np.asarray(jl.winning_region(chain, automaton).region)[start]) == accepted


def test_the_default_reward_fits(automaton):
    name = CONDITIONS[automaton.acceptance].reward
    assert name in REWARDS
    assert make_task_reward(automaton, verdicts(automaton)).name == name
