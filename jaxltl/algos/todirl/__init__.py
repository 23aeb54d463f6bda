"""Task-oriented deep inverse reinforcement learning."""

from jaxltl.algos.todirl.learner import (
    Metrics as Metrics,
    Objective as Objective,
    State as State,
    init as init,
    objective as objective,
    policy as policy,
    run as run,
    run_until as run_until,
    solve as solve,
    step as step,
    train as train,
    train_until as train_until,
)
from jaxltl.algos.todirl.learner import plan as plan, reward as reward
from jaxltl.algos.todirl.problem import (
    Concatenated as Concatenated,
    Hparams as Hparams,
    Problem as Problem,
    RewardNetwork as RewardNetwork,
    make_problem as make_problem,
)
