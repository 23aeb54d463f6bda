"""The public names of the package, which :mod:`jaxltl` shows as its own."""

from jaxltl.core.automata.automaton import Automaton, complement, make_automaton, picture
from jaxltl.core.automata.language import find_difference, is_equivalent
from jaxltl.core.automata.sequences import Sequences, reach_avoid_sequences
from jaxltl.core.automata.synchronize import synchronize
from jaxltl.core.automata.translate import to_automaton
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
from jaxltl.core.games.permissive import Permissive, apply_strategy, permissive_strategy, shield
from jaxltl.core.games.shielded_environment import ShieldedWorld, shielded
from jaxltl.core.games.verify import Verification, verify
from jaxltl.core.games.winning import Winning, almost_sure_buchi, winning_region
from jaxltl.core.graphs.attractor import almost_surely_reaching, attractor, avoidable
from jaxltl.core.graphs.end_components import end_components
from jaxltl.core.host.confidence import ConfidenceSets, intervals_from_counts
from jaxltl.core.logic.ltl import Formula, holds_on_lasso, parse_ltl
from jaxltl.core.models.batch import lift_memory, stack_products
from jaxltl.core.models.convert import to_padded, to_sparse
from jaxltl.core.models.counts import TransitionCounts, counted_model, counts_on, make_counts
from jaxltl.core.models.environment import (
    Agent,
    Box,
    Environment,
    Episode,
    Finite,
    Timestep,
    agent_of,
    box,
    make_environment,
    run_episode,
    step_or_reset,
)
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.interval import IntervalMDP, interval_rows, make_interval
from jaxltl.core.models.lanes import on_host, vmap_over_mesh
from jaxltl.core.models.mdp import MDP, DenseMDP, from_dense, make_mdp, to_dense
from jaxltl.core.models.monitor import Monitor, Verdict, make_monitor, monitor_step, verdict
from jaxltl.core.models.operators import (
    exists_successor,
    expectation,
    forall_successor,
    pushforward,
    sample_successor,
)
from jaxltl.core.models.parametric import ParametricMDP, make_parametric
from jaxltl.core.models.product import (
    FiniteMemoryPolicy,
    Product,
    letters,
    lift_policy,
    lift_trajectories,
    product,
    project_policy,
    project_trajectories,
)
from jaxltl.core.models.restrict import restrict, with_allowed
from jaxltl.core.models.sequence_task import (
    events_of,
    proposition_sets,
    sequence_environment,
    sequence_sampler,
)
from jaxltl.core.models.shard import ModelPart, from_mesh, model_from_parts, shard, to_mesh
from jaxltl.core.models.sharded import ShardedMDP
from jaxltl.core.models.simulated_model import environment_of
from jaxltl.core.models.sparse import Rewards, SparseMDP, make_sparse, row_reward
from jaxltl.core.models.tabulate import Table, tabulate
from jaxltl.core.models.task_environment import (
    TaskObservation,
    TaskWorld,
    stack_tasks,
    task_environment,
    what_is_left,
)
from jaxltl.core.models.time_limit import with_time_limit
from jaxltl.core.models.trajectories import Trajectories, make_trajectories, rollout
from jaxltl.core.types import NotConverged, Solution, Status, check
from jaxltl.core.values.answer import answer
from jaxltl.core.values.average_reward import average_reward
from jaxltl.core.values.boltzmann import boltzmann_fixed_points, boltzmann_value
from jaxltl.core.values.bounded import (
    bounded_reachability,
    cumulative_reward,
    instantaneous_reward,
    next_probability,
    reward_bounded_reachability,
)
from jaxltl.core.values.data_guarantee import DataGuarantee, guarantee_curve, learn_guarantee
from jaxltl.core.values.discounted import optimal_value, policy_value
from jaxltl.core.values.episode_scores import episode_evaluator
from jaxltl.core.values.evaluation import Estimate, Evaluation, evaluate
from jaxltl.core.values.mean_payoff import mean_payoff
from jaxltl.core.values.minimax import minimax_value, strategy_value
from jaxltl.core.values.multi_objective import achievable, multi, pareto
from jaxltl.core.values.objectives import Objective
from jaxltl.core.values.occupancy import feature_expectation, occupancy_measure
from jaxltl.core.values.optimal_actions import OptimalActions, optimal_actions
from jaxltl.core.values.optimality_gap import OptimalityGap, optimality_gap, tabulate_policy
from jaxltl.core.values.performance import task_performance, task_performances
from jaxltl.core.values.prepared import Prepared, prepare, solve_prepared
from jaxltl.core.values.prepared_interval import (
    PreparedInterval,
    prepare_interval,
    solve_interval,
)
from jaxltl.core.values.reachability import reachability_probability
from jaxltl.core.values.robust import robust_discounted_value, robust_expectation
from jaxltl.core.values.robust_bounded import (
    robust_bounded_reachability,
    robust_cumulative_reward,
    robust_instantaneous_reward,
    robust_next_probability,
)
from jaxltl.core.values.robust_satisfaction import robust_satisfaction
from jaxltl.core.values.robust_sensitivity import robust_sensitivity
from jaxltl.core.values.satisfaction import optimal_satisfaction, satisfaction_probability
from jaxltl.core.values.soft import soft_value
from jaxltl.core.values.sparse_satisfaction import sparse_satisfaction
from jaxltl.core.values.total_reward import total_reward
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
from jaxltl.io.log import read_labels, read_log
from jaxltl.io.model_files import read_model, write_model
from jaxltl.io.parametric import read_parametric
from jaxltl.io.reward_machine import machine_reward, read_reward_machine
from jaxltl.io.storm import from_stormpy, to_stormpy
from jaxltl.io.umb_sharded import read_sharded


