"""The policies of sparse models are the fastest optimal ones, against fractions."""

import copy
import pickle
from fractions import Fraction

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core import deferred
from jaxltl.core.automata.runs import universal_states
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.values.properties.solve_property import solve_property
from tests import reference_fractions
from tests.core.values.undiscounted.test_quickest import random_world


def exact_choices(host):
    """Of each state its rows with distributions, in the fractions that the world was made of."""
    entry, chance = host.entry_start, host.probability
    return [
        [
            (
                r,
                {
                    int(host.successor[e]): Fraction(float(chance[e])).limit_denominator(4000)
                    for e in range(*entry[r : r + 2])
                },
            )
            for r in range(*host.row_start[s : s + 2])
        ]
        for s in range(host.num_states)
    ]


def random_sparse(seed, size=7):
    """Coins and sure steps at random, in which optimal rows tie."""
    rng = np.random.default_rng(seed)
    rows = rng.integers(1, 4, size)
    rows[:2] = 1
    ends = [np.unique(rng.integers(0, size, rng.integers(1, 4))) for _ in range(rows.sum())]
    ends[0], ends[1] = np.array([0]), np.array([1])
    chance = np.concatenate([np.full(x.size, 1 / x.size) for x in ends])
    return jl.make_sparse(
        np.append(0, rows.cumsum()),
        np.append(0, np.cumsum([x.size for x in ends])),
        np.concatenate(ends),
        chance,
        label={"o": [0, 2], "b": [1, 3]},
    )


def worlds(count):
    return [to_sparse(random_world(seed)) for seed in range(count)] + [
        random_sparse(seed) for seed in range(2 * count)
    ]


def require_least_steps(choices, row, target, maximize, stay=None):
    """A policy attains the optimal probability of a target in the least steps, from every state."""
    worth = {int(s): Fraction(1) for s in np.flatnonzero(target)}
    if stay is not None:
        worth |= {int(s): Fraction(0) for s in np.flatnonzero(~stay & ~target)}
    value = reference_fractions.optimum(choices, worth, None, maximize)
    ends = {s for s, v in enumerate(value) if s in worth or not v or (v == 1 and not maximize)}
    ended = dict.fromkeys(ends, Fraction(0))
    optimal = [
        [a for a in some if s in ended or sum(p * value[t] for t, p in a[1].items()) == value[s]]
        for s, some in enumerate(choices)
    ]
    cost = np.ones(sum(map(len, choices)))
    least = reference_fractions.optimum(optimal, ended, cost, False)
    taken = [[a for a in some if a[0] == row[s]] for s, some in enumerate(choices)]
    attained = reference_fractions.optimum(taken, worth, None, True)
    steps = reference_fractions.optimum(taken, ended, cost, False)
    for s in range(len(choices)):
        np.testing.assert_allclose(float(attained[s]), float(value[s]), rtol=1e-9)
        np.testing.assert_allclose(float(steps[s]), float(least[s]), rtol=1e-6)


def require_fastest(found):
    """A co-safe task's policy is the fastest optimal one."""
    host, product = found.product.host, found.product
    goal = universal_states(found.automaton)[product.memory]
    rows = host.first_choice(product.base_row == found.row[host.state])[1]
    require_least_steps(exact_choices(host), rows, goal, True)


def test_policies_of_tasks_on_sparse_models_take_the_least_steps():
    with jax.enable_x64(True):
        for seed in range(8):
            sparse = to_sparse(random_world(seed))
            require_fastest(jl.optimal_satisfaction(sparse, "!o U b"))
            answer = solve_property(sparse, 'Pmax=? [ (F "b") & (!"o" U "b") ]')
            require_fastest(answer.strategy.memory)
            assert (answer.strategy.row == answer.strategy.memory.row).all()
            plain = solve_property(sparse, 'Pmax=? [ !"o" U "b" ]').strategy.row
            found = jl.optimal_satisfaction(sparse, "!o U b", states=np.arange(sparse.num_states))
            live = found.value > 0
            steps = found.product.base_state
            assert (found.row == plain[steps])[live & (found.value < 1)].all()


@pytest.mark.parametrize("objective", ["max", "min"])
def test_policies_of_reachability_take_the_least_steps(objective):
    with jax.enable_x64(True):
        for sparse in worlds(6):
            choices = exact_choices(sparse.host)
            target, hole = sparse.states_with_label("b"), sparse.states_with_label("o")
            for stay in (None, ~hole):
                options = {"objective": objective, "stay": stay}
                found = jl.reachability_probability(sparse, target, **options)
                require_least_steps(choices, found.policy, target, objective == "max", stay)
                loose = jl.reachability_probability(sparse, target, tolerance=0.1, **options)
                assert (loose.policy == found.policy).all()


