"""R-max in the almost-sure winning region of a stochastic game."""

from jaxltl.algos.rmax.evidence import (
    DataEvidence as DataEvidence,
    Evidence as Evidence,
    data_evidence as data_evidence,
    evidence as evidence,
    wins_almost_surely as wins_almost_surely,
)
from jaxltl.algos.rmax.learner import (
    init as init,
    measure as measure,
    observe as observe,
    policy as policy,
    run as run,
    run_until as run_until,
    step as step,
    strategy_is_stable as strategy_is_stable,
    train as train,
    train_until as train_until,
)
from jaxltl.algos.rmax.problem import (
    UPDATES as UPDATES,
    Hparams as Hparams,
    Metrics as Metrics,
    Problem as Problem,
    State as State,
    make_problem as make_problem,
)
