"""Solvers give of a model over several processes what they give of the model."""

import ast

import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.models.product import product
from jaxltl.core.types import Status
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from tests import several
from tests.core.models.mesh.test_sharded import world
from tests.core.values.test_over_mesh import FORMULAS, SOLVERS, quantities


@pytest.mark.slow
@pytest.mark.parametrize(
    ("names", "reaches"),
    [
        (("sweeps", "reach max"), (2,)),
        pytest.param((*SOLVERS, *FORMULAS), (2, None), marks=pytest.mark.exhaustive),
    ],
)
def test_solvers(names, reaches):
    ended = several.ended(
        several.start(2, "-m", "tests.solvers_over_processes", ";".join(names), repr(reaches)), 600
    )
    assert [x.status for x in ended] == [0, 0], ended[0].err[-2000:] + ended[1].err[-2000:]
    # Besides what the program tells, its collectives speak of themselves.
    told = [[x for x in each.out.splitlines() if x.startswith("(")] for each in ended]
    assert told[0] == told[1]
    lines = [ast.literal_eval(line) for line in told[0]]
    assert [(reach, name) for reach, name, _ in lines] == [
        (reach, name) for reach in reaches for name in names
    ]
    for reach, name, (status, lower, upper) in lines:
        mdp = world(0, reach)
        if name in SOLVERS:
            here = SOLVERS[name](mdp, *(jnp.asarray(x) for x in quantities(mdp)))
        else:
            here = optimal_satisfaction(product(mdp, name))
        assert status == int(here.status) == Status.CONVERGED, name
        np.testing.assert_allclose(lower, np.ravel(here.lower), atol=2e-9, err_msg=name)
        np.testing.assert_allclose(upper, np.ravel(here.upper), atol=2e-9, err_msg=name)
