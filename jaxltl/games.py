"""Games: objectives, winning regions, strategies, permissive strategies, and qualitative sets."""

from jaxltl.core.games.objective import (
    GR1 as GR1,
    Parity as Parity,
    buchi as buchi,
    cobuchi as cobuchi,
    generalized_buchi as generalized_buchi,
    gr1 as gr1,
    parity as parity,
    reach as reach,
    safety as safety,
    states_where as states_where,
)
from jaxltl.core.games.permissive import (
    Permissive as Permissive,
    apply_strategy as apply_strategy,
    permissive_strategy as permissive_strategy,
    shield_policy as shield_policy,
)
from jaxltl.core.games.verify import Verification as Verification, verify as verify
from jaxltl.core.games.winning import (
    Winning as Winning,
    almost_sure_buchi as almost_sure_buchi,
    winning_region as winning_region,
)
from jaxltl.core.graphs.attractor import (
    Attractor as Attractor,
    almost_surely_reaching as almost_surely_reaching,
    attractor as attractor,
    avoidable as avoidable,
)
from jaxltl.core.graphs.end_components import (
    EndComponents as EndComponents,
    end_components as end_components,
)

__all__ = sorted(name for name in dir() if not name.startswith("_"))
