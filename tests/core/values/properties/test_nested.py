"""Nested properties, variables and filters: as with labels that are made by hand."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl import solve_property
from jaxltl.core.logic.properties import parse_property
from jaxltl.core.types import Status
from jaxltl.core.values.properties.solve_on_mesh import _reward


def model(seed=0, count=9, chain=False):
    rng = np.random.default_rng(seed)
    rows = np.arange(count) if chain else np.repeat(np.arange(count), 2)
    transition = rng.dirichlet(np.full(count, 0.2), len(rows))
    transition = np.where(transition < 0.02, 0, transition)
    transition /= transition.sum(1, keepdims=True)
    row, successor = np.nonzero(transition)
    return jl.make_sparse(
        None if chain else np.arange(0, 2 * count + 1, 2),
        np.concatenate([[0], np.cumsum((transition > 0).sum(1))]),
        successor,
        transition[row, successor],
        initial=np.eye(count)[0],
        label={"a": [3, 5], "b": [1, 2, 7]},
        valuation={"x": rng.integers(0, 5, count), "y": rng.integers(0, 3, count) / 2},
        rewards={"r": jl.models.Rewards(state=rng.integers(0, 3, count).astype(float))},
    )


def labelled(world, **masks):
    label = np.column_stack([np.asarray(world.label), *masks.values()])
    return replace(world, label=label, propositions=(*world.propositions, *masks))


def values(world, text):
    return solve_property(world, text, states=range(world.num_states))


@pytest.mark.parametrize("chain", [False, True])
@pytest.mark.parametrize("form", ['Pmax{} [ X "a" ]', 'Pmin{} [ F<=4 "b" ]', 'Tmin{} [ F "b" ]'])
def test_a_nested_property_is_a_label_of_its_states(form, chain):
    world = model(1, chain=chain)
    middle = np.median(values(world, form.format("=?")).value) + 1e-4
    inner = form.format(f">={middle:.6f}")
    holds = np.array(values(world, inner).holds)
    assert 0 < holds.sum() < len(holds)
    known = labelled(world, good=holds)
    for text in ("Pmax=? [ F {} ]", "Pmin=? [ G F ({} | !{}) ]", 'Pmax=? [ "b" U<=5 !{} ]'):
        found = values(world, text.format(*[inner] * 2))
        expected = values(known, text.format(*['"good"'] * 2))
        np.testing.assert_array_equal(found.value, expected.value)
    twice = solve_property(world, f"Pmax=? [ F P>=0.1 [ F ({inner} & x>0) ] ]")
    more = np.array(values(known, 'P>=0.1 [ F ("good" & x>0) ]').holds)
    assert twice.value == solve_property(labelled(world, v=more), 'Pmax=? [ F "v" ]').value


@pytest.mark.parametrize(
    "text, mask",
    [
        ("x=2", lambda x, y: x == 2),
        ("(x+1)*2 > 4 & !(y!=0.5)", lambda x, y: ((x + 1) * 2 > 4) & (y == 0.5)),
        ("-x <= -3 | x/2-y>=1", lambda x, y: (-x <= -3) | (x / 2 - y >= 1)),
        ('(x - 2*y)<1 => "a"', lambda x, y: ~(x - 2 * y < 1) | np.isin(np.arange(9), [3, 5])),
    ],
)
def test_variables_are_compared(text, mask):
    world = model(2)
    x, y = (np.asarray(world.valuation[name]) for name in "xy")
    known = labelled(world, m=mask(x, y))
    for outer in ("Pmax=? [ F ({}) ]", "Pmin=? [ G F ({}) ]", "LRAmax=? [ {} ]"):
        found = values(world, outer.format(text))
        np.testing.assert_array_equal(found.value, values(known, outer.format('"m"')).value)
    ends = jl.make_interval(world, world.probability, world.probability)
    robust = solve_property(ends, f"Pmaxmin=? [ F ({text}) ]")
    np.testing.assert_allclose(
        robust.value, solve_property(known, 'Pmax=? [ F "m" ]').value, atol=1e-6
    )


def test_filters_aggregate_over_states():
    world = model(3)
    part = np.asarray(world.valuation["x"]) > 0
    for prop in ('Pmax=? [ F "a" ]', "Rmin=? [ C<=3 ]"):
        every = values(world, prop).value
        for kind, of in (("min", np.min), ("max", np.max), ("avg", np.mean), ("sum", np.sum)):
            found = solve_property(world, f"filter({kind}, {prop}, x>0)")
            assert found.lower[0] <= of(every[part]) + 1e-6
            assert found.upper[0] >= of(every[part]) - 1e-6
            assert found.lower <= found.value <= found.upper and found.status == Status.CONVERGED
            assert found.upper - found.lower <= 1e-6 * max(1, found.upper[0])
        spread = solve_property(world, f"filter(range, {prop})")
        ends = np.array([every.min(), every.max()])
        np.testing.assert_allclose(spread.value, ends, atol=1e-6)
        assert (spread.lower <= ends).all() and (ends <= spread.upper).all()
        assert spread.status == Status.CONVERGED and spread.states.tolist() == [-1, -1]
        least = solve_property(world, f"filter(min, {prop}, x>0)")
        assert every[least.states[0]] == every[part].min()
        shown = solve_property(world, f"filter(print, {prop}, x>0)")
        assert shown.states.tolist() == np.flatnonzero(part).tolist()
        first = solve_property(world, f"filter(first, {prop}, x>0)")
        assert (first.states[0], first.value[0]) == (shown.states[0], shown.value[0])


def test_filters_of_truth_values():
    world = model(4)
    holds = np.array(values(world, 'Pmax>=0.4 [ F<=2 "a" ]').holds)
    assert 0 < holds.sum() < 9
    count = solve_property(world, 'filter(count, Pmax>=0.4 [ F<=2 "a" ])')
    assert count.value == count.lower == count.upper == holds.sum() and count.states == [-1]
    assert solve_property(world, 'filter(forall, "a" => x>=0)').holds == [True]
    assert solve_property(world, 'filter(forall, Pmax>=0.4 [ F<=2 "a" ])').holds == [False]
    assert solve_property(world, 'filter(exists, Pmax>=0.4 [ F<=2 "a" ] & "b", x<9)').holds == [
        bool((holds & np.isin(np.arange(9), [1, 2, 7])).any())
    ]
    assert solve_property(world, "filter(exists, x>100)").holds == [False]


def test_an_open_verdict_stays_open():
    coin = jl.make_sparse(  # two choices with the same chances
        [0, 2, 3, 4], [0, 2, 4, 5, 6], [1, 2, 1, 2, 1, 2], [0.5] * 4 + [1, 1], label={"a": [1]}
    )
    open_ = 'P>=0.5 [ (F "a") & (F G "a") ]'
    if solve_property(coin, open_).holds[0] is not None:
        pytest.skip("the bounds decide it")
    with pytest.raises(ValueError, match="is not decided in state 0"):
        solve_property(coin, f"Pmax=? [ F {open_} ]")
    # One false state decides "forall", one true state "exists"; the count has bounds.
    assert solve_property(coin, f"filter(forall, {open_})").holds == [False]
    assert solve_property(coin, f"filter(exists, {open_})").holds == [True]
    known = solve_property(coin, f'filter(forall, {open_}, !"a" & P>0 [ F "a" ])')
    assert known.holds == [None] and known.status == Status.PRECISION
    count = solve_property(coin, f"filter(count, {open_})")
    assert (count.lower, count.upper, count.status) == (1, 2, Status.PRECISION)


@pytest.mark.parametrize(
    "text, message",
    [
        ("P>=1 [ F z=1 ]", "z=1 mentions z, which is no variable of the model; it has x, y"),
        ("P>=1 [ F x/y>1 ]", "x/y>1 divides by zero"),
        ('filter(min, Pmax=? [ F "a" ], x>100)', "no state satisfies"),
    ],
)
def test_mistakes_are_named(text, message):
    with pytest.raises(ValueError, match=message):
        solve_property(model(), text)
    with pytest.raises(ValueError, match="leave states out"):
        solve_property(model(), 'filter(min, Pmax=? [ F "a" ])', states=[0])


@pytest.mark.parametrize("names", [("",), ("x",), ("", "x"), ("x", ""), ("x", "y"), ()])
def test_a_reward_without_a_name_is_the_unnamed_or_the_only_one(names):
    """In properties, solvers and over a mesh alike; else all names are listed."""
    rewards = {n: jl.models.Rewards(state=[float(i + 1), 0, 0]) for i, n in enumerate(names)}
    world = jl.make_sparse(
        None, range(4), [1, 2, 2], [1, 1, 1], initial=[1, 0, 0], label={"a": [2]}, rewards=rewards
    )
    sharded = jl.models.shard(world, jax.make_mesh((1,), ("states",)))
    target = np.arange(3) == 2
    asked = {
        "property": lambda: solve_property(world, 'R=? [ F "a" ]').value[0],
        "steps": lambda: solve_property(world, "R=? [ C<=3 ]").value[0],
        "average": lambda: solve_property(world, "R=? [ S ]").value[0] + expected,
        "several": lambda: solve_property(world, 'multi(Rmax=? [ F "a" ], P>=0 [ F "a" ])').value,
        "mesh": lambda: _reward(sharded, parse_property('R=? [ F "a" ]'))[0, 0],
        "total_reward": lambda: jl.total_reward(world, None, target).value[0],
        "cumulative_reward": lambda: jl.values.cumulative_reward(world, None, 3).value[0],
    }
    expected = names.index("") + 1 if "" in names else 1
    for name, ask in asked.items():
        if "" in names or len(names) == 1:
            assert ask() == pytest.approx(expected), name
        else:
            with pytest.raises(ValueError, match=", ".join(map(repr, names)) or "none"):
                ask()
