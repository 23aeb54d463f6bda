"""Task-oriented deep inverse reinforcement learning."""

from jaxltl.algos.todirl.learner import (
    Metrics,
    Objective,
    State,
    init,
    objective,
    policy,
    run,
    run_until,
    solve,
    step,
    train,
    train_until,
)
from jaxltl.algos.todirl.networks import Concatenated, RewardNetwork
from jaxltl.algos.todirl.planning import plan, reward
from jaxltl.algos.todirl.problem import Hparams, Problem, make_problem

__all__ = [
    "Concatenated",
    "Hparams",
    "Metrics",
    "Objective",
    "Problem",
    "RewardNetwork",
    "State",
    "init",
    "make_problem",
    "objective",
    "plan",
    "policy",
    "reward",
    "run",
    "run_until",
    "solve",
    "step",
    "train",
    "train_until",
]
