"""The public names of the package, which :mod:`jaxltl` shows as its own, by topic."""

import importlib

from jaxltl.core.automata.automaton import (
    Automaton,
    accepts_lasso,
    complement,
    make_automaton,
)
from jaxltl.core.automata.language import find_difference, is_equivalent, is_included
from jaxltl.core.automata.sequences import Sequences, reach_avoid_sequences
from jaxltl.core.automata.synchronize import synchronize
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.environment import (
    Box,
    Environment,
    Finite,
    Timestep,
    make_box,
    make_environment,
)
from jaxltl.core.environments.episodes import Agent, Episode, agent_of, run_episode, step_or_reset
from jaxltl.core.environments.finite_task import FiniteTask, Shares, finite_shares, make_finite_task
from jaxltl.core.environments.monitor import (
    Monitor,
    Verdict,
    make_monitor,
    monitor_step,
    monitor_verdict,
    trace_verdicts,
    verdict,
)
from jaxltl.core.environments.sequence_task import (
    SequenceSampler,
    events_of,
    proposition_sets,
    sequence_environment,
    sequence_sampler,
)
from jaxltl.core.environments.simulated_model import environment_of
from jaxltl.core.environments.tabulate import Table, tabulate
from jaxltl.core.environments.task_environment import (
    TaskObservation,
    TaskTables,
    TaskWorld,
    stack_tasks,
    task_environment,
    what_is_left,
)
from jaxltl.core.environments.time_limit import with_time_limit
from jaxltl.core.games.objective import (
    GR1,
    Parity,
    buchi,
    cobuchi,
    generalized_buchi,
    gr1,
    parity,
    reach,
    safety,
    states_where,
)
from jaxltl.core.games.permissive import (
    Permissive,
    apply_strategy,
    permissive_strategy,
    shield_policy,
)
from jaxltl.core.games.shielded_environment import ShieldedWorld, shield_environment
from jaxltl.core.games.verify import Verification, verify
from jaxltl.core.games.winning import Winning, almost_sure_buchi, winning_region
from jaxltl.core.graphs.attractor import Attractor, almost_surely_reaching, attractor, avoidable
from jaxltl.core.graphs.end_components import EndComponents, end_components
from jaxltl.core.logic.ltl import Formula, holds_on_lasso, parse_ltl
from jaxltl.core.logic.properties import Property, parse_properties, parse_property
from jaxltl.core.models.build.batch import lift_memory, stack_products
from jaxltl.core.models.build.convert import to_padded, to_sparse
from jaxltl.core.models.build.counts import TransitionCounts, counted_model, counts_on, make_counts
from jaxltl.core.models.build.lifting import (
    FiniteMemoryPolicy,
    lift_policy,
    lift_trajectories,
    project_policy,
    project_trajectories,
)
from jaxltl.core.models.build.restrict import Restriction, restrict, with_allowed
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.interval import IntervalMDP, interval_rows, make_interval
from jaxltl.core.models.mdp import MDP, DenseMDP, from_dense, make_mdp, to_dense
from jaxltl.core.models.mesh.lanes import on_host, vmap_over_mesh
from jaxltl.core.models.mesh.shard import ModelPart, from_mesh, model_from_parts, shard, to_mesh
from jaxltl.core.models.mesh.sharded import ShardedMDP
from jaxltl.core.models.ops.operators import (
    exists_successor,
    expectation,
    forall_successor,
    pushforward,
    sample_successor,
)
from jaxltl.core.models.parametric.parametric import ParametricMDP, make_parametric
from jaxltl.core.models.product import Product, letters_of, product
from jaxltl.core.models.sparse import Rewards, SparseMDP, make_sparse, row_reward
from jaxltl.core.models.trajectories import Trajectories, make_trajectories, rollout
from jaxltl.core.pretty_print import picture
from jaxltl.core.statistics.confidence_sets import ConfidenceSets, intervals_from_counts
from jaxltl.core.types import Method, NotConverged, Solution, Status, check
from jaxltl.core.values.average.average_reward import average_reward
from jaxltl.core.values.average.mean_payoff import mean_payoff
from jaxltl.core.values.discounted.boltzmann import boltzmann_fixed_points, boltzmann_value
from jaxltl.core.values.discounted.discounted import optimal_value, policy_value
from jaxltl.core.values.discounted.minimax import minimax_value, strategy_value
from jaxltl.core.values.discounted.occupancy import feature_expectation, occupancy_measure
from jaxltl.core.values.discounted.soft import soft_value
from jaxltl.core.values.evaluation.data_guarantee import (
    DataGuarantee,
    guarantee_curve,
    learn_guarantee,
)
from jaxltl.core.values.evaluation.episode_scores import episode_evaluator
from jaxltl.core.values.evaluation.evaluation import EpisodeTotals, Estimate, Evaluation, evaluate
from jaxltl.core.values.evaluation.optimality_gap import (
    OptimalityGap,
    optimality_gap,
    tabulate_policy,
)
from jaxltl.core.values.interval.robust import (
    robust_discounted_value,
    robust_expectation,
    robust_reachability,
    robust_total_reward,
)
from jaxltl.core.values.interval.satisfaction import RobustSatisfaction, robust_satisfaction
from jaxltl.core.values.interval.sensitivity import Sensitivity, robust_sensitivity
from jaxltl.core.values.interval.step_bounded import (
    robust_bounded_reachability,
    robust_cumulative_reward,
    robust_instantaneous_reward,
    robust_next_probability,
)
from jaxltl.core.values.multi_objective.multi_objective import (
    Achievable,
    ConstrainedOptimum,
    Front,
    NearestMixture,
    Pareto,
    achievable,
    multi_objective,
    pareto,
)
from jaxltl.core.values.multi_objective.objectives import Objective
from jaxltl.core.values.prepared.prepared import Prepared, prepare, solve_prepared
from jaxltl.core.values.prepared.prepared_interval import (
    PreparedInterval,
    prepare_interval,
    solve_prepared_interval,
)
from jaxltl.core.values.properties.solve_property import Answer, PropertyStrategy, solve_property
from jaxltl.core.values.undiscounted.hitting_time import hitting_time
from jaxltl.core.values.undiscounted.optimal_actions import OptimalActions, optimal_actions
from jaxltl.core.values.undiscounted.performance import (
    Performance,
    task_performance,
    task_performances,
)
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.satisfaction import (
    optimal_satisfaction,
    satisfaction_probability,
)
from jaxltl.core.values.undiscounted.sparse_satisfaction import Satisfaction, sparse_satisfaction
from jaxltl.core.values.undiscounted.step_bounded import (
    bounded_reachability,
    cumulative_reward,
    instantaneous_reward,
    next_probability,
    reward_bounded_reachability,
)
from jaxltl.core.values.undiscounted.total_reward import total_reward
from jaxltl.envs.adapters.brax import from_brax
from jaxltl.envs.adapters.craftax import from_craftax
from jaxltl.envs.adapters.gymnax import from_gymnax
from jaxltl.envs.adapters.jumanji import from_jumanji
from jaxltl.envs.adapters.navix import from_navix
from jaxltl.envs.adapters.pgx import from_pgx
from jaxltl.envs.adapters.xminigrid import from_xminigrid
from jaxltl.envs.flat_world import flat_world
from jaxltl.envs.gridworld import gridworld
from jaxltl.envs.gymnasium_tables import from_gymnasium
from jaxltl.envs.letter_world import letter_world
from jaxltl.envs.robots import grid_game
from jaxltl.envs.zone_world import zone_world
from jaxltl.io.hoa import read_hoa, write_hoa
from jaxltl.io.hoa_game import HoaGame, read_hoa_game, write_hoa_game
from jaxltl.io.log import read_labels, read_log
from jaxltl.io.model_files import read_model, write_model
from jaxltl.io.parametric import ParametricModel, RationalFunction, read_parametric
from jaxltl.io.pgsolver import ParityGame, read_pgsolver, write_pgsolver
from jaxltl.io.reward_machine import RewardMachine, machine_reward, read_reward_machine
from jaxltl.io.storm import from_stormpy, to_stormpy
from jaxltl.io.umb_sharded import read_sharded


