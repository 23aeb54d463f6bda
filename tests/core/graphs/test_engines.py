"""The host and the traced sweeps give one answer, bit for bit, and the host compiles nothing."""

from contextlib import contextmanager
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.automata.automaton import make_automaton
from jaxltl.core.games.objective import GR1, Parity
from jaxltl.core.graphs.end_components import (
    accepting_bottom_components,
    accepting_end_components,
    bottom_components,
)
from jaxltl.core.models.game import Game
from jaxltl.core.models.mdp import MDP, from_dense, make_mdp, to_dense
from jaxltl.core.models.product import product
from tests import reference
from tests.support import as_mdp, bit_labels, lane, stack

KINDS = ("sparse", "dense", "entry", "exit")
COUNT, PRIORITIES = 60, 4


def random_model(rng, kind):
    """A model of a kind with three world states or six, and a parity automaton in products."""
    lazy = kind in ("entry", "exit")
    world = reference.random_model(rng, 3 if lazy else 6, 2, 2)
    if not lazy:
        mdp = as_mdp(world)
        return to_dense(mdp) if kind == "dense" else mdp
    names = ("a", "b")
    automaton = make_automaton(
        rng.integers(2, size=(2, 4)),
        0,
        bit_labels(np.arange(4), 2),
        names,
        priority=rng.integers(PRIORITIES, size=(2, 4)),
    )
    letter = rng.integers(4, size=3)
    mdp = as_mdp(world, label=bit_labels(letter, 2), propositions=names)
    return product(mdp, automaton, label_on=kind)


def random_case(rng, kind):
    """Everything that the questions of graphs and games ask about."""
    model = random_model(rng, kind)
    shape, num_actions = model.state_shape, model.num_actions
    draw = lambda share, *more: rng.random((*more, *shape)) < share  # noqa: E731
    allowed = rng.random((*shape, num_actions)) < 0.85
    policy = rng.random((*shape, num_actions)) * (rng.random((*shape, num_actions)) < 0.7)
    won, lost = draw(0.15), draw(0.15)
    return {
        "model": model,
        "goal": draw(0.3),
        "allowed": allowed,
        "rule": draw(0.5),
        "among": draw(0.8),
        "region": draw(0.9),
        "policy": policy,
        "system": draw(0.5),
        "parity": Parity(
            rng.integers(PRIORITIES, size=shape, dtype=np.int32), won, lost, PRIORITIES
        ),
        "gr1": GR1(draw(0.4, 2), draw(0.4, 2), draw(0.1)),
    }


def answers(case, kind):
    """Every answer about a graph or a game; ranks are masked where they mean nothing."""
    model, goal, allowed = case["model"], case["goal"], case["allowed"]
    found = {
        f"attractor, {chance}": jl.graphs.attractor(
            model, goal, allowed, rule=case["rule"], among=case["among"], chance=chance
        )
        for chance in ("some", "all")
    }
    found["attractor"] = jl.graphs.attractor(model, goal)
    found["avoidable"] = jl.graphs.avoidable(model, goal)
    found["almost surely"] = jl.graphs.almost_surely_reaching(model, goal, allowed)
    found["end components"] = jl.graphs.end_components(model, case["region"], allowed)
    found["bottom components"] = bottom_components(model, allowed)
    if kind in ("entry", "exit"):
        found["accepting"] = accepting_end_components(model)
        found["accepted"] = accepting_bottom_components(model, case["policy"])
    game = Game(model, case["system"])
    # Reactivity takes long to compile, and asks nothing else of a model.
    for name in ("parity", "gr1") if kind == "exit" else ("parity",):
        won = jl.winning_region(game, case[name])
        found[name] = (won.region, won.action, won.counter_action)
    return found


def assert_equal(one, other, note):
    flat, structure = jax.tree.flatten_with_path(one)
    again, other_structure = jax.tree.flatten(other)
    assert structure == other_structure
    for (path, x), y in zip(flat, again, strict=True):
        np.testing.assert_array_equal(x, y, err_msg=f"{note}: {jax.tree_util.keystr(path)}")


@contextmanager
def counted_programs():
    """The list of programs that are compiled meanwhile grows in the yielded list."""
    compiled = []

    def listener(event, _, **details):
        if event.endswith("backend_compile_duration"):
            compiled.append(details.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(listener)
    try:
        yield compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listener)


def with_garbage(model, rng, *, wild):
    """The model with nonsense where nothing is possible: unavailable actions and padding."""
    lazy = getattr(model, "mdp", None)
    world = model if lazy is None else lazy
    unavailable = ~np.asarray(world.available)[..., None]
    if isinstance(world, MDP):
        used = (np.asarray(world.probability) > 0) & ~unavailable
        low, high = (-(10**6), 10**6) if wild else (0, world.num_states)
        noise = rng.integers(low, high, used.shape, dtype=np.int32)
        world = world.replace(successor=np.where(used, world.successor, noise))
    name = "probability" if isinstance(world, MDP) else "transition"
    weight = np.asarray(getattr(world, name))
    noise = rng.choice([0.3, 1.0, np.inf, np.nan, -1.0], weight.shape)
    world = world.replace(**{name: np.where(unavailable, noise, weight)})
    return jax.tree.map(jax.device_put, world if lazy is None else model.replace(mdp=world))


