"""What `jaxltl learn` computes: the policy that belongs to the weights that it keeps."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxltl.algos import mlirl
from jaxltl.algos.common.seeds import Training
from jaxltl.algos.mlirl import features, guaranteed
from jaxltl.app import learn
from jaxltl.app.files.task_irl import MlirlFile
from jaxltl.app.learn import report
from tests.app.test_task import write  # noqa: F401


@pytest.mark.slow
@pytest.mark.parametrize("optimizer", ["lbfgs", "adam", "lion"])
def test_the_policy_is_that_of_the_weights(write, optimizer):  # noqa: F811
    """Whether or not the last evaluation was at them, before the first step too."""
    setup = learn.prepare(MlirlFile.read(write()), 0)
    problem = setup.demands.problem
    hparams = mlirl.Hparams(discount=0.9, optimizer=optimizer)
    state = mlirl.init(jax.random.key(0), problem, hparams)
    for _ in range(2):
        host = jax.device_get(dataclasses.replace(state, key=None))
        policy, loss, status = guaranteed.policy_and_likelihood(host, problem, hparams)
        expected = mlirl.solve(state.parameters, problem, hparams)
        np.testing.assert_allclose(policy, expected.policy, atol=1e-9)
        counts = np.asarray(problem.counts)
        seen = counts > 0
        by_hand = -np.sum(counts[seen] * np.log(np.asarray(expected.policy)[seen]))
        np.testing.assert_allclose(loss, by_hand, rtol=1e-9)
        assert status == expected.status
        state, _ = mlirl.run(state, problem, hparams, num_steps=3)


def test_a_feature_that_is_left_out_is_named(write, monkeypatch):  # noqa: F811
    monkeypatch.setattr(features, "expected_steps", lambda *_: None)
    setup = learn.prepare(MlirlFile.read(write()), 0)
    assert "nearer" not in setup.demands.features.names
    outcome = learn.learn(setup, Training(0, 1))
    notes = [text for kind, text in report.remarks(learn.summary(outcome)) if kind == "note"]
    assert [text for text in notes if text.startswith("The feature nearer is left out")]
