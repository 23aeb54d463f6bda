"""The best policy is also the quickest of the best, against every memoryless policy."""

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.sparse.solvers.shortest_path import fastest_rows
from jaxltl.core.values.undiscounted.acceptance import as_reachability
from tests.core.values.undiscounted.test_optimal_actions import (
    CASES,
    A,
    N,
    model_of,
    probabilities,
    with_all_values,
)


def expected_times(policy, matrix, open_):
    """Expected steps until open states are left under policies ``[B, N, A]``; infinite if not."""
    chain = np.where(open_, np.einsum("bxa,xay->bxy", policy, matrix), 0)
    leaves = np.broadcast_to(~open_, chain.shape[:2]) | (chain.sum(2) < 1 - 1e-9)
    for _ in range(N):  # which states can leave, then which may come where that is impossible
        leaves = leaves | ((chain > 0) & leaves[:, None, :]).any(2)
    never = ~leaves
    for _ in range(N):
        never = never | (((chain > 0) & never[:, None, :]).any(2) & open_)
    finite = open_ & ~never
    system = np.eye(N) - np.where(finite[:, :, None] & finite[:, None, :], chain, 0)
    time = np.linalg.solve(system, finite[..., None].astype(float))[..., 0]
    return np.where(never, np.inf, time)


def decided(model, objective, best, accepting):
    """Where nothing is open any more, for the largest probability `best` of what is wanted."""
    kind = model.automaton.acceptance
    if accepting is not None:
        return np.asarray(accepting.region).ravel() | (best < 1e-9)
    if (kind == "cosafe") == (objective == "max"):
        wanted = np.asarray(model.final).ravel() == (kind == "cosafe")
        return wanted | (best < 1e-9)
    return (best < 1e-9) | (best > 1 - 1e-9)


def races(case, objective):
    """Who is to be quick: the policies, their transitions, and the states to leave."""
    parts, matrix, priority, policies, values, sure = case
    model = model_of(*parts)
    best, surely = values.max(0), sure.any(0)
    optimal = (np.abs(values - best) <= 1e-9).all(1) & (sure == surely).all(1)
    accepting = as_reachability(model, objective).accepting
    found = [(policies[optimal], matrix, ~decided(model, objective, best, accepting))]
    if accepting is not None:  # inside, to the next transition of the least priority
        region = np.asarray(accepting.region).ravel()
        inside = np.asarray(accepting.inside).reshape(N, A)
        visited = priority == np.asarray(accepting.least).ravel()[:, None]
        stays = ((policies <= inside).all(2) | ~region).all(1)
        found.append((policies[stays], np.where(visited[:, None, :], 0, matrix), region))
    return found