@pytest.mark.few(1, 1)
@pytest.mark.parametrize("kind", KINDS)
def test_the_host_and_the_traced_sweeps_are_one(kind):
    """On every question, and whatever unavailable actions and padding hold."""
    rng = np.random.default_rng(KINDS.index(kind))
    cases = [random_case(rng, kind) for _ in range(COUNT)]
    spoiled = [{**case, "model": with_garbage(case["model"], rng, wild=False)} for case in cases]
    traced = jax.jit(jax.vmap(partial(answers, kind=kind)))
    one, other = (jax.tree.map(np.asarray, traced(stack(x))) for x in (cases, spoiled))
    assert_equal(one, other, "traced, with nonsense where nothing is possible")
    for i, case in enumerate(cases):
        host = answers(case, kind)
        assert_equal(host, lane(one, i), f"case {i}")
        wild = {**case, "model": with_garbage(case["model"], rng, wild=True)}
        assert_equal(answers(wild, kind), host, f"case {i}, nonsense")


def test_nothing_is_compiled_on_the_host():
    """Shapes that no other test has, and everything that is decided on a graph."""
    rng = np.random.default_rng(9)
    size = 23
    transition = np.zeros((size, 3, size))
    for s, a in np.ndindex(size, 3):
        transition[s, a, rng.choice(size, 2, replace=False)] = 0.5
    label = rng.random((size, 2)) < 0.4
    goal = np.arange(size) < 2
    done = []
    with counted_programs() as compiled:

        def settled(name, value):
            assert not compiled, f"{name}: {compiled}"
            done.append(name)
            return value

        world = settled("from_dense", from_dense(transition, label=label, propositions="ab"))
        game = settled("make_game", jl.make_game(world, rng.random(size) < 0.6))
        settled(
            "make_mdp", make_mdp(*(np.asarray(x) for x in (world.successor, world.probability)))
        )
        settled("to_dense", to_dense(world))
        settled("gridworld", jl.gridworld("S..\n.#.\n..g"))
        lazy = settled("product", product(world, "G F a & F b"))
        settled("product of a game", product(game, "G F a", label_on="exit"))
        for name in ("available", "initial", "initial_memory", "next_memory"):
            settled(name, getattr(lazy, name))
        settled("final", product(world, "F a").final)
        settled("restrict", jl.restrict(lazy))
        for model in (world, to_dense(world), game):
            settled("attractor", jl.graphs.attractor(model, goal, chance="all"))
            settled("avoidable", jl.graphs.avoidable(model, goal))
            settled("almost_surely_reaching", jl.graphs.almost_surely_reaching(model, goal))
            settled("end_components", jl.graphs.end_components(model, ~goal))
        settled("accepting_end_components", accepting_end_components(lazy))
        uniform = np.full((*lazy.state_shape, 3), 1 / 3)
        settled("accepting_bottom_components", accepting_bottom_components(lazy, uniform))
        reactive = jl.games.gr1(game, ["a"], ["b", "!a"])
        specs = (
            jl.games.safety(game, "true"),
            jl.games.reach(game, "a", safe="!b | a"),
            jl.games.buchi(game, "a"),
            jl.games.cobuchi(game, "a | b"),
            reactive,
            "F G a | G F b",
            "F a",
            jl.games.parity(game, rng.integers(4, size=size)),
        )
        for spec in specs:
            found = settled("winning_region", jl.winning_region(game, spec))
            settled("realizable", found.realizable)
            settled("verify", jl.verify(found))
        settled("adversarial", jl.winning_region(game, "G F a", chance="adversarial"))
        settled("almost_sure_buchi", jl.games.almost_sure_buchi(world, "a"))
        easy = jl.make_game(
            from_dense(np.roll(np.eye(size), 1, 0)[:, None], label=label, propositions="ab"),
            np.ones(size, bool),
        )
        for spec, options in (
            ("G (a | !a)", {}),
            (jl.games.buchi(easy, "a"), {"method": "rank"}),
            (jl.games.buchi(easy, "a"), {"method": "counter", "bound": 20}),
            (jl.games.parity(easy, 1 - label[:, 0]), {"method": "parity"}),
            (jl.games.reach(easy, "a"), {}),
            (jl.games.gr1(easy, ["a"], ["b"]), {"method": "rank"}),
            ("G F a & F b", {}),
        ):
            strategy = settled("permissive", jl.permissive_strategy(easy, spec, **options))
            settled("apply_strategy", jl.games.apply_strategy(strategy))
            available = np.asarray(strategy.game.available)
            policy = available / available.sum(-1, keepdims=True)
            settled("shield", jl.games.shield_policy(policy, strategy.allowed))
    assert len(set(done)) > 20


def test_a_model_of_ones_own_is_asked_by_its_primitives():
    """What is no world of rows is answered by the sweeps, outside of ``jit`` too."""

    class Line:
        """States in a row, the last one a loop; the only action goes on."""

        state_shape, num_actions = (4,), 1
        available = jnp.ones((4, 1), bool)

    @jl.models.exists_successor.register
    def _(model: Line, region):
        return jnp.append(region[1:], region[-1])[:, None]

    jax.tree_util.register_pytree_node(Line, lambda _: ((), None), lambda *_: Line())
    found = jl.graphs.attractor(Line(), jnp.arange(4) == 2)
    assert found.region.tolist() == [True, True, True, False]
    assert jl.graphs.avoidable(Line(), jnp.arange(4) == 2).tolist() == [False, False, False, True]
