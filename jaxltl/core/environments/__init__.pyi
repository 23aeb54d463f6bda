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
    auto_reset_step as auto_reset_step,
    make_agent as make_agent,
    run_episode as run_episode,
)
from .model_environment import model_environment as model_environment
from .monitor import (
    FiniteTask as FiniteTask,
    Monitor as Monitor,
    Verdict as Verdict,
    VerdictFrequencies as VerdictFrequencies,
    finite_verdict_frequencies as finite_verdict_frequencies,
    make_finite_task as make_finite_task,
    make_monitor as make_monitor,
    monitor_step as monitor_step,
    monitor_verdict as monitor_verdict,
    trace_verdicts as trace_verdicts,
    verdict as verdict,
)
from .sequence_task import (
    SequenceSampler as SequenceSampler,
    make_events as make_events,
    proposition_sets as proposition_sets,
    sequence_environment as sequence_environment,
    sequence_sampler as sequence_sampler,
)
from .tabulate import TabulatedEnvironment as TabulatedEnvironment, tabulate as tabulate
from .task_environment import (
    TaskObservation as TaskObservation,
    TaskTables as TaskTables,
    TaskWorld as TaskWorld,
    residual_formula as residual_formula,
    stack_tasks as stack_tasks,
    task_environment as task_environment,
)
from .episodes import with_time_limit as with_time_limit
