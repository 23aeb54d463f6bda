from .average.average_reward import average_reward as average_reward
from .average.mean_payoff import mean_payoff as mean_payoff
from .discounted.discounted import optimal_value as optimal_value, policy_value as policy_value
from .discounted.minimax import minimax_value as minimax_value, strategy_value as strategy_value
from .discounted.occupancy import (
    feature_expectation as feature_expectation,
    occupancy_measure as occupancy_measure,
)
from .discounted.soft import (
    boltzmann_value as boltzmann_value,
    soft_value as soft_value,
)
from .evaluation.data_guarantee import (
    DataGuarantee as DataGuarantee,
    guarantee_curve as guarantee_curve,
    learn_guarantee as learn_guarantee,
)
from .evaluation.evaluation import (
    Batch as Batch,
    EpisodeTotals as EpisodeTotals,
    Estimate as Estimate,
    Evaluation as Evaluation,
    episode_evaluator as episode_evaluator,
    evaluate as evaluate,
)
from .evaluation.optimality_gap import (
    OptimalityGap as OptimalityGap,
    optimality_gap as optimality_gap,
    tabulate_policy as tabulate_policy,
)
from .evaluation.selection import select_agent as select_agent
from .interval.robust import robust_expectation as robust_expectation
from .interval.sensitivity import (
    Sensitivity as Sensitivity,
    robust_sensitivity as robust_sensitivity,
)
from .multi_objective.multi_objective import (
    Achievable as Achievable,
    ConstrainedOptimum as ConstrainedOptimum,
    Front as Front,
    NearestMixture as NearestMixture,
    Pareto as Pareto,
    achievable as achievable,
    constrained_optimum as constrained_optimum,
    pareto as pareto,
)
from .multi_objective.objectives import Objective as Objective
from .partial_observability.chains import controlled_chain as controlled_chain
from .partial_observability.reduction import (
    MealyTransition as MealyTransition,
    mealy_machine as mealy_machine,
    reduced_controller as reduced_controller,
    without_rare_actions as without_rare_actions,
)
from .partial_observability.solve import belief_bounds as belief_bounds
from .partial_observability.supports import (
    SupportShield as SupportShield,
    support_shield as support_shield,
)
from .prepared.prepared import (
    Prepared as Prepared,
    prepare as prepare,
    solve_prepared as solve_prepared,
)
from .prepared.prepared_interval import PreparedInterval as PreparedInterval
from .properties.solve_property import (
    Answer as Answer,
    PropertyStrategy as PropertyStrategy,
    solve_property as solve_property,
)
from .undiscounted.mixture import Mixture as Mixture, practical_policy as practical_policy
from .undiscounted.total_reward import hitting_time as hitting_time
from .undiscounted.optimal_actions import (
    OptimalActions as OptimalActions,
    optimal_actions as optimal_actions,
)
from .undiscounted.performance import (
    Performance as Performance,
    task_performance as task_performance,
    task_performances as task_performances,
)
from .undiscounted.reachability import reachability_probability as reachability_probability
from .undiscounted.satisfaction import (
    optimal_satisfaction as optimal_satisfaction,
    satisfaction_probability as satisfaction_probability,
)
from .undiscounted.satisfaction_steps import (
    Quickest as Quickest,
    Steps as Steps,
    Vertex as Vertex,
    quickest_policy as quickest_policy,
    satisfaction_steps as satisfaction_steps,
    steps_front as steps_front,
)
from .undiscounted.step_bounded import (
    bounded_reachability as bounded_reachability,
    cumulative_reward as cumulative_reward,
    instantaneous_reward as instantaneous_reward,
    next_probability as next_probability,
    reward_bounded_reachability as reward_bounded_reachability,
)
from .undiscounted.total_reward import total_reward as total_reward