def check_case(rng, kind, label_on, objective):
    differs = False
    while not differs:
        case = with_all_values(rng, kind, label_on, objective)
        found = [(expected_times(*race), *race) for race in races(case, objective)]
        times = found[rng.integers(len(found))][0]
        differs = (times > times.min(0) + 1e-9).any()
    best = jl.optimal_satisfaction(model_of(*case[0]), objective=objective)
    policy = np.eye(A)[np.asarray(best.policy)]
    policy = policy.reshape(1, N, A)
    best, sure = case[4].max(0), case[5].any(0)
    attained, surely = probabilities(policy, *case[1:3])
    np.testing.assert_allclose(attained[0], best, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(surely[0], sure)
    for times, policies, matrix, open_ in found:
        least = times.min(0)
        assert np.isfinite(least).all()
        np.testing.assert_allclose(expected_times(policy, matrix, open_)[0], least, rtol=1e-9)
        agrees = (policies == policy).all(2) | ~open_
        assert agrees.all(1).any()  # it is one of them where it matters


@pytest.mark.few(2, 4)
@pytest.mark.parametrize("count", [1, pytest.param(20, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize(("kind", "label_on", "objective"), CASES)
def test_no_best_policy_is_quicker(kind, label_on, objective, count):
    rng = np.random.default_rng([7, CASES.index((kind, label_on, objective)), count])
    avoided = (kind, objective) in (("cosafe", "min"), ("safety", "max"))
    count *= 1 if avoided else 6  # where nothing is to be reached ties are rare
    for _ in range(count):
        check_case(rng, kind, label_on, objective)


def test_a_corridor_is_walked_straight():
    """Bumping into the wall and waiting to slip is as sure, and slower."""
    model = jl.product(jl.gridworld("s . . g", slip=0.1, initial="s"), "F g")
    best = jl.optimal_satisfaction(model)
    assert (best.value == 1).all()
    (right,) = set(np.asarray(best.policy)[:3, int(model.initial_memory[0])].tolist())
    successor, probability = (
        np.asarray(x)[0, right] for x in (model.mdp.successor, model.mdp.probability)
    )
    assert successor[probability.argmax()] == 1


@pytest.mark.parametrize("size", [60, 800])
def test_the_fastest_policy_of_a_slow_walk(size):
    """A walk on a line in which one action of two is a little less slow."""
    rng = np.random.default_rng(0)
    quick = rng.integers(2, size=size)
    ahead = np.where(quick[:, None] == np.arange(2), 0.5, 0.49)
    states = np.arange(size)
    around = np.stack([np.maximum(states - 1, 0), np.minimum(states + 1, size - 1)], -1)
    model = jl.make_mdp(np.repeat(around[:, None], 2, 1), np.stack([1 - ahead, ahead], -1))
    host = jl.to_sparse(model).host
    goal = states == size - 1
    rows = np.ones(host.num_rows, bool)
    found = fastest_rows(host, rows, goal, host.row_start[:-1])
    np.testing.assert_array_equal(found[:-1] - host.row_start[:-2], quick[:-1])
    rows[host.row_start[5] : host.row_start[6]] = False
    given = np.asarray(host.row_start[:-1])
    np.testing.assert_array_equal(fastest_rows(host, rows, goal, given), given)


TASKS = ("F g", "G !r", "G F g & G F y", "F G g & F y")


# By default each task and each objective occurs.
@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("task", "objective"),
    [
        pytest.param(task, objective, marks=[] if i % 2 == j else pytest.mark.exhaustive)
        for i, task in enumerate(TASKS)
        for j, objective in enumerate(("max", "min"))
    ],
)
def test_the_host_is_as_good_as_the_traced_engine(task, objective):
    model = jl.product(jl.gridworld("g . r\n. s y", slip=0.2, initial="s"), task)
    host = jl.optimal_satisfaction(model, objective=objective)
    traced = jax.jit(lambda m: jl.optimal_satisfaction(m, objective=objective))(model)
    for found in (host, traced):
        attained = jl.satisfaction_probability(model, found.policy).value
        np.testing.assert_allclose(attained, host.value, atol=1e-7)


@pytest.mark.parametrize(
    ("task", "objective"),
    [
        ("F g", "max"),
        ("G !t", "max"),
        ("F t", "min"),
        ("G !g", "min"),
        ("G F g", "max"),
        ("F G t", "min"),
    ],
)
def test_among_equal_odds_the_short_way_and_never_worse_odds(task, objective):
    """Even odds by way of 1, worse ones at once, even ones after a while, even ones at once."""
    goal, trap = [2] * 3, [3] * 3
    world = jl.make_mdp(
        [[[1, 1, 1], [2, 3, 3], [0, 2, 3], [2, 3, 3]], [[2, 3, 3]] * 4, [goal] * 4, [trap] * 4],
        [
            [[1, 0, 0], [0.49, 0.51, 0], [0.5, 0.25, 0.25], [0.5, 0.5, 0]],
            [[0.5, 0.5, 0]] * 4,
            [[1, 0, 0]] * 4,
            [[1, 0, 0]] * 4,
        ],
        initial=[1, 0, 0, 0],
        label=[[0, 0], [0, 0], [1, 0], [0, 1]],
        propositions=["g", "t"],
    )
    model = jl.product(world, task)
    best = jl.optimal_satisfaction(model, objective=objective)
    start = 0, int(model.initial_memory[0])
    assert float(best.value[start]) == pytest.approx(0.5)
    assert int(best.policy[start]) == 3
    allowed = jl.optimal_actions(model, objective=objective).allowed[start]
    assert allowed.tolist() == [True, False, True, True]


@pytest.mark.parametrize("wide", [False, True])
def test_a_rare_danger_is_never_called_impossible(wide):
    """One minus a small probability is rounded, and its bounds outwards."""
    with jax.enable_x64(wide):
        rare = 1e-17 if wide else 1e-9
        world = jl.make_mdp(
            [[[0, 1, 2]], [[1] * 3], [[2] * 3]],
            np.array([[[0.5, 0.5, rare]], [[1, 0, 0]], [[1, 0, 0]]]),
            initial=[1, 0, 0],
            label=[[0], [0], [1]],
            propositions=["danger"],
        )
        model = jl.product(world, "G !danger")
        start = 0, int(model.initial_memory[0])
        for found in (
            jl.optimal_satisfaction(model),
            jl.satisfaction_probability(model, np.ones((*model.state_shape, 1))),
        ):
            assert int(found.status) == jl.Status.CONVERGED
            assert 1 - 1e-6 < float(np.asarray(found.lower)[start]) < 1
            assert float(np.asarray(found.upper)[start]) == 1
