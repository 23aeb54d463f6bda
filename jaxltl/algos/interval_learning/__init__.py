"""Robust anytime learning of temporal-logic tasks in MDPs with unknown probabilities."""

from jaxltl.algos.interval_learning.learner import (
    behavior as behavior,
    bounds_within as bounds_within,
    guarantee as guarantee,
    init as init,
    measure as measure,
    policy as policy,
    run as run,
    run_until as run_until,
    step as step,
    train as train,
    train_until as train_until,
    wins_almost_surely as wins_almost_surely,
)
from jaxltl.algos.interval_learning.problem import (
    INTERVALS as INTERVALS,
    Hparams as Hparams,
    Metrics as Metrics,
    Problem as Problem,
    State as State,
    make_problem as make_problem,
)