@picture.register
def _(value: Automaton) -> str:
    # Deferred, and replaced when it is imported: matplotlib is for those who look.
    from jaxltl.plot.automata import as_svg

    return as_svg(value)


__all__ = [
    "GR1",
    "MDP",
    "Agent",
    "Automaton",
    "Box",
    "ConfidenceSets",
    "DataGuarantee",
    "DenseMDP",
    "Environment",
    "Episode",
    "Estimate",
    "Evaluation",
    "Finite",
    "FiniteMemoryPolicy",
    "Formula",
    "Game",
    "IntervalMDP",
    "ModelPart",
    "Monitor",
    "NotConverged",
    "Objective",
    "OptimalActions",
    "OptimalityGap",
    "ParametricMDP",
    "Parity",
    "Permissive",
    "Prepared",
    "PreparedInterval",
    "Product",
    "Rewards",
    "Sequences",
    "ShardedMDP",
    "ShieldedWorld",
    "Solution",
    "SparseMDP",
    "Status",
    "Table",
    "TaskObservation",
    "TaskWorld",
    "Timestep",
    "Trajectories",
    "TransitionCounts",
    "Verdict",
    "Verification",
    "Winning",
    "achievable",
    "agent_of",
    "almost_sure_buchi",
    "almost_surely_reaching",
    "answer",
    "apply_strategy",
    "attractor",
    "average_reward",
    "avoidable",
    "boltzmann_fixed_points",
    "boltzmann_value",
    "bounded_reachability",
    "box",
    "buchi",
    "check",
    "cobuchi",
    "complement",
    "counted_model",
    "counts_on",
    "cumulative_reward",
    "end_components",
    "environment_of",
    "episode_evaluator",
    "evaluate",
    "events_of",
    "exists_successor",
    "expectation",
    "feature_expectation",
    "find_difference",
    "flat_world",
    "forall_successor",
    "from_brax",
    "from_craftax",
    "from_dense",
    "from_gymnasium",
    "from_gymnax",
    "from_jumanji",
    "from_mesh",
    "from_navix",
    "from_pgx",
    "from_stormpy",
    "from_xminigrid",
    "generalized_buchi",
    "gr1",
    "grid_game",
    "gridworld",
    "guarantee_curve",
    "holds_on_lasso",
    "instantaneous_reward",
    "interval_rows",
    "intervals_from_counts",
    "is_equivalent",
    "learn_guarantee",
    "letter_world",
    "letters",
    "lift_memory",
    "lift_policy",
    "lift_trajectories",
    "machine_reward",
    "make_automaton",
    "make_counts",
    "make_environment",
    "make_game",
    "make_interval",
    "make_mdp",
    "make_monitor",
    "make_parametric",
    "make_sparse",
    "make_trajectories",
    "mean_payoff",
    "minimax_value",
    "model_from_parts",
    "monitor_step",
    "multi",
    "next_probability",
    "occupancy_measure",
    "on_host",
    "optimal_actions",
    "optimal_satisfaction",
    "optimal_value",
    "optimality_gap",
    "pareto",
    "parity",
    "parse_ltl",
    "permissive_strategy",
    "policy_value",
    "prepare",
    "prepare_interval",
    "product",
    "project_policy",
    "project_trajectories",
    "proposition_sets",
    "pushforward",
    "reach",
    "reach_avoid_sequences",
    "reachability_probability",
    "read_hoa",
    "read_labels",
    "read_log",
    "read_model",
    "read_parametric",
    "read_reward_machine",
    "read_sharded",
    "restrict",
    "reward_bounded_reachability",
    "robust_bounded_reachability",
    "robust_cumulative_reward",
    "robust_discounted_value",
    "robust_expectation",
    "robust_instantaneous_reward",
    "robust_next_probability",
    "robust_satisfaction",
    "robust_sensitivity",
    "rollout",
    "row_reward",
    "run_episode",
    "safety",
    "sample_successor",
    "satisfaction_probability",
    "sequence_environment",
    "sequence_sampler",
    "shard",
    "shield",
    "shielded",
    "soft_value",
    "solve_interval",
    "solve_prepared",
    "sparse_satisfaction",
    "stack_products",
    "stack_tasks",
    "states_where",
    "step_or_reset",
    "strategy_value",
    "synchronize",
    "tabulate",
    "tabulate_policy",
    "task_environment",
    "task_performance",
    "task_performances",
    "to_automaton",
    "to_dense",
    "to_mesh",
    "to_padded",
    "to_sparse",
    "to_stormpy",
    "total_reward",
    "verdict",
    "verify",
    "vmap_over_mesh",
    "what_is_left",
    "winning_region",
    "with_allowed",
    "with_time_limit",
    "write_hoa",
    "write_model",
    "zone_world",
]
