"""Symbol grounding: learns from demonstrations what the symbols of a task mean."""

from jaxltl.algos.grounding import hidden_modes as hidden_modes
from jaxltl.algos.grounding.answer import (
    LabelQuery as LabelQuery,
    RobustPolicy as RobustPolicy,
    Row as Row,
    best_query as best_query,
    grounding_table as grounding_table,
    probability_under as probability_under,
    robust_policy as robust_policy,
    with_labels as with_labels,
)
from jaxltl.algos.grounding.automaton_search import (
    LearnedAutomaton as LearnedAutomaton,
    learn_automaton as learn_automaton,
)
from jaxltl.algos.grounding.hidden_modes import (
    HistoryTables as HistoryTables,
    fit_history as fit_history,
)
from jaxltl.algos.grounding.hypotheses import (
    Posterior as Posterior,
    ambiguous_symbols as ambiguous_symbols,
    credible_set as credible_set,
    posterior as posterior,
    select_demonstrations as select_demonstrations,
    symbol_symmetries as symbol_symmetries,
)
from jaxltl.algos.grounding.learner import (
    Metrics as Metrics,
    GroundingObjective as GroundingObjective,
    State as State,
    cluster_meanings as cluster_meanings,
    fit_labels as fit_labels,
    init as init,
    network_labels as network_labels,
    objective as objective,
    policy as policy,
    run as run,
    run_until as run_until,
    step as step,
    train as train,
    train_until as train_until,
)
from jaxltl.algos.grounding.problem import (
    Hparams as Hparams,
    LinearGrounding as LinearGrounding,
    Problem as Problem,
    event_reward as event_reward,
    make_problem as make_problem,
    demonstrator_policy as demonstrator_policy,
)
