"""Policies of optima, evaluated again by the same function, attain the optimum, also where it is infinite."""

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.types import Status
from tests import reference_matrix as reference
from tests.model_kinds import KINDS, Subject
from tests.support import seeds

HOST = [kind for kind in KINDS if kind[0] not in ("chain", "instance")]
ASKS = {
    "reach": lambda s, **kw: jl.reachability_probability(s.model, s.mask(s.case.b), **kw),
    "total": lambda s, **kw: jl.total_reward(s.model, s.reward, s.mask(s.case.b), **kw),
    "average": lambda s, **kw: jl.average_reward(s.model, s.reward - 1.25, **kw),
}


@pytest.mark.parametrize("seed", seeds(1, 2, 20))
@pytest.mark.parametrize("kind", HOST, ids=lambda kind: "-".join(map(str, kind)))
def test_policies_attain_the_optimum(kind, seed):
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    case = reference.random_case(rng, 4)
    subject = Subject(kind, case)
    natures = (None, "cooperative") if subject.has_intervals else (None,)
    for name, ask in ASKS.items():
        for objective in ("max", "min"):
            for nature in natures:
                aims = {"objective": objective, "nature": nature}
                best = ask(subject, **aims)
                again = ask(subject, policy=best.policy, **aims)
                low, high = np.asarray(again.lower), np.asarray(again.upper)
                slack = 1e-8 * np.where(np.isfinite(best.upper), 1 + np.abs(best.upper), 1)
                assert (low <= best.upper + slack).all(), (name, aims)
                assert (high >= best.lower - slack).all(), (name, aims)


def waiting(*, intervals: bool, system: bool | None):
    """One may stay in state 0 for ever, by the second action, or go on to state 1 by the first."""
    base = jl.make_sparse([0, 2, 3], [0, 1, 2, 3], [1, 0, 1], [1.0, 1.0, 1.0])
    if intervals:
        base = jl.make_sparse([0, 2, 3], [0, 2, 3, 4], [0, 1, 0, 1], [0.5, 0.5, 1.0, 1.0])
        base = jl.make_interval(base, [0.25, 0.25, 1, 1], [0.75, 0.75, 1, 1])
    return base if system is None else jl.make_game(base, [system, True])


@pytest.mark.parametrize("intervals", [False, True])
@pytest.mark.parametrize("system", [None, True, False])
def test_a_policy_of_an_infinite_reward_misses_the_target(intervals, system):
    model, target = waiting(intervals=intervals, system=system), [False, True]
    objective = "min" if system is False else "max"  # whoever moves in state 0 maximises
    found = jl.total_reward(model, [1.0, 0.0], target, objective=objective)
    assert found.value.tolist() == [np.inf, 0] and found.policy[0] == 1


def test_nature_misses_the_target_where_the_reward_is_infinite():
    sets = jl.make_interval(
        jl.make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0]), [0, 0, 1], [1, 1, 1]
    )
    for objective, nature in (("max", "cooperative"), ("min", "adversarial")):
        found = jl.total_reward(sets, [1.0, 0.0], [False, True], objective=objective, nature=nature)
        assert found.value.tolist() == [np.inf, 0] and found.nature.tolist() == [1, 0, 1]


@pytest.mark.parametrize("objective", ["max", "min"])
@pytest.mark.parametrize("is_game", [False, True])
def test_discounted_rewards_of_nothing_converge(objective, is_game):
    coin = jl.make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
    model = jl.make_game(coin, [True, True]) if is_game else coin
    found = jl.optimal_value(model, np.zeros(2), 0.5, objective=objective)
    assert int(found.status) == Status.CONVERGED
    assert not np.signbit([found.value, found.lower, found.upper]).any()
