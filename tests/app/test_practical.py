"""Learned policies take at most the asked multiple of the least expected number of steps."""

import json
import re
from collections import deque
from itertools import pairwise

import numpy as np
import pytest

from jaxltl.algos.common.guarantees import neg_log_likelihood, step_bound
from jaxltl.algos.common.seeds import Training
from jaxltl.algos.mlirl import guaranteed
from jaxltl.app import learn as job
from jaxltl.app.learn import report as learn_report
from jaxltl.app.reports import steps as report
from jaxltl.core.values.undiscounted.mixture import at_starts
from jaxltl.core.values.undiscounted.optimal_actions import optimal_actions
from jaxltl.core.values.undiscounted.satisfaction import satisfaction_probability
from jaxltl.core.values.undiscounted.satisfaction_steps import satisfaction_steps
from tests.support import counts

MOVES = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}
HARBOUR = """
s . o . .
. . . . b
a . o . .
"""
FORMULA = "F(a & X F b) & (!o U b)"
TASK = """
[world]
map = '''{map}'''
slip = 0.1
initial = "s"
[task]
formula = "{formula}"
{task}
[demonstrations]
file = "shown.json"
[learner]
method = "mlirl"
discount = 0.9
avoid = ["o"]
"""


def route(cells, start, goals, rng, detours):
    """A demonstration on a map: shortest ways that avoid `o`, and steps back and forth."""
    rows, columns = len(cells), len(cells[0])

    def free(place):
        r, c = place
        return 0 <= r < rows and 0 <= c < columns and cells[r][c] not in "#o"

    def way(first, kind):
        queue, back = deque([first]), {first: None}
        while queue:
            here = queue.popleft()
            if cells[here[0]][here[1]] == kind:
                found = []
                while back[here]:
                    here, name = back[here]
                    found.append(name)
                return found[::-1]
            for name, (dr, dc) in MOVES.items():
                after = here[0] + dr, here[1] + dc
                if free(after) and after not in back:
                    back[after] = here, name
                    queue.append(after)
        return None

    here, actions, places = start, [], [start]
    for kind in goals:
        found = way(here, kind)
        if found is None:
            return None
        for name in found:
            dr, dc = MOVES[name]
            ahead = here[0] + dr, here[1] + dc
            opposite = next(n for n, x in MOVES.items() if x == (-dr, -dc))
            again = [name, opposite] * int(rng.random() < detours)
            for each in [*again, name]:
                dr, dc = MOVES[each]
                here = here[0] + dr, here[1] + dc
                actions.append(each)
                places.append(here)
            assert here == ahead
    return {"cells": [[r + 1, c + 1] for r, c in places], "actions": actions}


def write(folder, text, formula, goals, task="", seed=0, detours=0.3):
    """A task file with one demonstration; None if some goal cannot be reached."""
    cells = [line.split() for line in text.strip().splitlines()]
    start = next((r, c) for r, row in enumerate(cells) for c, x in enumerate(row) if x == "s")
    shown = route(cells, start, goals, np.random.default_rng(seed), detours)
    if shown is None:
        return None
    (folder / "shown.json").write_text(json.dumps({"demonstrations": [shown]}))
    path = folder / "task.toml"
    path.write_text(TASK.format(map=text, formula=formula, task=task))
    return path


def learned(path):
    setup = job.prepare(job.FILE.read(path), 0)
    outcome = job.learn(setup, Training(0, 1))
    return outcome, job.summary(outcome)


def drawn(path, rng, scale):
    """As `learned`, with a random policy of optimal actions in place of learning."""

    def train(settings, problem, *_):
        demands, model = settings.demands, settings.demands.model
        logits = scale * rng.standard_normal((*model.state_shape, model.num_actions))
        weight = np.exp(logits) * np.asarray(demands.guarantee.actions.allowed)
        policy = weight / weight.sum(-1, keepdims=True)
        loss = np.array([neg_log_likelihood(policy, np.asarray(problem.counts))])
        zero, names = np.zeros(1), demands.features.names
        return guaranteed.LearnedPolicies(
            policy=policy[None],
            weights=np.zeros((1, len(names))),
            names=names,
            loss=loss,
            neg_log_likelihood=loss,
            gradient_norm=zero,
            status=zero.astype(int),
            num_steps=zero.astype(int),
            converged=zero == 0,
            history={},
        )

    with pytest.MonkeyPatch.context() as patch:  # compiling a learner takes several seconds
        patch.setattr(guaranteed._Settings, "train", train)
        return learned(path)


