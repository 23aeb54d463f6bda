"""Robust anytime learning of temporal-logic tasks in MDPs with unknown probabilities."""

from jaxltl.algos.interval_learning.learner import (
    behavior,
    bounds_within,
    guarantee,
    init,
    measure,
    policy,
    run,
    run_until,
    step,
    train,
    train_until,
    wins_almost_surely,
)
from jaxltl.algos.interval_learning.problem import Problem, make_problem
from jaxltl.algos.interval_learning.state import INTERVALS, Hparams, Metrics, State

__all__ = [
    "INTERVALS",
    "Hparams",
    "Metrics",
    "Problem",
    "State",
    "behavior",
    "bounds_within",
    "guarantee",
    "init",
    "make_problem",
    "measure",
    "policy",
    "run",
    "run_until",
    "step",
    "train",
    "train_until",
    "wins_almost_surely",
]
