# The public names of the package, each imported on first use.
__version__: str

from . import algos as algos
from . import envs as envs
from . import io as io
from . import plot as plot
from .core import (
    automata as automata,
    continuous as continuous,
    enclosures as enclosures,
    environments as environments,
    games as games,
    graphs as graphs,
    logic as logic,
    models as models,
    statistics as statistics,
    values as values,
)
from .core.automata.automaton import Automaton as Automaton
from .core.automata.translate import to_automaton as to_automaton
from .core.enclosures.linear_bounds import enclose as enclose
from .core.environments.environment import (
    Environment as Environment,
    make_environment as make_environment,
)
from .core.environments.episodes import run_episode as run_episode
from .core.environments.tabulate import tabulate as tabulate
from .core.environments.task_environment import task_environment as task_environment
from .core.games.permissive import permissive_strategy as permissive_strategy
from .core.games.verify import verify as verify
from .core.games.winning import winning_region as winning_region
from .core.logic.ltl import parse_ltl as parse_ltl
from .core.models.construct.batch import stack_products as stack_products
from .core.models.construct.convert import to_sparse as to_sparse
from .core.models.construct.padded import to_padded as to_padded
from .core.models.construct.counts import make_counts as make_counts
from .core.models.construct.lifting import (
    lift_policy as lift_policy,
    project_policy as project_policy,
)
from .core.models.construct.restrict import restrict as restrict, with_allowed as with_allowed
from .core.models.game import Game as Game, make_game as make_game
from .core.models.interval import IntervalMDP as IntervalMDP, make_interval as make_interval
from .core.models.mdp import (
    DenseMDP as DenseMDP,
    MDP as MDP,
    from_dense as from_dense,
    make_mdp as make_mdp,
)
from .core.models.mesh.lanes import vmap_over_mesh as vmap_over_mesh
from .core.models.parametric import (
    ParametricMDP as ParametricMDP,
    make_parametric as make_parametric,
)
from .core.models.product import Product as Product, product as product
from .core.models.sparse import SparseMDP as SparseMDP, make_sparse as make_sparse
from .core.models.trajectories import make_trajectories as make_trajectories, rollout as rollout
from .core.policies.finite_memory import FiniteMemoryPolicy as FiniteMemoryPolicy
from .core.types import (
    NotConverged as NotConverged,
    Solution as Solution,
    Status as Status,
    check as check,
)
from .core.values.average.average_reward import average_reward as average_reward
from .core.values.discounted.discounted import (
    optimal_value as optimal_value,
    policy_value as policy_value,
)
from .core.values.discounted.minimax import minimax_value as minimax_value
from .core.values.discounted.occupancy import occupancy_measure as occupancy_measure
from .core.values.discounted.soft import soft_value as soft_value
from .core.values.evaluation.data_guarantee import learn_guarantee as learn_guarantee
from .core.values.evaluation.evaluation import evaluate as evaluate
from .core.values.evaluation.optimality_gap import optimality_gap as optimality_gap
from .core.values.multi_objective.multi_objective import (
    constrained_optimum as constrained_optimum,
    pareto as pareto,
)
from .core.values.prepared.prepared import prepare as prepare, solve_prepared as solve_prepared
from .core.values.properties.solve_property import solve_property as solve_property
from .core.values.undiscounted.optimal_actions import optimal_actions as optimal_actions
from .core.values.undiscounted.performance import task_performance as task_performance
from .core.values.undiscounted.reachability import (
    reachability_probability as reachability_probability,
)
from .core.values.undiscounted.satisfaction import (
    optimal_satisfaction as optimal_satisfaction,
    satisfaction_probability as satisfaction_probability,
)
from .core.values.undiscounted.total_reward import total_reward as total_reward
from .envs.gridworld import gridworld as gridworld
from .io.log import read_log as read_log
from .io.model_files import read_model as read_model, write_model as write_model