def check(outcome, result, factor):
    """The bound holds for the kept policy, and the probability is the best one."""
    time = result["expected_steps"]
    model, policy = outcome.setup.model, outcome.kept.policy
    steps = satisfaction_steps(model, policy)
    assert [steps.lower, steps.upper] == pytest.approx(time["learned_bounds"], rel=1e-9)
    assert steps.upper <= factor * time["quickest_bounds"][1]
    learned, best = result["satisfaction"]["mean"], result["best_achievable"]["mean"]
    assert learned["lower"] >= best["upper"] - 1e-6
    return time


@pytest.fixture(scope="module")
def harbour(tmp_path_factory):
    path = write(
        tmp_path_factory.mktemp("harbour"), HARBOUR, FORMULA, "ab", "steps_factor = 1.1", 1, 0.6
    )
    return path, *drawn(path, np.random.default_rng(0), 1.0)


def test_a_slow_policy_is_mixed_with_the_quickest_optimal_one(harbour):
    check_mixture(*harbour[1:])


@pytest.mark.slow
def test_a_learned_policy_is_mixed_with_the_quickest_optimal_one(harbour):
    check_mixture(*learned(harbour[0]))


def check_mixture(outcome, result):
    time = check(outcome, result, 1.1)
    before = time["likelihood"][0]
    assert before["share"] == 0 and before["steps"]["value"] > 1.1 * time["quickest"]
    assert 0 < time["share"] < 1 and time["learned"] > 1.05 * time["quickest"]
    assert result["neg_log_likelihood"] == next(
        x["neg_log_likelihood"] for x in time["likelihood"] if x["share"] == time["share"]
    )
    steps = [x["steps"]["value"] for x in time["likelihood"]]
    assert steps == sorted(steps, reverse=True)
    front = time["front"]
    assert front[0]["steps"]["value"] == pytest.approx(time["quickest"])
    assert 1 < len(front) <= 10
    assert all(x["probability"]["value"] > y["probability"]["value"] for x, y in pairwise(front))


def test_the_report_has_both_numbers_and_what_relaxing_gives(harbour):
    _, _, result = harbour
    time = result["expected_steps"]
    text = learn_report.table(result)
    assert "at most 1.1 times those of the quickest optimal policy" in text
    for value in (time["learned"], time["quickest"], time["front"][1]["steps"]["value"]):
        assert f"{value:.4g}" in text
    assert "a share of" in text and "steps_factor in [task] sets the multiple" in text
    assert not any("suffice" in text for _, text in learn_report.remarks(result))
    (picture,) = report.pictures(time)
    assert picture.name == "steps.svg" and len(picture.drawing.arguments[0][""]) == 2


def test_the_bound_can_be_switched_off_or_changed(harbour, tmp_path):
    path, outcome, _ = harbour
    task = job.FILE.read(path)
    assert (task.steps, task.steps_factor) == (None, 1.1)
    for line, factor in (("", 2), ('steps_factor = "none"', None), ("steps_factor = 5", 5.0)):
        other = job.FILE.read(write(tmp_path, HARBOUR, "F a", "a", line))
        assert other.steps_factor == factor
    setup = outcome.setup
    bound = step_bound(setup.model, setup.guarantee.actions, "best")
    assert np.isinf(bound.limit)
    assert bound.keep(setup.model, outcome.kept.policy).share == 0


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("guarantee = { probability = 0.9 }", "a probability and a number of steps"),
        ("guarantee = { probability = 2, steps = 3 }", "a probability and a number of steps"),
        ("steps_factor = 0.5", 'a number of at least 1, or "none"'),
        ("steps_factor = 3\nguarantee = { probability = 0.9, steps = 3 }", "there is steps in"),
        ('steps_factor = 3\nguarantee = "none"', "there is none"),
        ("guarantee = { probability = 0.9, steps = 1 }", "in 1 steps no policy has more than 0;"),
        ("guarantee = { probability = 1, steps = 1 }", "takes .* steps; ask for at least so many"),
    ],
)
def test_mistakes_name_the_fix(tmp_path, line, message):
    path = write(tmp_path, HARBOUR, "F a & (!o U a)", "a", line)
    with pytest.raises(ValueError, match=message):
        job.prepare(job.FILE.read(path), 0)


