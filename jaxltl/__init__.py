"""jaxltl: policies known to do their task.

State a task by a temporal-logic formula, demonstrations, a reward, or a mix; learn in the
product of the world and the task's automaton; get every answer with its evidence.
"""

from jaxltl.core.automaton import Automaton, complement, make_automaton
from jaxltl.core.bellman import (
    boltzmann_fixed_points,
    boltzmann_value,
    optimal_value,
    policy_value,
    soft_value,
)
from jaxltl.core.game import Game, make_game
from jaxltl.core.game_value import minimax_value, strategy_value
from jaxltl.core.graph import (
    almost_surely_reaching,
    attractor,
    avoidable,
    end_components,
)
from jaxltl.core.language import find_difference, is_equivalent
from jaxltl.core.ltl import Formula, holds_on_lasso, parse_ltl
from jaxltl.core.mdp import MDP, DenseMDP, from_dense, make_mdp, to_dense
from jaxltl.core.mean_payoff import mean_payoff
from jaxltl.core.monitor import Monitor, Verdict, make_monitor, monitor_step, verdict
from jaxltl.core.objective import (
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
from jaxltl.core.occupancy import feature_expectation, occupancy_measure
from jaxltl.core.operators import (
    exists_successor,
    expectation,
    forall_successor,
    pushforward,
    sample_successor,
)
from jaxltl.core.permissive import Permissive, apply_strategy, permissive_strategy, shield
from jaxltl.core.product import (
    FiniteMemoryPolicy,
    Product,
    letters,
    lift_policy,
    lift_trajectories,
    product,
    project_policy,
    restrict,
)
from jaxltl.core.reachability import (
    optimal_satisfaction,
    reachability_probability,
    satisfaction_probability,
)
from jaxltl.core.rollout import Trajectories, make_trajectories, rollout
from jaxltl.core.stack import lift_memory, stack_products, synchronize
from jaxltl.core.task_performance import task_performance, task_performances
from jaxltl.core.translate import to_automaton
from jaxltl.core.types import NotConverged, Solution, Status, check
from jaxltl.core.verify import Verification, verify
from jaxltl.core.winning import Winning, almost_sure_buchi, winning_region
from jaxltl.envs.gridworld import gridworld
from jaxltl.envs.robots import grid_game
from jaxltl.io.hoa import read_hoa, write_hoa

__version__ = "0.1.0"

__all__ = [
    "GR1",
    "MDP",
    "Automaton",
    "DenseMDP",
    "FiniteMemoryPolicy",
    "Formula",
    "Game",
    "Monitor",
    "NotConverged",
    "Parity",
    "Permissive",
    "Product",
    "Solution",
    "Status",
    "Trajectories",
    "Verdict",
    "Verification",
    "Winning",
    "almost_sure_buchi",
    "almost_surely_reaching",
    "apply_strategy",
    "attractor",
    "avoidable",
    "boltzmann_fixed_points",
    "boltzmann_value",
    "buchi",
    "check",
    "cobuchi",
    "complement",
    "end_components",
    "exists_successor",
    "expectation",
    "feature_expectation",
    "find_difference",
    "forall_successor",
    "from_dense",
    "generalized_buchi",
    "gr1",
    "grid_game",
    "gridworld",
    "holds_on_lasso",
    "is_equivalent",
    "letters",
    "lift_memory",
    "lift_policy",
    "lift_trajectories",
    "make_automaton",
    "make_game",
    "make_mdp",
    "make_monitor",
    "make_trajectories",
    "mean_payoff",
    "minimax_value",
    "monitor_step",
    "occupancy_measure",
    "optimal_satisfaction",
    "optimal_value",
    "parity",
    "parse_ltl",
    "permissive_strategy",
    "policy_value",
    "product",
    "project_policy",
    "pushforward",
    "reach",
    "reachability_probability",
    "read_hoa",
    "restrict",
    "rollout",
    "safety",
    "sample_successor",
    "satisfaction_probability",
    "shield",
    "soft_value",
    "stack_products",
    "states_where",
    "strategy_value",
    "synchronize",
    "task_performance",
    "task_performances",
    "to_automaton",
    "to_dense",
    "verdict",
    "verify",
    "winning_region",
    "write_hoa",
]