def _drawn(value: object) -> str | None:
    # Deferred, and replaced when it is imported: matplotlib is for those who look.
    importlib.import_module("jaxltl.plot.notebook")
    return picture(value)


for _kind in (
    Automaton,
    DenseMDP,
    Game,
    MDP,
    Permissive,
    Product,
    Solution,
    SparseMDP,
    Winning,
):
    picture.register(_kind, _drawn)


# In the order in which a user would read of them; a name is in one topic. `__all__` is all of them,
# written out for those who only read the text, such as editors.
TOPICS: dict[str, tuple[str, ...]] = {
    "Logic and automata": (
        "parse_ltl",
        "Formula",
        "holds_on_lasso",
        "to_automaton",
        "Automaton",
        "make_automaton",
        "accepts_lasso",
        "is_equivalent",
        "is_included",
        "find_difference",
        "complement",
        "synchronize",
        "make_monitor",
        "Monitor",
        "monitor_step",
        "monitor_verdict",
        "trace_verdicts",
        "verdict",
        "Verdict",
        "make_finite_task",
        "FiniteTask",
        "finite_shares",
        "Shares",
        "reach_avoid_sequences",
        "Sequences",
    ),
    "Models": (
        "gridworld",
        "make_mdp",
        "MDP",
        "from_dense",
        "DenseMDP",
        "to_dense",
        "make_sparse",
        "SparseMDP",
        "Rewards",
        "row_reward",
        "to_sparse",
        "to_padded",
        "make_trajectories",
        "Trajectories",
        "rollout",
        "with_allowed",
        "restrict",
        "Restriction",
        "states_where",
        "attractor",
        "Attractor",
        "avoidable",
        "almost_surely_reaching",
        "end_components",
        "EndComponents",
        "expectation",
        "exists_successor",
        "forall_successor",
        "pushforward",
        "sample_successor",
    ),
    "Interval and parametric models": (
        "make_interval",
        "interval_rows",
        "IntervalMDP",
        "robust_reachability",
        "robust_satisfaction",
        "RobustSatisfaction",
        "robust_total_reward",
        "robust_discounted_value",
        "robust_expectation",
        "robust_next_probability",
        "robust_bounded_reachability",
        "robust_cumulative_reward",
        "robust_instantaneous_reward",
        "robust_sensitivity",
        "Sensitivity",
        "make_parametric",
        "ParametricMDP",
    ),
    "Products and policies": (
        "product",
        "Product",
        "letters_of",
        "lift_policy",
        "project_policy",
        "FiniteMemoryPolicy",
        "lift_trajectories",
        "project_trajectories",
        "lift_memory",
        "stack_products",
    ),
    "Values": (
        "Solution",
        "Status",
        "check",
        "NotConverged",
        "Method",
        "policy_value",
        "optimal_value",
        "soft_value",
        "boltzmann_value",
        "boltzmann_fixed_points",
        "total_reward",
        "average_reward",
        "hitting_time",
        "occupancy_measure",
        "feature_expectation",
    ),
    "Probabilities": (
        "optimal_satisfaction",
        "satisfaction_probability",
        "optimal_actions",
        "OptimalActions",
        "reachability_probability",
        "sparse_satisfaction",
        "Satisfaction",
        "task_performance",
        "task_performances",
        "Performance",
        "prepare",
        "Prepared",
        "solve_prepared",
        "prepare_interval",
        "PreparedInterval",
        "solve_prepared_interval",
    ),
    "Properties": (
        "solve_property",
        "Answer",
        "PropertyStrategy",
        "parse_property",
        "parse_properties",
        "Property",
        "next_probability",
        "bounded_reachability",
        "reward_bounded_reachability",
        "cumulative_reward",
        "instantaneous_reward",
        "Objective",
        "multi_objective",
        "ConstrainedOptimum",
        "achievable",
        "Achievable",
        "pareto",
        "Pareto",
        "Front",
        "NearestMixture",
    ),
    "Games": (
        "make_game",
        "Game",
        "grid_game",
        "winning_region",
        "Winning",
        "verify",
        "Verification",
        "safety",
        "reach",
        "buchi",
        "cobuchi",
        "parity",
        "Parity",
        "generalized_buchi",
        "gr1",
        "GR1",
        "almost_sure_buchi",
        "permissive_strategy",
        "Permissive",
        "apply_strategy",
        "shield_policy",
        "minimax_value",
        "strategy_value",
        "mean_payoff",
    ),
    "Environments and tasks": (
        "make_environment",
        "Environment",
        "Timestep",
        "Finite",
        "Box",
        "make_box",
        "step_or_reset",
        "Agent",
        "agent_of",
        "run_episode",
        "Episode",
        "task_environment",
        "TaskWorld",
        "TaskObservation",
        "TaskTables",
        "stack_tasks",
        "what_is_left",
        "with_time_limit",
        "shield_environment",
        "ShieldedWorld",
        "environment_of",
        "tabulate",
        "Table",
        "sequence_environment",
        "sequence_sampler",
        "SequenceSampler",
        "events_of",
        "proposition_sets",
        "flat_world",
        "letter_world",
        "zone_world",
        "from_gymnax",
        "from_navix",
        "from_xminigrid",
        "from_jumanji",
        "from_brax",
        "from_craftax",
        "from_pgx",
    ),
    "Evidence": (
        "evaluate",
        "Evaluation",
        "Estimate",
        "EpisodeTotals",
        "episode_evaluator",
        "tabulate_policy",
        "optimality_gap",
        "OptimalityGap",
    ),
    "Data": (
        "read_log",
        "read_labels",
        "make_counts",
        "TransitionCounts",
        "counts_on",
        "counted_model",
        "intervals_from_counts",
        "ConfidenceSets",
        "learn_guarantee",
        "DataGuarantee",
        "guarantee_curve",
    ),
    "Devices": (
        "vmap_over_mesh",
        "on_host",
        "shard",
        "ShardedMDP",
        "to_mesh",
        "from_mesh",
        "ModelPart",
        "model_from_parts",
        "read_sharded",
    ),
    "Files": (
        "read_model",
        "write_model",
        "read_hoa",
        "write_hoa",
        "read_hoa_game",
        "write_hoa_game",
        "HoaGame",
        "read_pgsolver",
        "write_pgsolver",
        "ParityGame",
        "read_parametric",
        "ParametricModel",
        "RationalFunction",
        "read_reward_machine",
        "RewardMachine",
        "machine_reward",
        "from_gymnasium",
        "from_stormpy",
        "to_stormpy",
    ),
}

