"""Expected steps to satisfaction, against linear algebra, simulation and all small policies."""

from itertools import combinations
from itertools import product as every

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.models.product import product
from jaxltl.core.values.undiscounted.mixture import at_starts, least_mixture
from jaxltl.core.values.undiscounted.optimal_actions import optimal_actions
from jaxltl.core.values.undiscounted.satisfaction import satisfaction_probability
from jaxltl.core.values.undiscounted.satisfaction_steps import quickest_policy, satisfaction_steps
from tests.core.values.undiscounted.test_optimal_actions import A, N, Q, S, random_case
from tests.support import counts

KINDS = ("cosafe", "buchi", "parity")


def dense(model):
    """Transition probabilities ``[N, A, N]`` and the priority that each pair of states reads."""
    moves = np.zeros((N, A, N))
    read = np.zeros((N, N), int)
    succ, prob = (np.asarray(x) for x in (model.mdp.successor, model.mdp.probability))
    delta, priority = np.asarray(model.automaton.delta), np.asarray(model.automaton.priority)
    letter = np.asarray(model.letter)
    for s, q, a in every(range(S), range(Q), range(A)):
        for t, p in zip(succ[s, a], prob[s, a], strict=True):
            x = letter[t] if model.label_on == "entry" else letter[s]
            moves[s * Q + q, a, t * Q + delta[q, x]] += p
        for t in range(S):
            x = letter[t] if model.label_on == "entry" else letter[s]
            read[s * Q + q, t * Q : t * Q + Q] = priority[q, x]
    return moves, read


def bottoms(steps):
    """The bottom strongly connected components of a chain, as lists of states."""
    ahead = np.linalg.matrix_power((steps > 0) | np.eye(N, dtype=bool), N)
    alike = ahead & ahead.T
    closed = (ahead <= alike).all(1)
    return [np.flatnonzero(alike[n]) for n in range(N) if closed[n] and alike[n].argmax() == n]


def round_length(steps, read, part):
    """Steps between two rounds in a bottom component; None if it is not accepting."""
    inner, seen = steps[np.ix_(part, part)], read[np.ix_(part, part)]
    met = np.unique(seen[inner > 0])
    if met.min() % 2:
        return None
    hits = (seen % 2 == 0) & (seen < min([*met[met % 2 == 1], 99]))
    system = np.vstack([inner.T - np.eye(len(part)), np.ones(len(part))])
    share = np.linalg.lstsq(system, np.append(np.zeros(len(part)), 1), rcond=None)[0]
    return 1 / (share @ (inner * hits).sum(1))


def regions(model, moves, read):
    """Where steps count: neither accepted for sure by some policy's end, nor lost."""
    available = np.asarray(model.available).reshape(N, A)
    if model.automaton.has_final_states:
        goal = np.asarray(model.final).ravel()
    else:
        goal = np.zeros(N, bool)
        sets = [
            [c for k in range(A) for c in combinations(np.flatnonzero(available[n]), k + 1)]
            for n in range(N)
        ]
        for support in every(*sets):
            steps = np.stack([moves[n, list(c)].mean(0) for n, c in enumerate(support)])
            for part in bottoms(steps):
                if round_length(steps, read, part) is not None:
                    goal[part] = True
    ahead = (moves * available[..., None]).sum(1) > 0
    ahead = np.linalg.matrix_power(ahead | np.eye(N, dtype=bool), N)
    return goal, ~ahead[:, goal].any(1)


def expected(model, policy, facts):
    """The expected number of steps by the definition, by linear algebra."""
    moves, read, goal, lost = facts
    steps = np.einsum("na,nat->nt", policy.reshape(N, A), moves)
    counted, ends = (~goal & ~lost).astype(float), bottoms(steps)
    start = np.asarray(model.initial, float).ravel()
    bad = np.zeros(N, bool)
    for part in ends:
        bad[part] = counted[part].any()
    ahead = np.linalg.matrix_power((steps > 0) | np.eye(N, dtype=bool), N)
    if (ahead[:, bad].any(1) & (start > 0)).any():
        return np.inf
    final = np.zeros(N, bool)
    final[np.concatenate(ends)] = True
    fine = np.flatnonzero(~final & ~ahead[:, bad].any(1))
    inverse = np.linalg.inv(np.eye(len(fine)) - steps[np.ix_(fine, fine)])
    total = start[fine] @ inverse @ counted[fine]
    if model.automaton.has_final_states:
        return total
    accepted, rounds = 0.0, 0.0
    for part in ends:
        length = round_length(steps, read, part)
        if length is not None:
            reach = start[part].sum() + start[fine] @ inverse @ steps[np.ix_(fine, part)].sum(1)
            accepted, rounds = accepted + reach, rounds + reach * length
    return total + rounds / accepted if accepted > 1e-12 else np.inf


def cases(kind, count, seed=0):
    rng = np.random.default_rng([KINDS.index(kind), seed])
    for _ in range(count):
        world, automaton = random_case(rng, kind)
        mdp = make_mdp(**world, propositions=["a", "b"], initial=rng.dirichlet(np.ones(S)))
        model = product(mdp, automaton, label_on=rng.choice(["entry", "exit"]))
        moves, read = dense(model)
        yield rng, model, (moves, read, *regions(model, moves, read))


