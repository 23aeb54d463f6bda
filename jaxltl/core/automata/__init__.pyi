from .automaton import (
    Automaton as Automaton,
    accepts_lasso as accepts_lasso,
    complement as complement,
    make_automaton as make_automaton,
)
from .language import (
    find_difference as find_difference,
    is_equivalent as is_equivalent,
    is_included as is_included,
)
from .sequences import Sequences as Sequences, reach_avoid_sequences as reach_avoid_sequences
from .language import synchronize as synchronize
from .translate import to_automaton as to_automaton
