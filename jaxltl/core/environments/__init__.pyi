from .environment import (
    Box as Box,
    Environment as Environment,
    Finite as Finite,
    Timestep as Timestep,
    make_box as make_box,
    make_environment as make_environment,
)
from .episodes import (
    Agent as Agent,
    Episode as Episode,
    agent_of as agent_of,
    run_episode as run_episode,
    step_or_reset as step_or_reset,
)
from .finite_task import (
    FiniteTask as FiniteTask,
    Shares as Shares,
    finite_shares as finite_shares,
    make_finite_task as make_finite_task,
)
from .monitor import (
    Monitor as Monitor,
    Verdict as Verdict,
    make_monitor as make_monitor,
    monitor_step as monitor_step,
    monitor_verdict as monitor_verdict,
    trace_verdicts as trace_verdicts,
    verdict as verdict,
)
from .sequence_task import (
    SequenceSampler as SequenceSampler,
    events_of as events_of,
    proposition_sets as proposition_sets,
    sequence_environment as sequence_environment,
    sequence_sampler as sequence_sampler,
)
from .simulated_model import environment_of as environment_of
from .tabulate import Table as Table, tabulate as tabulate
from .task_environment import (
    TaskObservation as TaskObservation,
    TaskTables as TaskTables,
    TaskWorld as TaskWorld,
    stack_tasks as stack_tasks,
    task_environment as task_environment,
    what_is_left as what_is_left,
)
from .time_limit import with_time_limit as with_time_limit