# Modules beside the top level, each with an `__all__` of its own.
NAMESPACES: dict[str, str] = {
    "jaxltl.algos": "Learners",
    "jaxltl.envs": "Worlds",
    "jaxltl.io": "Files of other tools, format by format",
    "jaxltl.plot": "Pictures",
}

__all__ = [  # noqa: RUF022
    "parse_ltl",
    "Formula",
    "holds_on_lasso",
    "to_automaton",
    "Automaton",
    "make_automaton",
    "accepts_lasso",
    "is_equivalent",
    "is_included",
    "find_difference",
    "complement",
    "synchronize",
    "make_monitor",
    "Monitor",
    "monitor_step",
    "monitor_verdict",
    "trace_verdicts",
    "verdict",
    "Verdict",
    "make_finite_task",
    "FiniteTask",
    "finite_shares",
    "Shares",
    "reach_avoid_sequences",
    "Sequences",
    "gridworld",
    "make_mdp",
    "MDP",
    "from_dense",
    "DenseMDP",
    "to_dense",
    "make_sparse",
    "SparseMDP",
    "Rewards",
    "row_reward",
    "to_sparse",
    "to_padded",
    "make_trajectories",
    "Trajectories",
    "rollout",
    "with_allowed",
    "restrict",
    "Restriction",
    "states_where",
    "attractor",
    "Attractor",
    "avoidable",
    "almost_surely_reaching",
    "end_components",
    "EndComponents",
    "expectation",
    "exists_successor",
    "forall_successor",
    "pushforward",
    "sample_successor",
    "make_interval",
    "interval_rows",
    "IntervalMDP",
    "robust_reachability",
    "robust_satisfaction",
    "RobustSatisfaction",
    "robust_total_reward",
    "robust_discounted_value",
    "robust_expectation",
    "robust_next_probability",
    "robust_bounded_reachability",
    "robust_cumulative_reward",
    "robust_instantaneous_reward",
    "robust_sensitivity",
    "Sensitivity",
    "make_parametric",
    "ParametricMDP",
    "product",
    "Product",
    "letters_of",
    "lift_policy",
    "project_policy",
    "FiniteMemoryPolicy",
    "lift_trajectories",
    "project_trajectories",
    "lift_memory",
    "stack_products",
    "Solution",
    "Status",
    "check",
    "NotConverged",
    "Method",
    "policy_value",
    "optimal_value",
    "soft_value",
    "boltzmann_value",
    "boltzmann_fixed_points",
    "total_reward",
    "average_reward",
    "hitting_time",
    "occupancy_measure",
    "feature_expectation",
    "optimal_satisfaction",
    "satisfaction_probability",
    "optimal_actions",
    "OptimalActions",
    "reachability_probability",
    "sparse_satisfaction",
    "Satisfaction",
    "task_performance",
    "task_performances",
    "Performance",
    "prepare",
    "Prepared",
    "solve_prepared",
    "prepare_interval",
    "PreparedInterval",
    "solve_prepared_interval",
    "solve_property",
    "Answer",
    "PropertyStrategy",
    "parse_property",
    "parse_properties",
    "Property",
    "next_probability",
    "bounded_reachability",
    "reward_bounded_reachability",
    "cumulative_reward",
    "instantaneous_reward",
    "Objective",
    "multi_objective",
    "ConstrainedOptimum",
    "achievable",
    "Achievable",
    "pareto",
    "Pareto",
    "Front",
    "NearestMixture",
    "make_game",
    "Game",
    "grid_game",
    "winning_region",
    "Winning",
    "verify",
    "Verification",
    "safety",
    "reach",
    "buchi",
    "cobuchi",
    "parity",
    "Parity",
    "generalized_buchi",
    "gr1",
    "GR1",
    "almost_sure_buchi",
    "permissive_strategy",
    "Permissive",
    "apply_strategy",
    "shield_policy",
    "minimax_value",
    "strategy_value",
    "mean_payoff",
    "make_environment",
    "Environment",
    "Timestep",
    "Finite",
    "Box",
    "make_box",
    "step_or_reset",
    "Agent",
    "agent_of",
    "run_episode",
    "Episode",
    "task_environment",
    "TaskWorld",
    "TaskObservation",
    "TaskTables",
    "stack_tasks",
    "what_is_left",
    "with_time_limit",
    "shield_environment",
    "ShieldedWorld",
    "environment_of",
    "tabulate",
    "Table",
    "sequence_environment",
    "sequence_sampler",
    "SequenceSampler",
    "events_of",
    "proposition_sets",
    "flat_world",
    "letter_world",
    "zone_world",
    "from_gymnax",
    "from_navix",
    "from_xminigrid",
    "from_jumanji",
    "from_brax",
    "from_craftax",
    "from_pgx",
    "evaluate",
    "Evaluation",
    "Estimate",
    "EpisodeTotals",
    "episode_evaluator",
    "tabulate_policy",
    "optimality_gap",
    "OptimalityGap",
    "read_log",
    "read_labels",
    "make_counts",
    "TransitionCounts",
    "counts_on",
    "counted_model",
    "intervals_from_counts",
    "ConfidenceSets",
    "learn_guarantee",
    "DataGuarantee",
    "guarantee_curve",
    "vmap_over_mesh",
    "on_host",
    "shard",
    "ShardedMDP",
    "to_mesh",
    "from_mesh",
    "ModelPart",
    "model_from_parts",
    "read_sharded",
    "read_model",
    "write_model",
    "read_hoa",
    "write_hoa",
    "read_hoa_game",
    "write_hoa_game",
    "HoaGame",
    "read_pgsolver",
    "write_pgsolver",
    "ParityGame",
    "read_parametric",
    "ParametricModel",
    "RationalFunction",
    "read_reward_machine",
    "RewardMachine",
    "machine_reward",
    "from_gymnasium",
    "from_stormpy",
    "to_stormpy",
]
