"""`jaxltl learn` for a reward that carries over, with tasks without end and with probabilities."""

import json
import re

import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.algos.common.seeds import Training
from jaxltl.algos.todirl.transfer import world_performances
from jaxltl.algos.todirl.worlds import part_of
from jaxltl.app import learn_todirl as job
from jaxltl.app.files.task_irl import TodirlFile
from jaxltl.app.learn_todirl import report
from jaxltl.app.reports import steps
from jaxltl.app.reports.page import render_text
from jaxltl.core.values.undiscounted.mixture import WINDOW, at_starts
from jaxltl.core.values.undiscounted.performance import infeasible_starts
from jaxltl.core.values.undiscounted.satisfaction_steps import quickest_policy, satisfaction_steps
from jaxltl.io.learned_reward import load_reward, plan_in, save_reward
from tests.algos.test_guaranteed import evaluate
from tests.support import replaced
from tests.test_cli import run

TASK = '''
[world]
maps = ["""
. a .
. c .
. . b
"""]
legend = { "." = [], a = ["a"], b = ["b"], c = ["c"] }
initial = "!c"

[task]
formula = "G F a & G F b & G !c"

[demonstrations]
synthetic = 10
length = 12

[learner]
method = "todirl"
discount = 0.9
hidden = []
steps = 40
learning_rate = 0.1

[test]
maps = ["""
b # c
. # .
. . a
""", """
. b .
# # #
. a .
"""]
'''
FORMULA = 'formula = "G F a & G F b & G !c"'


@pytest.fixture
def write(tmp_path):
    """Writes a task, after replacing parts of it."""

    def write(*replacements, text=TASK):
        (tmp_path / "task.toml").write_text(replaced(text, *replacements))
        return tmp_path / "task.toml"

    return write


def prepared(path, seed=0):
    return job.prepare(TodirlFile.read(path), seed)


def own(setup, w):
    """The product of a world without padding."""
    return jl.product(setup.scenes[w].mdp, setup.worlds.automaton, label_on=setup.task.label_on)


# --- tasks without end -------------------------------------------------------------------------


