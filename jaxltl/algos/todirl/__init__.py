"""Task-oriented deep inverse reinforcement learning: rewards that transfer to new worlds."""

from jaxltl.algos.todirl.learner import (
    Concatenated as Concatenated,
    Hparams as Hparams,
    Metrics as Metrics,
    Problem as Problem,
    RewardNetwork as RewardNetwork,
    State as State,
    TodirlObjective as TodirlObjective,
    init as init,
    make_problem as make_problem,
    objective as objective,
    plan as plan,
    policy as policy,
    reward as reward,
    run as run,
    run_until as run_until,
    solve as solve,
    step as step,
    train as train,
    train_until as train_until,
)
from jaxltl.algos.todirl.transfer import (
    TransferredReward as TransferredReward,
    train_in_worlds as train_in_worlds,
)
from jaxltl.algos.todirl.worlds import (
    WorldDemands as WorldDemands,
    Worlds as Worlds,
    make_demands as make_demands,
    make_worlds as make_worlds,
)