def test_policies_of_padded_models_with_stay_take_the_least_steps():
    with jax.enable_x64(True):
        for seed in range(3):
            world = random_world(seed)
            sparse = to_sparse(world)
            target, stay = sparse.states_with_label("b"), ~sparse.states_with_label("o")
            action = jl.reachability_probability(world, target, stay=stay).policy
            assert isinstance(action, jax.Array) and action.dtype == np.int32
            taken = np.asarray(action)[sparse.host.state] == np.asarray(sparse.action)
            row = sparse.host.first_choice(taken)[1]
            require_least_steps(exact_choices(sparse.host), row, target, True, stay)


@pytest.mark.parametrize("objective", ["max", "min"])
def test_policies_of_sparse_products_take_the_least_steps(objective):
    with jax.enable_x64(True):
        for sparse in worlds(2):
            for formula in ("!o U b", "F b", "G !o"):
                model = jl.product(sparse, formula)
                policy = jl.optimal_satisfaction(model, objective=objective).policy
                assert policy.shape == model.state_shape and policy.dtype == np.int32
                # The written-out product has the world's rows in the same order.
                host, world = to_sparse(model).host, sparse.host
                state = np.indices(model.state_shape)[0].ravel()
                row = host.row_start[:-1] + policy.ravel() - world.row_start[state]
                final = np.asarray(model.final).ravel()
                target = final if model.automaton.is_cosafe else ~final
                maximize = (objective == "max") == model.automaton.is_cosafe
                require_least_steps(exact_choices(host), row, target, maximize)


@pytest.mark.parametrize("objective", ["max", "min"])
@pytest.mark.parametrize("relative", [False, True])
def test_strategies_of_invariants_take_the_least_steps(objective, relative):
    with jax.enable_x64(True):
        for sparse in worlds(4):
            choices = exact_choices(sparse.host)
            b, o = sparse.states_with_label("b"), sparse.states_with_label("o")
            for path, target, stay in (
                ('G !"o"', o, None),
                ('!"o" W "b"', o & ~b, ~b),
                ('"b" R !"o"', o, ~b),
            ):
                text = f"P{objective}=? [ {path} ]"
                row = solve_property(sparse, text, relative=relative).strategy.row
                require_least_steps(choices, row, target, objective == "min", stay)


@pytest.mark.parametrize("tied", [False, True])
def test_strategies_of_rare_invariants_attain_them(tied):
    # The quickest row avoids the hole half as often as the others, but reaches it as surely up to
    # rounding.
    small = 2.0**-70
    rows = [
        [[(1, small), (3, 1.0)], [(2, 1.0)], [(1, 2 * small), (3, 1.0)]][: 3 if tied else 2],
        [[(1, 1.0)]],
        [[(1, 2 * small), (3, 1.0)]],
        [[(3, 1.0)]],
    ]
    flat = [row for some in rows for row in some]
    world = jl.make_sparse(
        np.cumsum([0, *map(len, rows)]),
        np.cumsum([0, *map(len, flat)]),
        [s for row in flat for s, _ in row],
        [p for row in flat for _, p in row],
        initial=[1, 0, 0, 0],
        label={"o": [3]},
    )
    for path in ('G !"o"', 'G (!"o" & !X "o")'):
        answer = solve_property(world, f"Pmax=? [ {path} ]", relative=True)
        np.testing.assert_allclose(answer.value, 2 * small, rtol=1e-6)
        start = 0 if answer.strategy.memory is None else answer.strategy.memory.product.start[0]
        assert answer.strategy.row[start] == (2 if tied else 1)


def frozen_lake(text):
    """A lake in which a move slips to either side two times in three."""
    lake = np.array([list(line) for line in text.split()])
    height, width = lake.shape
    rows = []
    for y, x in np.ndindex(lake.shape):
        for move in range(4):
            if lake[y, x] in "HG":
                rows.append({y * width + x: 1.0})
                continue
            row = {}
            for turn in (-1, 0, 1):
                dy, dx = ((0, -1), (1, 0), (0, 1), (-1, 0))[(move + turn) % 4]
                end = np.clip(y + dy, 0, height - 1) * width + np.clip(x + dx, 0, width - 1)
                row[int(end)] = row.get(int(end), 0.0) + 1 / 3
            rows.append(dict(sorted(row.items())))
    label = {n: np.flatnonzero(lake.ravel() == c) for n, c in (("hole", "H"), ("goal", "G"))}
    return jl.make_sparse(
        np.arange(0, len(rows) + 1, 4),
        np.cumsum([0, *map(len, rows)]),
        [s for row in rows for s in row],
        [p for row in rows for p in row.values()],
        initial=np.eye(1, lake.size)[0],
        label=label,
    )