@pytest.mark.slow
def test_a_task_without_end_is_learned_and_done_in_worlds_never_seen(write, tmp_path):
    path = write()
    result = run("learn", path, "--out", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.output
    assert (
        "warning: No policy can satisfy the formula from 6 of 6 initial states of the test world map 2"
        in (result.stdout)
    )
    found = json.loads(result.stdout.splitlines()[-1])
    assert (found["acceptance"], found["expert"]) == ("buchi", "quickest")
    assert found["demonstrations"]["number"] == [10] and found["demonstrations"]["dropped"] == 0
    assert found["test"]["infeasible"] == ["map 2"]
    worlds = found["training"]["worlds"] + found["test"]["worlds"]
    for world, possible in zip(worlds, (1, 1, 0), strict=True):
        assert world["minimum"]["lower"] == world["minimum"]["upper"] == possible
        assert world["expert"] == possible and world["random"] == 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "its policy is the quickest of those with maximal" in page
    runs = json.loads(re.search(r'id="data">(.*?)</script>', page)[1])[0]["runs"]
    assert max(len(played["steps"]) for played in runs) > 100  # on and on
    assert {"automaton.svg", "training_1.svg", "test_2.svg", "learning.svg"} <= {
        file.name for file in (tmp_path / "out").iterdir()
    }
    # What is in the file plans the same in a world that is given to it.
    learned, setup = load_reward(tmp_path / "out" / "network.npz"), prepared(path)
    for w in (0, 1):
        scene = setup.scenes[w]
        model, solution = plan_in(learned, scene.mdp, scene.observation)
        _, sure = evaluate(model, solution.policy)
        starts = np.flatnonzero(np.asarray(scene.mdp.initial) > 0)
        assert sure[starts, np.asarray(model.initial_memory)[starts]].all()


@pytest.mark.slow
def test_steps_are_within_a_multiple_of_the_least_in_every_world(write, tmp_path):
    few = ("steps = 40", "steps = 2"), ("[task]", "[task]\nsteps_factor = 1.1")
    setup = prepared(write(*few, ("\n[test]", '\n[test]\nleave_out = ["map 2"]')))
    outcome = job.learn(setup, Training(0, 1))
    assert (outcome.kept.quick_share[: setup.worlds.num_training] > 0).all()
    summary = job.summary(outcome)
    worlds = [x for kind in ("training", "test") for x in summary[kind]["expected_steps"]["worlds"]]
    policies = outcome.kept.policy
    for w, (world, policy) in enumerate(zip(worlds, policies, strict=True)):
        found = satisfaction_steps(part_of(setup.worlds.model, w), policy)
        assert world["quickest"] is not None or w == 2
        if w < 2:
            assert found.value == pytest.approx(world["steps"][0])
            assert found.upper <= 1.1 * world["quickest"] * (1 + 1e-6)
    save_reward(tmp_path / "network.npz", job.learned_reward(outcome))
    scene = setup.scenes[1]
    model, solution = plan_in(load_reward(tmp_path / "network.npz"), scene.mdp, scene.observation)
    quickest = quickest_policy(model).steps.upper
    assert satisfaction_steps(model, solution.policy).upper <= 1.1 * quickest


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("formula", "kind"),
    [
        ("G F a & G F b & G !c", "buchi"),
        ("F G !a | G F b", "parity"),
        ("G !c & !b", "safety"),
        ("!c U (a & (!c U b))", "cosafe"),
    ],
)
def test_the_expert_is_the_quickest_of_the_best_and_demonstrates(write, formula, kind):
    setup = prepared(write((FORMULA, f'formula = "{formula}"')), seed=3)
    assert setup.worlds.automaton.acceptance == kind and not setup.soft
    found = np.asarray(world_performances(setup.worlds.task_model, setup.expert, None).value)
    for w, scene in enumerate(setup.scenes):
        model, size = own(setup, w), scene.mdp.num_states
        best = jl.optimal_satisfaction(model)
        np.testing.assert_array_equal(setup.expert[w, :size], np.eye(4)[np.asarray(best.policy)])
        value, _ = evaluate(model, setup.expert[w, :size])
        memory = np.asarray(model.initial_memory)
        np.testing.assert_allclose(found[w, :size], value[np.arange(size), memory], atol=1e-12)
        starts = np.asarray(scene.mdp.initial) > 0
        never = np.asarray(infeasible_starts(part_of(setup.worlds.task_model, w)))
        np.testing.assert_array_equal(
            never[:size][starts], value[np.arange(size), memory][starts] == 0
        )
    (shown,) = setup.demands.demonstrations
    model = own(setup, 0)
    best = np.asarray(jl.optimal_satisfaction(model).policy)
    for states, actions, length in zip(
        *map(np.asarray, (shown.state, shown.action, shown.length)), strict=True
    ):
        q = int(model.initial_memory[states[0]])
        for s, a in zip(states[:length], actions[:length], strict=True):
            assert a == best[s, q]
            q = int(model.next_memory[s, q])
        assert length == 12 or kind == "cosafe"


def test_the_learner_is_given_what_the_task_is_not(write):
    """Judged by a task without end, whatever the learner remembers."""
    path = write(
        ("[task]", '[task]\nguarantee = "none"'),
        ("discount = 0.9", 'discount = 0.9\nmemory = "F a"'),
    )
    setup = prepared(path)
    policy = np.full((3, 9, len(setup.worlds.memory.delta), 4), 0.25)
    policy[:] = np.random.default_rng(0).dirichlet(np.ones(4), policy.shape[:-1])
    lifted = jl.core.models.lift_memory_policy(jnp.asarray(policy), setup.worlds.automaton)
    found = world_performances(setup.worlds.task_model, lifted, None)
    same = world_performances(setup.worlds.task_model, setup.expert, None)
    np.testing.assert_array_equal(same.mean, [1, 1, 0])
    for w in range(3):
        model = part_of(setup.worlds.task_model, w)
        value, _ = evaluate(model, lifted[w])
        np.testing.assert_allclose(
            found.value[w], value[np.arange(9), np.asarray(model.initial_memory)], atol=1e-12
        )


def test_a_horizon_is_for_tasks_that_are_decided_within_it(write):
    within = ("discount = 0.9", "discount = 0.9\nhorizon = 15")
    with pytest.raises(ValueError, match=r"\[learner\] horizon = 15 ends an episode .* has buchi"):
        prepared(write(within))
    assert (
        prepared(write(within, (FORMULA, 'formula = "G !c"'))).worlds.automaton.acceptance
        == "safety"
    )


