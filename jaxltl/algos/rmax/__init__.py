"""R-max in the almost-sure winning region of a stochastic game."""

from jaxltl.algos.rmax.evidence import (
    DataEvidence,
    Evidence,
    data_evidence,
    evidence,
    wins_almost_surely,
)
from jaxltl.algos.rmax.learner import (
    init,
    measure,
    observe,
    policy,
    run,
    run_until,
    step,
    strategy_is_stable,
    train,
    train_until,
)
from jaxltl.algos.rmax.problem import Problem, make_problem
from jaxltl.algos.rmax.state import UPDATES, Hparams, Metrics, State

__all__ = [
    "UPDATES",
    "DataEvidence",
    "Evidence",
    "Hparams",
    "Metrics",
    "Problem",
    "State",
    "data_evidence",
    "evidence",
    "init",
    "make_problem",
    "measure",
    "observe",
    "policy",
    "run",
    "run_until",
    "step",
    "strategy_is_stable",
    "train",
    "train_until",
    "wins_almost_surely",
]
