"""Linear temporal logic, property syntax, automata and monitors."""

from jaxltl.core.automata.automaton import (
    Automaton as Automaton,
    accepts_lasso as accepts_lasso,
    complement as complement,
    make_automaton as make_automaton,
)
from jaxltl.core.automata.language import (
    find_difference as find_difference,
    is_equivalent as is_equivalent,
    is_included as is_included,
)
from jaxltl.core.automata.sequences import (
    Sequences as Sequences,
    reach_avoid_sequences as reach_avoid_sequences,
)
from jaxltl.core.automata.synchronize import synchronize as synchronize
from jaxltl.core.automata.translate import to_automaton as to_automaton
from jaxltl.core.environments.finite_task import (
    FiniteTask as FiniteTask,
    Shares as Shares,
    finite_shares as finite_shares,
    make_finite_task as make_finite_task,
)
from jaxltl.core.environments.monitor import (
    Monitor as Monitor,
    Verdict as Verdict,
    make_monitor as make_monitor,
    monitor_step as monitor_step,
    monitor_verdict as monitor_verdict,
    trace_verdicts as trace_verdicts,
    verdict as verdict,
)
from jaxltl.core.logic.ltl import (
    Formula as Formula,
    holds_on_lasso as holds_on_lasso,
    parse_ltl as parse_ltl,
)
from jaxltl.core.logic.properties import (
    Property as Property,
    parse_properties as parse_properties,
    parse_property as parse_property,
)

__all__ = sorted(name for name in dir() if not name.startswith("_"))
