"""Environments, tasks in environments, episodes, and statistical evaluation."""

from jaxltl.core.environments.environment import (
    Box as Box,
    Environment as Environment,
    Finite as Finite,
    Timestep as Timestep,
    make_box as make_box,
    make_environment as make_environment,
)
from jaxltl.core.environments.episodes import (
    Agent as Agent,
    Episode as Episode,
    agent_of as agent_of,
    run_episode as run_episode,
    step_or_reset as step_or_reset,
)
from jaxltl.core.environments.sequence_task import (
    SequenceSampler as SequenceSampler,
    events_of as events_of,
    proposition_sets as proposition_sets,
    sequence_environment as sequence_environment,
    sequence_sampler as sequence_sampler,
)
from jaxltl.core.environments.simulated_model import environment_of as environment_of
from jaxltl.core.environments.tabulate import Table as Table, tabulate as tabulate
from jaxltl.core.environments.task_environment import (
    TaskObservation as TaskObservation,
    TaskTables as TaskTables,
    TaskWorld as TaskWorld,
    stack_tasks as stack_tasks,
    task_environment as task_environment,
    what_is_left as what_is_left,
)
from jaxltl.core.environments.time_limit import with_time_limit as with_time_limit
from jaxltl.core.games.shielded_environment import (
    ShieldedWorld as ShieldedWorld,
    shield_environment as shield_environment,
)
from jaxltl.core.values.evaluation.episode_scores import episode_evaluator as episode_evaluator
from jaxltl.core.values.evaluation.evaluation import (
    EpisodeTotals as EpisodeTotals,
    Estimate as Estimate,
    Evaluation as Evaluation,
    evaluate as evaluate,
)
from jaxltl.core.values.evaluation.optimality_gap import (
    OptimalityGap as OptimalityGap,
    optimality_gap as optimality_gap,
    tabulate_policy as tabulate_policy,
)

__all__ = sorted(name for name in dir() if not name.startswith("_"))