LAKE = """
    SFFFFFFF FFFFFFFF FFFHFFFF FFFFFHFF FFFHFFFF FHHFFFHF FHFFHFHF FFFHFFFG
"""


def test_policies_of_a_frozen_lake_take_the_least_steps():
    with jax.enable_x64(True):
        lake = frozen_lake(LAKE)
        host, goal = lake.host, lake.states_with_label("goal")
        found = jl.reachability_probability(lake, goal)
        sure = found.lower == 1
        assert sure[0]
        inside = ~np.bincount(host.row, ~sure[host.successor], host.num_rows).astype(bool)
        steps = np.zeros(64)
        for _ in range(3000):
            ahead = np.where(inside, 1 + host.expectation(steps), np.inf)
            steps = np.where(sure & ~goal, host.over_choices(np.minimum, ahead), 0)
        assert 116 < steps[0] < 119
        model = jl.product(lake, "!hole U goal")
        product = jl.optimal_satisfaction(model).policy[:, model.automaton.initial]
        for row in (found.policy, product):
            chain = host.matrix.toarray()[row][np.ix_(sure & ~goal, sure & ~goal)]
            taken = np.linalg.solve(np.eye(len(chain)) - chain, np.ones(len(chain)))
            np.testing.assert_allclose(taken, steps[sure & ~goal], rtol=1e-6)


def test_policies_are_not_computed_before_they_are_read(monkeypatch):
    def refuse(self):
        raise AssertionError("the policy was read")

    sparse = random_sparse(3)
    target = sparse.states_with_label("b")
    with monkeypatch.context() as patch:
        patch.setattr(deferred.Deferred, "read", refuse)
        solutions = [
            jl.reachability_probability(sparse, target),
            jl.reachability_probability(sparse, target, objective="min", stay=target),
            jl.optimal_satisfaction(jl.product(sparse, "G F b")),
            jl.optimal_satisfaction(jl.product(sparse, "G !o"), objective="min"),
            jl.optimal_satisfaction(sparse, "G !o", states=[4, 5]).solution,
        ]
        for found in solutions:
            later = jl.check(found.replace(status=np.int32(0)))
            assert "policy int32[" in repr(later)
        for relative in (False, True):
            for path in ('F "b"', '"o" U "b"', 'G "b"', '"o" W "b"', '"o" R "b"', 'G F "b"'):
                solve_property(sparse, f"filter(max, Pmax=? [ {path} ])", relative=relative)
                solve_property(sparse, f"filter(min, Pmin=? [ {path} ])", relative=relative)
        with pytest.raises(AssertionError, match="was read"):
            _ = later.policy
    for found in solutions:
        assert found.policy.dtype.kind == "i" and found.policy.shape == np.shape(found.policy)
        assert f"policy int32[{', '.join(map(str, found.policy.shape))}]" in repr(found)


def test_deferred_policies_are_arrays_in_every_use():
    sparse = random_sparse(3)
    target = sparse.states_with_label("b")

    def solve():
        return jl.reachability_probability(sparse, target)

    wanted = solve().policy
    assert isinstance(wanted, np.ndarray)
    uses = (
        lambda s: jax.jit(lambda x: x)(s),
        lambda s: jax.vmap(lambda x: x, axis_size=1, in_axes=None)(s),
        lambda s: jax.tree.map(lambda x: x, s),
        lambda s: jax.tree.unflatten(jax.tree.structure(s), jax.tree.leaves(s)),
        lambda s: pickle.loads(pickle.dumps(s)),
        lambda s: s.replace(status=np.int32(0)),
        copy.copy,
        copy.deepcopy,
    )
    for use in uses:
        used = use(solve()).policy
        np.testing.assert_array_equal(np.asarray(used).reshape(-1, wanted.size)[0], wanted)
    assert solve().policy[4] == wanted[4]
    assert (solve().replace(policy=wanted + 1).policy == wanted + 1).all()
    with pytest.raises(AttributeError):
        solve().policy = wanted
    found = jl.optimal_satisfaction(sparse, "!o U b", states=[4, 5])
    again = pickle.loads(pickle.dumps(found))
    assert isinstance(found.row, np.ndarray) and (again.row == found.row).all()
