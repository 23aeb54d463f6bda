"""Generalized and maximin Q-learning in two-player games."""

from jaxltl.algos.maximin_q.learner import (
    Hparams as Hparams,
    Metrics as Metrics,
    State as State,
    init as init,
    measure as measure,
    policy as policy,
    run as run,
    run_until as run_until,
    step as step,
    train as train,
    train_until as train_until,
    value as value,
    value_is_stable as value_is_stable,
)
from jaxltl.algos.maximin_q.problem import (
    Problem as Problem,
    make_problem as make_problem,
    recurrent_states as recurrent_states,
    with_exact_value as with_exact_value,
)
