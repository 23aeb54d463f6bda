"""Games on sparse models: regions of the padded games, and the checker on rows of both."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.games.winning import solve
from jaxltl.core.models.compiled import compiled_form
from tests.sparse_models import random_sparse

COUNT, GAMES = 7, 40
SPECS = {
    "parity": lambda game, x: jl.games.parity(
        game, x["priority"], safe=x["safe"], num_priorities=4
    ),
    "reach": lambda game, x: jl.games.reach(game, "a", safe=x["safe"]),
    "gr1": lambda game, x: jl.games.gr1(game, ["a"], ["b", "!a"], safe=x["safe"]),
    "recurrence": lambda game, x: "G F a",
    "either": lambda game, x: "F G a | G F b",
    "until": lambda game, x: "a U b",
}


@cache
def games():
    """Pairs of a sparse game and its padded one, with priorities and safe states."""
    found = []
    rng = np.random.default_rng(0)
    for _ in range(GAMES):
        model = random_sparse(
            rng, COUNT, most=4, width=2, label=rng.random((COUNT, 2)) < 0.4, propositions=["a", "b"]
        )
        system = rng.random(COUNT) < 0.5
        sets = {"priority": rng.integers(4, size=COUNT), "safe": rng.random(COUNT) < 0.8}
        found.append((jl.make_game(model, system), jl.make_game(jl.to_padded(model), system), sets))
    return found


@cache
def won(name):
    return [
        (
            jl.winning_region(game, SPECS[name](game, x)),
            jl.winning_region(padded, SPECS[name](padded, x)),
        )
        for game, padded, x in games()
    ]


@pytest.mark.few(2)
@pytest.mark.parametrize("name", SPECS)
def test_regions_are_those_of_the_padded_game_and_strategies_win(name):
    some = []
    for found, expected in won(name):
        np.testing.assert_array_equal(found.region, expected.region)
        assert jl.verify(found)
        form = compiled_form(found.game)[0].mdp
        for action in (found.action, found.counter_action):
            rows = np.asarray(action).reshape(form.num_states, -1)
            np.testing.assert_array_equal(
                form.host.state[rows], np.arange(form.num_states)[:, None] + 0 * rows
            )
        some.append(np.asarray(found.region).mean())
    assert 0 < np.mean(some) < 1


@pytest.mark.few(2)
@pytest.mark.parametrize("name", SPECS)
def test_the_checker_refutes_the_same_strategies_of_both(name):
    """One action is changed, of either player: the verdicts on rows and actions are the same."""
    rng, refuted = np.random.default_rng(1), 0
    for found, expected in won(name):
        form = compiled_form(found.game)[0].mdp
        state, start = form.host.state, form.row_start
        column = np.arange(form.num_rows) - start[state]

        def as_actions(rows, column=column):
            return jnp.asarray(column[rows].astype(np.int32))

        for field in ("action", "counter_action"):
            s = rng.choice(np.flatnonzero(np.diff(start) > 1))
            rows = np.array(getattr(found, field)).reshape(form.num_states, -1)
            for row in range(*start[s : s + 2]):
                changed = rows.copy()
                changed[s] = row
                shaped = changed.reshape(np.shape(getattr(found, field)))
                parts = {f: np.asarray(getattr(found, f)) for f in ("action", "counter_action")}
                parts[field] = shaped
                one = jl.verify(found.replace(**{field: shaped}))
                other = jl.verify(expected.replace(**{f: as_actions(x) for f, x in parts.items()}))
                assert one[:2] == other[:2]
                refuted += not one
    assert refuted


def test_what_is_no_row_of_a_state_is_refused_by_name():
    found, _ = next(
        x for x in won("parity") if (np.asarray(x[0].region) & np.asarray(x[0].game.system)).any()
    )
    inside = np.asarray(found.region & found.game.system & ~found.objective.won)
    state = int(np.flatnonzero(inside)[0])
    for row in (-1, found.game.mdp.num_rows, int(found.game.mdp.row_start[state] - 1)):
        action = np.array(found.action)
        action[state] = row
        assert (
            f"{row} is not available in state {state}"
            in jl.verify(found.replace(action=action)).reason
        )


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["parity", "gr1", "either"])
def test_inside_jit_the_answers_are_the_hosts(name):
    compiled = jax.jit(solve)
    found, _ = won(name)[0]
    for flip in (False, True):  # of one shape, for which one program is compiled
        game = found.game.replace(system=found.game.system ^ flip)
        found, traced = solve(game, found.objective), compiled(game, found.objective)
        for field in ("region", "action", "counter_action"):
            np.testing.assert_array_equal(getattr(found, field), getattr(traced, field))


def test_adversarial_chance_pads():
    for game, padded, x in games()[:5]:
        one, other = (
            jl.winning_region(g, SPECS["parity"](g, x), chance="adversarial")
            for g in (game, padded)
        )
        np.testing.assert_array_equal(one.region, other.region)


def test_mean_payoffs_are_those_of_the_padded_game():
    rng = np.random.default_rng(2)
    for _ in range(10):
        model = random_sparse(rng, COUNT, most=3, width=1)
        padded, system = jl.to_padded(model), rng.random(COUNT) < 0.5
        column = np.arange(model.num_rows) - model.row_start[model.host.state]
        reward = rng.integers(-3, 4, model.num_rows).astype(float)
        wide = np.zeros((COUNT, padded.num_actions))
        wide[model.host.state, column] = reward
        found = jl.values.mean_payoff(jl.make_game(model, system), reward)
        expected = jl.values.mean_payoff(jl.make_game(padded, system), wide)
        np.testing.assert_array_equal(found.value, expected.value)
        np.testing.assert_array_equal(column[np.asarray(found.policy)], expected.policy)


@pytest.mark.parametrize(
    "name", ["attractor", "against chance", "avoidable", "almost surely", "end components"]
)
def test_graphs_inside_jit_are_the_hosts(name):
    ask = {
        "attractor": lambda m, x: jl.graphs.attractor(m, x),
        "against chance": lambda m, x: jl.graphs.attractor(m, x, rule="forall", chance="all"),
        "avoidable": lambda m, x: jl.graphs.avoidable(m, x),
        "almost surely": lambda m, x: jl.graphs.almost_surely_reaching(m, x),
        "end components": lambda m, x: jl.graphs.end_components(m, ~x),
    }[name]
    compiled, rng = jax.jit(ask), np.random.default_rng(3)
    model = games()[0][0].mdp
    for _ in range(5):
        goal = rng.random(COUNT) < 0.4
        jax.tree.map(np.testing.assert_array_equal, compiled(model, goal), ask(model, goal))
