"""The search for a required probability ends, with bounded work, and attains it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import jaxltl as jl
from benchmarks.required_probability import cases, write
from jaxltl.algos.common.seeds import Training
from jaxltl.algos.mlirl import guaranteed
from jaxltl.app import learn as job
from jaxltl.core.values.undiscounted import mixture
from jaxltl.core.values.undiscounted.optimum import policy_reachability
from tests.support import seeds


def check_case(case, place, monkeypatch):
    runs, evaluations = [], []

    def counted(function, record):
        def call(*arguments):
            record.append(function)
            return function(*arguments)

        return call

    with monkeypatch.context() as patch:
        settings, evaluate = guaranteed._Settings, guaranteed.likelihood_and_policy
        patch.setattr(settings, "train", counted(settings.train, runs))
        patch.setattr(guaranteed, "likelihood_and_policy", counted(evaluate, evaluations))
        setup = job.prepare(job.FILE.read(write(case, case.probability, place)), 0)
        outcome = job.learn(setup, Training(0, 1))
    assert len(runs) <= 2 and len(evaluations) <= guaranteed._EVALUATIONS
    assert outcome.kept.attempt.attained >= case.probability
    lower = mixture.at_starts(setup.model, outcome.kept.solution.lower, "mean")[0]
    assert lower >= case.probability
    return outcome


def test_where_no_reward_attains_a_probability_none_is_searched(tmp_path):
    """A patrol: a softmax policy enters the river at some time."""
    patrol = next(x for x in cases(8) if str(x.text["formula"]).startswith("G"))
    setup = job.prepare(job.FILE.read(write(patrol, patrol.probability, tmp_path)), 0)
    available = np.asarray(setup.model.available)
    uniform = available / available.sum(-1, keepdims=True)
    best = np.eye(available.shape[-1])[np.asarray(setup.guarantee.best.policy)]
    free = SimpleNamespace(policy=uniform[None])
    demands = replace(setup.demands, in_world=True, bound=None)  # without counts
    found = guaranteed.most_likely(demands, free, best, free, lambda: pytest.fail("searched"))
    assert found.share == 1 and found.attained >= patrol.probability


@pytest.mark.parametrize("number", seeds(0, 3, 50))
def test_the_search_ends_on_random_maps(number, tmp_path, monkeypatch):
    check_case(cases(number + 1)[number], tmp_path, monkeypatch)


def corridor(length, back):
    """A chain that returns to its start with probability `back` in each state, and may be lost."""
    successor = [[[0, i + 1, length + 1]] for i in range(length)] + [[[length] * 3]]
    successor += [[[length + 1] * 3]]
    probability = [[[back, 1 - back - 1e-3, 1e-3]]] * length + [[[1, 0, 0]]] * 2
    return jl.make_mdp(successor, probability)


@pytest.mark.slow
def test_evaluation_ends_for_policies_that_hardly_ever_end():
    """Krylov steps do not converge here; elimination follows after a bounded number of them."""
    length = 520
    world = corridor(length, 0.2)
    target = np.arange(length + 2) == length
    policy = np.ones((length + 2, 1))
    found = policy_reachability(world, policy, target, None, 10**9, method="auto")
    assert int(found.num_steps) <= 8 * (length + 2) + 64
    exact = jl.reachability_probability(world, target, policy=policy)
    np.testing.assert_allclose(found.value, exact.value, atol=1e-12)


def test_mixtures_take_few_evaluations(monkeypatch):
    successor = [[[0, i + 1, 4], [i + 1] * 3] for i in range(3)] + [[[i] * 3] * 2 for i in (3, 4)]
    probability = [[[0.2, 0.799, 0.001], [1, 0, 0]]] * 3 + [[[1, 0, 0]] * 2] * 2
    world = jl.make_mdp(
        successor,
        probability,
        label=(np.arange(5) == 3)[:, None],
        propositions=["g"],
        initial=[1, 0, 0, 0, 0],
    )
    model = jl.product(world, "F g")
    policy, sure = (np.broadcast_to(x, (*model.state_shape, 2)) for x in ([1.0, 0], [0, 1.0]))
    asked, attained = [], mixture.attained

    def counted(*arguments):
        asked.append(arguments)
        return attained(*arguments)

    monkeypatch.setattr(mixture, "attained", counted)
    for required in (0.996, 0.999, 1 - 1e-7):
        asked.clear()
        found = mixture.probable_mixture(model, policy, sure, required, "mean")
        assert len(asked) <= 12
        assert required <= found.attained <= required + (1 - required) / 64
