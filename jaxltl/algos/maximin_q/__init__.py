"""Generalized and maximin Q-learning in two-player games."""

from jaxltl.algos.maximin_q.learner import (
    Hparams,
    Metrics,
    State,
    init,
    measure,
    policy,
    run,
    run_until,
    step,
    train,
    train_until,
    value,
    value_is_stable,
)
from jaxltl.algos.maximin_q.problem import Problem, make_problem, recurrent_states, with_exact_value

__all__ = [
    "Hparams",
    "Metrics",
    "Problem",
    "State",
    "init",
    "make_problem",
    "measure",
    "policy",
    "recurrent_states",
    "run",
    "run_until",
    "step",
    "train",
    "train_until",
    "value",
    "value_is_stable",
    "with_exact_value",
]
