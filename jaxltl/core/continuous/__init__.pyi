from .certificate import (
    Certificate as Certificate,
    certify_policy as certify_policy,
    counterexample as counterexample,
    state_policy as state_policy,
)
from .dynamics import (
    Dynamics as Dynamics,
    make_dynamics as make_dynamics,
    to_environment as to_environment,
)
from .grid import Grid as Grid, make_grid as make_grid
from .noise import (
    Distribution as Distribution,
    from_cdf as from_cdf,
    gaussian as gaussian,
    triangular as triangular,
    truncated_gaussian as truncated_gaussian,
    uniform as uniform,
)
from .regions import (
    Region as Region,
    box as box,
    half_space as half_space,
    union as union,
    where_positive as where_positive,
)
from .synthesis import (
    CellPolicy as CellPolicy,
    shield_dynamics as shield_dynamics,
    simulate_cells as simulate_cells,
    synthesize_policy as synthesize_policy,
)