@pytest.mark.parametrize("kind", KINDS)
@counts(3, 60, slow=15)
def test_steps_of_policies_agree_with_linear_algebra(kind, count):
    finite = 0
    for rng, model, facts in cases(kind, count):
        available = np.asarray(model.available)
        for _ in range(4):
            policy = available * rng.dirichlet(np.ones(A) / 2, (S, Q))
            policy = np.where(rng.random((S, Q, 1)) < 0.5, policy, available)
            policy = policy / policy.sum(-1, keepdims=True)
            found, value = satisfaction_steps(model, policy), expected(model, policy, facts)
            assert found.lower <= value * (1 + 1e-9) and value <= found.upper * (1 + 1e-9)
            assert found.value == pytest.approx(value, rel=1e-6)
            finite += np.isfinite(value)
    assert finite >= count


@pytest.mark.parametrize("kind", KINDS)
@counts(2, 40, slow=10)
def test_the_quickest_optimal_policy_is_the_quickest_of_all_memoryless_ones(kind, count):
    tight = 0
    for _, model, facts in cases(kind, count, seed=1):
        actions = optimal_actions(model)
        found = quickest_policy(model, actions)
        eye = np.eye(A)
        best = probability(model, eye[np.asarray(actions.best.policy)])
        assert probability(model, eye[found.policy]) == pytest.approx(best, abs=1e-9)
        assert found.least <= found.steps.upper
        allowed = np.asarray(actions.allowed).reshape(N, A)
        least = np.inf
        for chosen in every(*(np.flatnonzero(x) for x in allowed)):
            policy = eye[np.array(chosen)].reshape(S, Q, A)
            if probability(model, policy) >= best - 1e-9:
                least = min(least, expected(model, policy, facts))
        assert found.least <= least * (1 + 1e-9)  # a certified bound of all of them
        assert found.steps.value >= least * (1 - 1e-9)
        tight += found.steps.value <= least * (1 + 1e-6) or np.isinf(least)
        if kind == "cosafe":
            assert found.steps.value == pytest.approx(least, rel=1e-6)
            assert found.steps.upper <= found.least * (1 + 1e-5)
    assert tight >= 0.9 * count


def probability(model, policy):
    return at_starts(model, satisfaction_probability(model, policy).value, "mean")[0]


def test_steps_agree_with_simulation():
    rng = np.random.default_rng(0)
    moves = rng.dirichlet(np.ones(5) / 2, (5, 2))
    world = jl.from_dense(
        moves,
        label=[[0, 0], [1, 0], [0, 1], [0, 0], [0, 0]],
        propositions=["a", "b"],
        initial=[0.5, 0, 0, 0.5, 0],
    )
    patrol = product(world, "G F a & G F b")
    policy = rng.dirichlet(np.ones(2), patrol.state_shape)
    found = satisfaction_steps(patrol, policy)
    chain_of = np.einsum("sqa,sat->sqt", policy, moves)
    delta, letter = np.asarray(patrol.automaton.delta), np.asarray(patrol.letter)
    priority = np.asarray(patrol.automaton.priority)
    s, q, rounds, length = 0, int(np.asarray(patrol.initial_memory)[0]), 0, 40_000
    for u in rng.random(length):
        t = min(int(np.searchsorted(chain_of[s, q].cumsum(), u)), 4)
        rounds += priority[q, letter[t]] == 0
        s, q = t, delta[q, letter[t]]
    assert found.value == pytest.approx(length / rounds, rel=0.03)
    assert found.upper - found.lower < 1e-5 * found.value


def test_steps_of_safety_tasks_and_of_undecided_policies():
    world = jl.from_dense(
        [[[1.0, 0], [0, 1.0]], [[0, 1.0]] * 2], label=[[0], [1]], propositions=["a"], initial=[1, 0]
    )
    stay, go = np.zeros((2, 2), int), np.ones((2, 2), int)
    assert satisfaction_steps(product(world, "G !a"), stay)[:3] == (0, 0, 0)
    assert satisfaction_steps(product(world, "F a"), stay)[:3] == (np.inf,) * 3
    assert satisfaction_steps(product(world, "F a"), go).value == 1
    both = product(world, "F G a")
    assert satisfaction_steps(both, np.ones(both.state_shape, int)).value == 2  # there, then a


@pytest.mark.parametrize("factor", [1.2, 2, 50])
def test_least_mixture_keeps_the_steps_within_a_limit(factor):
    slow = 1e-9
    world = jl.from_dense(
        [[[0, 1.0], [1.0, 0]], [[0, 1.0]] * 2], label=[[0], [1]], propositions=["a"], initial=[1, 0]
    )
    model = product(world, "F a")
    policy = np.broadcast_to([slow, 1 - slow], (*model.state_shape, 2))
    quickest = quickest_policy(model)
    limit = factor * quickest.steps.upper
    found = least_mixture(model, policy, np.eye(2)[quickest.policy], 0, steps=limit)
    # The chance of moving on is at least 1 / limit.
    assert found.share == pytest.approx(1 / limit, rel=0.01)
    assert found.steps.upper <= limit and found.steps.value == pytest.approx(limit, rel=0.01)
    least = least_mixture(model, found.policy, np.eye(2)[quickest.policy], 0, steps=limit)
    assert least.share == 0
