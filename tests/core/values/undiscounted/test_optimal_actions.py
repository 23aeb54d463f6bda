"""The mask of actions that lose nothing, against every memoryless policy of small products."""

from dataclasses import replace
from itertools import product as every

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.automata.automaton import make_automaton
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.models.product import product
from jaxltl.core.values.undiscounted import optimal_actions as module
from jaxltl.core.values.undiscounted.optimal_actions import optimal_actions
from tests.core.graphs.test_engines import counted_programs

S, A, Q, L = 3, 2, 2, 4
N = S * Q
KINDS = ("cosafe", "safety", "buchi", "parity")
CASES = list(every(KINDS, ("entry", "exit"), ("max", "min")))
LETTERS = [[bool(n & 1), bool(n >> 1)] for n in range(L)]
FRACTIONS = np.array([[6, 0, 0], [6, 0, 0], [3, 3, 0], [3, 3, 0], [2, 4, 0]]) / 6


def random_case(rng, kind):
    """What a world and an automaton are made of; of most cases no model is needed.

    Halves and thirds, so that ties are exact; many loops, and an action may be missing.

    Where action 1 is lazy, it does what action 0 does half of the time, and else stays.
    """
    own = np.arange(S)[:, None, None]
    successor = rng.integers(0, S, (S, A, 3))
    loops = (rng.random((S, A, 3)) < 0.3) | (rng.random((S, 1, 1)) < 0.4)
    successor = np.where(loops, own, successor)
    successor[..., 2] = own[..., 0]
    probability = FRACTIONS[rng.integers(len(FRACTIONS), size=(S, A))]
    lazy = rng.random(S) < 0.3
    successor[lazy, 1] = successor[lazy, 0]
    probability[lazy, 1] = probability[lazy, 0] / 2 + np.array([0, 0, 1 / 2])
    available = rng.random((S, A)) < 0.9
    available[np.arange(S), rng.integers(A, size=S)] = True
    world = {
        "successor": successor,
        "probability": probability,
        "available": available,
        "label": rng.random((S, 2)) < 0.5,
    }
    delta = np.where(rng.random((Q, L)) < 0.4, rng.integers(0, Q, (Q, L)), np.arange(Q)[:, None])
    if kind in ("cosafe", "safety"):
        delta[-1] = Q - 1
        last = np.arange(Q) == Q - 1
        table = {"final": last if kind == "cosafe" else ~last, "acceptance": kind}
    elif kind == "buchi":
        table = {"accepting": rng.random((Q, L)) < 0.3}
    else:
        table = {"priority": rng.integers(0, 5, (Q, L)), "acceptance": "parity"}
    return world, make_automaton(delta, 0, LETTERS, ["a", "b"], **table)


def model_of(world, automaton, label_on):
    mdp = make_mdp(**world, initial=np.full(S, 1 / S), propositions=["a", "b"])
    return product(mdp, automaton, label_on=label_on)


def explicit(world, automaton, label_on):
    """Transitions ``[N, A, N]`` and the priority of each pair of states, by loops."""
    delta, priorities = np.asarray(automaton.delta), np.asarray(automaton.priority)
    letter = world["label"] @ [1, 2]
    matrix, priority = np.zeros((N, A, N)), np.full((N, N), 99)
    for s, q, a, k in every(range(S), range(Q), range(A), range(3)):
        if world["available"][s, a] and world["probability"][s, a, k] > 0:
            t = int(world["successor"][s, a, k])
            read = letter[t] if label_on == "entry" else letter[s]
            row, column = s * Q + q, t * Q + int(delta[q, read])
            matrix[row, a, column] += world["probability"][s, a, k]
            priority[row, column] = priorities[q, read]
    return matrix, priority


def components(chain, priority):
    """Which states of chains ``[B, N, N]`` are recurrent, and whether acceptance is sure there."""
    reach = (chain > 0) | np.eye(N, dtype=bool)
    for _ in range(3):
        reach = (reach.astype(np.uint8) @ reach.astype(np.uint8)) > 0
    recurrent = (~reach | reach.swapaxes(1, 2)).all(2)
    met = np.where(chain > 0, priority, 99).min(2)
    least = np.where(reach, met[:, None, :], 99).min(2)
    return recurrent, recurrent & (least % 2 == 0), reach


