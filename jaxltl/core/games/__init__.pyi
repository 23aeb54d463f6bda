from .objective import (
    GR1 as GR1,
    Parity as Parity,
    buchi as buchi,
    cobuchi as cobuchi,
    gr1 as gr1,
    parity as parity,
    reach as reach,
    safety as safety,
    states_with_label as states_with_label,
)
from .permissive import (
    Permissive as Permissive,
    apply_strategy as apply_strategy,
    permissive_strategy as permissive_strategy,
    shield_policy as shield_policy,
)
from .shielded_environment import (
    ShieldedWorld as ShieldedWorld,
    shield_environment as shield_environment,
)
from .strategy_policy import strategy_policy as strategy_policy
from .verify import Verification as Verification, verify as verify
from .winning import (
    Winning as Winning,
    almost_sure_buchi as almost_sure_buchi,
    winning_region as winning_region,
)