# --- a probability -----------------------------------------------------------------------------

RISKY = '''
[world]
maps = ["""
. . a . .
. r r r .
. . . . .
s . r . b
"""]
legend = { "." = [], a = ["a"], b = ["b"], r = ["r"], s = ["s"] }
initial = "s"
slip = 0.1
absorbing = ["b"]

[task]
formula = "!r U b"
guarantee = 0.85

[demonstrations]
files = ["shown.json"]

[learner]
method = "todirl"
discount = 0.9
hidden = []
held_out = 0.0
steps = 60
learning_rate = 0.3

[test]
maps = ["""
s . . . .
. r . r .
. . . . b
. r . . .
""", """
s . . .
. . . b
""", """
s r b
"""]
leave_out = ["map 3"]
'''
CARELESS = {
    "demonstrations": [
        {
            "cells": [[4, 1], [3, 1], [3, 2], [3, 3], [3, 4], [3, 5]],
            "actions": ["up", "right", "right", "right", "right", "down"],
        },
        {
            "cells": [[4, 1], [4, 2], [3, 2], [3, 3], [3, 4], [4, 4]],
            "actions": ["right", "up", "right", "right", "down", "right"],
        },
    ]
}


def learned(path, seed=0):
    """The outcome of a task file, and its summary."""
    setup = prepared(path, seed)
    outcome = job.learn(setup, Training(seed, 1))
    return outcome, json.loads(json.dumps(job.summary(outcome)))


def check_reached(outcome, asked, over):
    """In every world that counts it has what was asked, and no more than the share gives it."""
    setup, mixed = outcome.setup, 0
    evaluation = outcome.kept
    for w in range(setup.worlds.num_training + 2):
        model = own(setup, w)
        policy = evaluation.policy[w][: model.mdp.num_states]
        np.testing.assert_allclose(policy.sum(-1), 1)
        value, _ = evaluate(model, policy)
        reached, _ = at_starts(model, value, over)
        assert evaluation.attained[w] == pytest.approx(reached, abs=1e-9)
        assert reached >= asked - 1e-12
        share = evaluation.share[w]
        assert share == 0 or asked <= evaluation.attained[w] <= asked + WINDOW
        mixed += share > 0
    return mixed


@pytest.mark.slow
def test_a_probability_is_reached_in_every_world(write, tmp_path):
    (tmp_path / "shown.json").write_text(json.dumps(CARELESS))
    outcome, result = learned(write(text=RISKY))
    assert check_reached(outcome, 0.85, "mean") > 0
    assert (
        outcome.kept.learned.weight > 0
        and result["guarantee"]["weight"] == outcome.kept.learned.weight
    )
    counted = result["training"]["worlds"] + result["test"]["worlds"][:2]
    (text,) = (text for kind, text in report.remarks(result) if kind == "good")
    least = min(world["attained"] for world in counted)
    assert text.startswith(
        "Asked for 0.8500 in every world, also in new ones, on average over initial states; certified "
        f"at least {least:.4f} here: "
    )
    assert result["test"]["worlds"][2]["share"] == 1  # where it cannot be had
    # What is written plans the same in worlds that it is given.
    save_reward(tmp_path / "network.npz", job.learned_reward(outcome))
    reward = load_reward(tmp_path / "network.npz")
    assert (reward.guarantee, reward.over) == (0.85, "mean")
    scene = outcome.setup.scenes[1]
    _, solution = plan_in(reward, scene.mdp, scene.observation)
    np.testing.assert_allclose(
        solution.policy,
        outcome.kept.policy[outcome.setup.worlds.num_training][: scene.mdp.num_states],
        atol=1e-6,
    )
    scene = outcome.setup.scenes[3]
    with pytest.raises(ValueError, match=r"guarantee = 0.85: the best .* is 0 .*least from state"):
        plan_in(reward, scene.mdp, scene.observation)


