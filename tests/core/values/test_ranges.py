"""Values and bounds of random models lie in the range of their quantity; zeros are exact."""

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models.interval import interval_rows
from jaxltl.core.models.sparse import Rewards
from jaxltl.core.values.properties.solve_property import solve_property
from tests.support import seeds

PROPERTIES = (
    *(("P", x) for x in ('X "a"', 'F "a"', '"c" U "a"', 'G !"a"', '"c" W "b"', '"b" R "c"')),
    *(("P", x) for x in ('F<=3 "a"', 'G<=2 "c"', 'F=2 "a"', 'F{"r"}<=1 "a"', 'G{"r"}<=1 "c"')),
    *(("P", x) for x in ('(G F "b")', '(F "a") & (F "b")', '(G F "b") & (G "c")')),
    *(("R", x) for x in ('F "a"', "C", "C<=3", "C<=0", "I=3", "I=200", "C<=200", "S")),
    *(("S", x) for x in ('"a"', '"b"', "true", "false")),
    ("T", 'F "a"'),
)
INTERVALS = ('G{"r"}<=1 "c"', 'F{"r"}<=1 "a"', "C", "S")  # not solved


def random_model(seed):
    """A small MDP, some of whose probabilities are tiny, and the rewards of its states."""
    rng = np.random.default_rng(seed)
    size = int(rng.integers(2, 8))
    count = rng.integers(1, 3, size)
    rows = [
        rng.choice(size, int(rng.integers(1, min(size, 3) + 1)), replace=False)
        for _ in range(count.sum())
    ]
    chance = []
    for row in rows:
        weight = rng.dirichlet(np.ones(len(row)))
        if rng.random() < 0.5:
            weight = 10.0 ** -rng.integers(0, rng.choice([3, 12]), len(row))
            weight[0] = 1
        chance.append(weight / weight.sum())
    reward = np.where(rng.random(size) < 0.5, 0, rng.choice([1.0, 0.25, 2, 1e-3], size))
    label = {"a": [0], "b": [size - 1], "c": np.flatnonzero(rng.random(size) < 0.7).tolist()}
    model = jl.make_sparse(
        np.concatenate([[0], count.cumsum()]),
        np.cumsum([0, *map(len, rows)]),
        np.concatenate(rows),
        np.concatenate(chance),
        initial=np.ones(size) / size,
        label=label,
        rewards={"r": Rewards(state=reward)},
    )
    return model, reward


def with_intervals(model):
    host = model.host
    alone = (np.diff(host.entry_start) == 1)[host.row]
    lower = np.where(alone, 1, 0.7 * host.probability)
    upper = np.where(alone, 1, np.minimum(host.probability + 0.2, 1))
    return interval_rows(
        host.row_start,
        host.entry_start,
        host.successor,
        lower,
        upper,
        initial=model.initial,
        label=np.asarray(model.label),
        propositions=model.propositions,
        rewards=model.rewards,
    )


def span_of(operator, path, reward):
    if operator in "PS":
        return 0, 1
    steps = path.partition("=")[2]
    if path.startswith("C<="):
        return int(steps) * reward.min(), int(steps) * reward.max()
    return (reward.min(), reward.max()) if path[0] in "IS" else (0, np.inf)


def require_range(found, span, place):
    for lower, value, upper in zip(
        *(np.ravel(x) for x in (found.lower, found.value, found.upper)), strict=True
    ):
        assert span[0] <= lower <= value <= upper <= span[1], place
        # Probabilities of many steps may be smaller than every double.
        tiny = any(0 < abs(x) < 1e-250 for x in (lower, value, upper))
        assert not tiny or "=200" in str(place), place


SEEDS = seeds(2, 8, 40)


@pytest.mark.parametrize("seed", SEEDS)
def test_properties_stay_in_their_range(seed):
    model, reward = random_model(seed)
    for operator, path in PROPERTIES:
        span = span_of(operator, path, reward)
        for direction in ("max", "min"):
            text = f"{operator}{direction}=? [ {path} ]"
            found = solve_property(model, text, states=range(model.num_states))
            require_range(found, span, text)


@pytest.mark.parametrize("seed", SEEDS)
def test_properties_of_interval_models_stay_in_their_range(seed):
    model, reward = random_model(seed)
    model = with_intervals(model)
    for operator, path in PROPERTIES:
        if path in INTERVALS or operator == "S":
            continue
        for directions in ("maxmin", "minmin"):
            text = f"{operator}{directions}=? [ {path} ]"
            found = solve_property(model, text, states=range(model.num_states))
            require_range(found, span_of(operator, path, reward), text)


@pytest.mark.parametrize("seed", SEEDS)
def test_rewards_of_both_signs_stay_in_their_range(seed):
    model, reward = random_model(seed)
    low, high = float(reward.min()), float(reward.max())
    ends = (low / (1 - 0.5), high / (1 - 0.5)), (low, high), (4 * low, 4 * high)
    values = jl.values
    solvers = (
        lambda r, d: jl.optimal_value(model, r, 0.5),
        lambda r, d: jl.average_reward(model, r, objective=d),
        lambda r, d: values.cumulative_reward(model, r, 4, objective=d),
    )
    intervals = with_intervals(model)
    for sign in (1, -1):
        for direction in ("max", "min"):
            for solve, span in zip(solvers, ends, strict=True):
                span = span if sign > 0 else (-span[1], -span[0])
                require_range(solve(sign * reward, direction), span, (solve, sign, direction))
        span = ends[0] if sign > 0 else (-ends[0][1], -ends[0][0])
        require_range(values.optimal_value(intervals, sign * reward, 0.5), span, sign)