def test_safety_formulas_have_no_steps(tmp_path):
    path = write(tmp_path, HARBOUR, "G !o", "a", "guarantee = { probability = 0.9, steps = 9 }")
    with pytest.raises(ValueError, match="leave steps out"):
        job.prepare(job.FILE.read(path), 0)
    path = write(tmp_path, HARBOUR, "G !o", "a")
    assert job.prepare(job.FILE.read(path), 0).bound is None


@pytest.mark.parametrize("probability", [0.3, 0.8])
def test_a_probability_and_fewer_steps_than_the_optimum_are_met_together(harbour, probability):
    _, outcome, _ = harbour
    setup, policy = outcome.setup, outcome.kept.policy
    model, actions = setup.model, setup.guarantee.actions or optimal_actions(setup.model)
    quickest = step_bound(model, actions, "best", factor=2).quickest.steps.value
    limit = quickest * (0.5 + probability / 2)
    bound = step_bound(model, actions, probability, steps=limit)
    kept = bound.keep(model, policy)
    assert kept.attained >= probability and kept.steps.upper <= limit < quickest
    assert satisfaction_steps(model, kept.policy).upper <= limit


@pytest.mark.slow
@pytest.mark.parametrize("line", ["0.7", "{ probability = 0.7, steps = 7.5 }"])
def test_a_probability_has_a_bound_on_steps_too(tmp_path, line):
    line = f"guarantee = {line}"
    path = write(tmp_path, HARBOUR, FORMULA, "ab", line, seed=1, detours=0.6)
    outcome, result = learned(path)
    time, asked = result["expected_steps"], result["guarantee"]
    policy = outcome.kept.policy
    found = satisfaction_probability(outcome.setup.model, policy)
    lower = at_starts(outcome.setup.model, found.lower, "mean")[0]
    assert asked["attained"] == pytest.approx(lower, abs=1e-9) and lower >= 0.7
    steps = satisfaction_steps(outcome.setup.model, policy)
    assert steps.upper <= (7.5 if "steps" in line else 2 * time["quickest_bounds"][1])
    assert time["limit"] == pytest.approx(7.5 if "steps" in line else 2 * time["quickest"])


def random_map(rng):
    shape = rng.integers(5, 8, 2)
    cells = rng.choice([".", "o", "#"], shape, p=[0.8, 0.12, 0.08])
    places = rng.permutation(cells.size)[:3]
    cells.flat[places] = list("sab")
    return "\n" + "\n".join(" ".join(row) for row in cells) + "\n"


def check_random_maps(folder, count, solve):
    """The bounds hold on random maps; returns how many policies are mixed."""
    rng, done, mixed = np.random.default_rng(0), 0, 0
    formulas = ("F(a & X F b) & (!o U b)", "F a & F b", "G F a & G F b & G !o", "F b & G F a")
    while done < count:
        formula = formulas[done % len(formulas)]
        goals = "ab" * (2 if "G F" in formula else 1)
        path = write(folder, random_map(rng), formula, goals, seed=done, detours=0.4)
        if path is None:
            continue
        try:
            outcome, result = solve(path)
        except ValueError as error:
            # Each step of the demonstration lowers the probability, or the formula is lost in advance.
            assert re.search(
                "none is left to learn from|] initial: no policy satisfies", str(error)
            )
            continue
        mixed += check(outcome, result, 2)["share"] > 0
        done += 1
    return mixed


@counts(3, 50, slow=12)
def test_random_maps(tmp_path, count):
    rng = np.random.default_rng(1)
    mixed = check_random_maps(tmp_path, count, lambda path: drawn(path, rng, 3.0))
    assert mixed >= count / 5


@pytest.mark.slow
def test_learning_on_random_maps(tmp_path):
    assert check_random_maps(tmp_path, 12, learned) >= 3