def probabilities(policy, matrix, priority):
    """The probability of acceptance under policies ``[B, N, A]``, and where it is sure."""
    chain = np.einsum("bxa,xay->bxy", policy, matrix)
    recurrent, good, reach = components(chain, priority)
    inner = ~recurrent
    system = np.eye(N) - np.where(inner[:, :, None], chain, 0)
    value = np.linalg.solve(system, good[..., None].astype(float))[..., 0]
    bad = recurrent & ~good
    sure = ~(reach & bad[:, None, :]).any(2)
    return value, sure


def deterministic(matrix):
    """Every deterministic policy, ``[B, N, A]``."""
    choices = [np.flatnonzero(x) for x in matrix.sum(-1) > 0]
    return np.eye(A)[np.array(list(every(*choices)))]


def in_accepting_components(matrix, priority):
    """The states of accepting end components: of what some set of actions makes recurrent."""
    subsets = [
        [x for x in ((1, 0), (0, 1), (1, 1)) if not (np.array(x, bool) & ~usable).any()]
        for usable in matrix.sum(-1) > 0
    ]
    support = np.array(list(every(*subsets)), float)
    chain = np.einsum("bxa,xay->bxy", support, matrix)
    return components(chain, priority)[1].any(0)


def with_all_values(rng, kind, label_on, objective):
    """A case with its tables, all of its policies and what they attain."""
    parts = *random_case(rng, kind), label_on
    matrix, priority = explicit(*parts)
    if objective == "min":
        priority = priority + 1  # the negation, to be attained with the largest probability
    policies = deterministic(matrix)
    return parts, matrix, priority, policies, *probabilities(policies, matrix, priority)


def case_that_matters(rng, kind, label_on, objective):
    """One in which policies differ; what the graph does not decide is rare."""
    while True:
        case = with_all_values(rng, kind, label_on, objective)
        values, best = case[4], case[4].max(0)
        inner = (best * (1 - best) > 1e-9).any()
        if (inner or rng.random() < 0.15) and np.ptp(values, 0).max() > 1e-9:
            return case


