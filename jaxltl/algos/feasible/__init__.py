"""Feasible parameters of parametric Markov models by gradient ascent."""

from jaxltl.algos.feasible.learner import (
    Best as Best,
    Budget as Budget,
    Feasible as Feasible,
    Hparams as Hparams,
    Metrics as Metrics,
    State as State,
    evaluate as evaluate,
    feasible as feasible,
    init as init,
    policy as policy,
    run as run,
    run_until as run_until,
    start_at as start_at,
    step as step,
    train as train,
    train_until as train_until,
)
from jaxltl.algos.feasible.problem import (
    Problem as Problem,
    certify as certify,
    make_problem as make_problem,
    require_problem as require_problem,
    within as within,
)