@pytest.mark.exhaustive
@pytest.mark.parametrize("asked", [0.5, 0.8, 0.86])
@pytest.mark.parametrize("over", ["mean", "worst"])
def test_probabilities_are_reached_from_the_worst_start_too(write, tmp_path, asked, over):
    (tmp_path / "shown.json").write_text(json.dumps(CARELESS))
    worst = '\nover = "worst"' if over == "worst" else ""
    outcome, _ = learned(write(("guarantee = 0.85", f"guarantee = {asked}{worst}"), text=RISKY))
    mixed = check_reached(outcome, asked, over)
    assert asked > 0.5 or (mixed, outcome.kept.learned.weight) == (0, 0)
    # Nothing that was learned with another weight makes the demonstrations likelier.
    setup = outcome.setup
    assert setup.demands.requested == asked


@pytest.mark.slow
def test_a_task_without_end_has_its_probability_by_moves_that_lose_nothing(write):
    """Any share of others would fail it in the end, and no weight changes that."""
    outcome, result = learned(
        write(
            ("[task]", "[task]\nguarantee = 0.7"), ("\n[test]", '\n[test]\nleave_out = ["map 2"]')
        )
    )
    assert outcome.kept.learned.weight == 0
    for world in result["training"]["worlds"] + result["test"]["worlds"][:1]:
        assert (world["share"], world["attained"]) == (1, 1)


@pytest.mark.slow
def test_what_no_policy_has_in_a_world_is_refused_with_what_is_possible(write, tmp_path):
    (tmp_path / "shown.json").write_text(json.dumps(CARELESS))
    best = jl.optimal_satisfaction(own(prepared(write(text=RISKY)), 2))
    assert float(jnp.sum(best.value[0])) > 0
    with pytest.raises(
        ValueError,
        match=(
            r"\[task\] in the test world map 3: guarantee = 0.85: the best that can be achieved is "
            r"0 on average .*least from row 1, column 1.*Or name it in \[test\] leave_out"
        ),
    ):
        prepared(write(('leave_out = ["map 3"]', ""), text=RISKY))
    narrow = (". . a . .", ". r a . .")
    with pytest.raises(ValueError, match=r"in the training world map 1: guarantee = 0.999: the be"):
        prepared(write(narrow, ("guarantee = 0.85", "guarantee = 0.999"), text=RISKY))
    sure = (("guarantee = 0.85", "guarantee = 1.0"), ("slip = 0.1", "slip = 0.0"))
    assert prepared(write(*sure, text=RISKY)).demands.requested == "best"


@pytest.mark.parametrize("asked", ['"best"', '"none"', "0.6"])
def test_steps_after_the_formula_is_lost_are_not_used(write, tmp_path, asked):
    """Around the first r and into the second, and on: only the steps until then count."""
    shown = {
        "cells": [[4, 1], [3, 1], [3, 2], [3, 3], [4, 3], [4, 4]],
        "actions": ["up", "right", "right", "down", "right", "right"],
    }
    (tmp_path / "shown.json").write_text(json.dumps({"demonstrations": [shown]}))
    changes = ("guarantee = 0.85", f"guarantee = {asked}"), ("slip = 0.1", "slip = 0.0")
    setup = prepared(write(*changes, text=RISKY))
    (used,) = setup.demands.demonstrations
    assert used.length.tolist() == [4] and setup.demands.unused == 2
    lost = {"guarantee": {"unused": {"steps": setup.demands.unused, "of": 6}}}
    (remark,) = render_text("unused_remark.txt", result=lost)
    assert remark.startswith("note: 2 of 6 demonstrated steps come after the formula was lost")


@pytest.mark.slow
def test_the_report_has_the_front_of_probability_and_steps(write):
    changes = (
        ('files = ["shown.json"]', "synthetic = 3\nlength = 3000"),  # optimal policies take long
        ("guarantee = 0.85", 'guarantee = "best"'),
    )
    setup = prepared(write(*changes, ("steps = 60", "steps = 1"), text=RISKY))
    outcome = job.learn(setup, Training(0, 1))
    time = job.summary(outcome)["training"]["expected_steps"]
    front = time["front"]
    assert front[0]["steps"]["value"] == pytest.approx(time["quickest"]) and len(front) > 1
    (line,) = steps.trade_off(time)
    assert f"{front[1]['probability']['value']:.4f} in " in line
    assert "steps.svg" in {section.name for section in job.sections(outcome)}