def check_case(rng, kind, label_on, objective):
    parts, matrix, priority, policies, values, sure = case_that_matters(
        rng, kind, label_on, objective
    )
    model = model_of(*parts)
    best, surely = values.max(0), sure.any(0)
    found = optimal_actions(model, objective=objective)
    allowed = np.asarray(found.allowed).reshape(N, A)
    assert allowed.any(1).all()
    assert not (allowed & (matrix.sum(-1) == 0)).any()
    assert 0 <= float(found.loss) < 1e-12
    assert int(found.status) == jl.Status.CONVERGED
    weight = np.where(allowed, rng.random((3, N, A)) ** 3 + 1e-3, 0)
    attained, almost = probabilities(weight / weight.sum(2, keepdims=True), matrix, priority)
    np.testing.assert_allclose(attained, np.broadcast_to(best, (3, N)), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(almost, np.broadcast_to(surely, (3, N)))

    # The same from bounds that say nothing, of which only what is proven anew is left.
    inner = (found.best.value > 0) & (found.best.value < 1)
    vague = replace(
        found.best,
        lower=jnp.where(inner, 0, found.best.lower),
        upper=jnp.where(inner, 1, found.best.upper),
    )
    proven = optimal_actions(model, vague, objective=objective)
    np.testing.assert_array_equal(proven.allowed, found.allowed)
    assert float(proven.loss) < 1e-12

    optimal = (np.abs(values - best) <= 1e-9).all(1) & (sure == surely).all(1)
    assert optimal.any()
    missing = (policies[optimal] > 0).any(0) & ~allowed
    if kind == "parity" or (kind == "buchi" and objective == "min"):
        missing &= ~in_accepting_components(matrix, priority)[:, None]
    assert not missing.any()
    left_out = (matrix.sum(-1) > 0) & ~allowed
    conserving = np.abs(matrix @ best - best[:, None]) <= 1e-9
    several = allowed.sum(1).max() > 1
    return (best * (1 - best) > 1e-9).any(), left_out.any(), several, (left_out & conserving).any()


@pytest.mark.few(2, 3)
@pytest.mark.parametrize(("kind", "label_on", "objective"), CASES)
@pytest.mark.parametrize("count", [18, pytest.param(313, marks=pytest.mark.exhaustive)])
def test_every_policy_on_the_whole_mask_is_optimal_and_no_best_action_is_missing(
    kind, label_on, objective, count
):
    rng = np.random.default_rng([CASES.index((kind, label_on, objective)), count])
    seen = np.array([check_case(rng, kind, label_on, objective) for _ in range(count)])
    assert (seen[:, :3].sum(0) >= count / 10).all()  # and the cases are not all of one kind
    assert seen[:, 3].any() or kind != "parity" or count < 100


@pytest.fixture(scope="module")
def crossing():
    """Two cells in a row may be crossed at will; from the second a step ends well half the time.

    Action 0 of a cell stays, 1 goes on; from the second cell that is the step, and action 0 goes
    back. State 2 is the goal and 3 a trap.
    """
    ends = [[[2, 2]] * 2, [[3, 3]] * 2]
    return make_mdp(
        [[[0, 0], [1, 1]], [[0, 0], [2, 3]], *ends],
        [[[1, 0], [1, 0]], [[1, 0], [0.5, 0.5]], *[[[1, 0]] * 2] * 2],
        initial=[1, 0, 0, 0],
        label=[[0], [0], [1], [0]],
        propositions=["goal"],
    )


def test_moves_within_an_end_component_are_all_kept(crossing):
    found = optimal_actions(product(crossing, "F goal"))
    assert found.allowed.all()
    assert float(found.loss) < 1e-13


def test_what_wide_bounds_let_in_is_found_out(crossing, monkeypatch):
    """Staying gives up a thousandth, which bounds of that width do not show."""
    last = crossing.replace(
        successor=crossing.successor.at[0, 0].set(np.array([0, 3], np.int32)),
        probability=crossing.probability.at[0, 0].set(np.array([0.999, 0.001])),
    )
    model = product(last, "F goal")
    start = int(model.initial_memory[0])
    assert optimal_actions(model).allowed[0, start].tolist() == [False, True]
    best = jl.optimal_satisfaction(model)
    inner = (best.value > 0) & (best.value < 1)
    wide = replace(best, lower=best.lower - 1e-3 * inner, upper=best.upper + 1e-3 * inner)
    lenient = optimal_actions(model, wide, tolerance=0.5)
    assert lenient.allowed[0, start].all()
    assert lenient.status == jl.Status.CONVERGED
    assert 1e-3 < float(lenient.loss) < 0.01
    true_loss = 0.5 - jl.satisfaction_probability(model, lenient.policy).value[0, start]
    assert 1e-4 < float(true_loss) <= float(lenient.loss)
    strict = optimal_actions(model, wide)
    assert strict.allowed[0, start].tolist() == [False, True]
    assert strict.status == jl.Status.CONVERGED
    assert float(strict.loss) < 1e-10
    monkeypatch.setattr(module, "_attaining", lambda *_, **__: None)
    only = optimal_actions(model, wide)
    assert only.allowed[0, start].tolist() == [False, True]
    assert only.status == jl.Status.PRECISION
    assert float(only.loss) == pytest.approx(2e-3)


def test_in_an_accepting_component_no_lesser_priority_is_met_again():
    """Round the loop b (0) holds once more; G a keeps to the cell, and leaving it is final."""
    world = make_mdp(
        [[[0], [1], [2]], [[0], [0], [0]], [[2], [2], [2]]],
        np.ones((3, 3, 1)),
        initial=[1, 0, 0],
        label=[[True, False], [False, False], [False, True]],
        propositions=["a", "b"],
    )
    model = product(world, "F G a | F b")
    start = int(model.initial_memory[0])
    found = optimal_actions(model)
    # To stay, and to go where there is no way back; not to pass through 1 for ever.
    assert found.allowed[0, start].tolist() == [True, False, True]
    assert found.allowed[1].all()
    assert (jl.satisfaction_probability(model, found.policy).value == 1).all()


@pytest.mark.parametrize("task", ["F g", "G !r", "G F g & G F y", "F G g & F y"])
@pytest.mark.parametrize("wide", [False, True])
def test_small_models_compile_nothing(task, wide):
    with jax.enable_x64(wide), counted_programs() as compiled:
        model = jl.product(jl.gridworld("g . r\n. s y", slip=0.2, initial="s"), task)
        for objective in ("max", "min"):
            found = optimal_actions(model, objective=objective)
            assert int(found.status) == jl.Status.CONVERGED
            assert float(found.loss) < (1e-12 if wide else 1e-6)
    assert not compiled


def test_inside_jit_it_is_refused(crossing):
    with pytest.raises(ValueError, match="reads values, so it works on the host only"):
        jax.jit(lambda m: optimal_actions(m).allowed)(product(crossing, "F goal"))
    with pytest.raises(ValueError, match="objective='best'; choose"):
        optimal_actions(product(crossing, "F goal"), objective="best")
