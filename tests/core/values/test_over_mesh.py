"""Solvers give of a model over a mesh what they give of the model: values, bounds, statuses."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.games.objective import buchi
from jaxltl.core.games.winning import winning_region
from jaxltl.core.graphs.attractor import almost_surely_reaching, attractor, avoidable
from jaxltl.core.graphs.end_components import bottom_components, end_components
from jaxltl.core.graphs.graph import TracedGraph, components_by_sweeps, graph_of
from jaxltl.core.models.game import Game
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.models.mesh.shard import from_mesh, shard, to_mesh
from jaxltl.core.models.ops.successor_tables import ShardedSuccessorTable, sweep_operator
from jaxltl.core.models.product import product
from jaxltl.core.types import Status
from jaxltl.core.values.discounted.discounted import optimal_value, policy_value
from jaxltl.core.values.discounted.minimax import minimax_value
from jaxltl.core.values.discounted.occupancy import occupancy_measure
from jaxltl.core.values.discounted.soft import boltzmann_value, soft_value
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.satisfaction import (
    optimal_satisfaction,
    satisfaction_probability,
)
from tests.core.models.mesh.test_sharded import A, S, mesh_of, world

MESHES = [
    (4, 2),
    *(
        pytest.param(count, reach, marks=pytest.mark.exhaustive)
        for count in (1, 2, 4)
        for reach in (2, None)
    ),
]
FORMULAS = ("F (a & X F b)", "G F a & F G !b", "G !a")


def quantities(mdp):
    """A reward, a target and a policy."""
    rng, available = np.random.default_rng(0), np.asarray(mdp.available)
    reward = np.where(available, rng.normal(size=(S, A)), 0)
    policy = available * rng.random((S, A))
    return reward, np.asarray(mdp.label)[:, 0], policy / policy.sum(-1, keepdims=True)


class Case:
    """A model, the same over a mesh, and quantities of both."""

    def __init__(self, count, reach, seed=0, ragged=True):
        self.mdp = world(seed, reach, ragged)
        self.sharded = shard(self.mdp, mesh_of(count))
        self.reward, self.target, self.policy = quantities(self.mdp)
        self.system = np.random.default_rng(seed).random(S) < 0.5

    def there(self, x):
        return to_mesh(self.sharded, x)

    def agree(self, one, other, tolerance=1e-9):
        """Both end alike, the bounds of each enclose the value of the other."""
        assert int(one.status) == int(other.status) == Status.CONVERGED
        value, lower, upper = (
            from_mesh(self.sharded, x) for x in (other.value, other.lower, other.upper)
        )
        np.testing.assert_allclose(value, one.value, atol=tolerance, rtol=tolerance)
        assert (lower <= np.asarray(one.upper) + 1e-13).all()
        assert (upper >= np.asarray(one.lower) - 1e-13).all()
        np.testing.assert_allclose(upper - lower, one.upper - one.lower, atol=tolerance)


SOLVERS = {
    "optimal": lambda m, r, t, p: optimal_value(m, r, 0.9),
    "sweeps": lambda m, r, t, p: optimal_value(m, r, 0.9, method="modified_policy_iteration"),
    "policy": lambda m, r, t, p: policy_value(m, p, r, 0.9),
    "soft": lambda m, r, t, p: soft_value(m, r, 0.9),
    "boltzmann": lambda m, r, t, p: boltzmann_value(m, 0.2 * r, 0.5),
    "reach max": lambda m, r, t, p: reachability_probability(m, t),
    "reach min": lambda m, r, t, p: reachability_probability(m, t, objective="min"),
    "reach policy": lambda m, r, t, p: reachability_probability(m, t, policy=p),
}


# Each compiles for a second; by default one of each engine.
USUAL = ("optimal", "reach max")


@pytest.mark.parametrize(
    "solver", [pytest.param(x, marks=[] if x in USUAL else pytest.mark.slow) for x in SOLVERS]
)
@pytest.mark.parametrize(("count", "reach"), MESHES)
def test_solvers(count, reach, solver):
    case = Case(count, reach)
    solve = SOLVERS[solver]
    given = case.reward, case.target, case.policy
    one = solve(case.mdp, *(jnp.asarray(x) for x in given))
    other = jax.jit(solve)(case.sharded, *(case.there(x) for x in given))
    case.agree(one, other)


@pytest.mark.parametrize(
    "solver", ["optimal", *(pytest.param(x, marks=pytest.mark.exhaustive) for x in SOLVERS)]
)
def test_solvers_where_one_table_holds_all(solver):
    case = Case(4, 1, ragged=False)
    assert isinstance(sweep_operator(case.sharded), ShardedSuccessorTable)
    given = case.reward, case.target, case.policy
    one = SOLVERS[solver](case.mdp, *(jnp.asarray(x) for x in given))
    other = jax.jit(SOLVERS[solver])(case.sharded, *(case.there(x) for x in given))
    case.agree(one, other)


@pytest.mark.slow
@pytest.mark.parametrize("formula", FORMULAS)
@pytest.mark.parametrize(("count", "reach"), MESHES)
def test_formulas(count, reach, formula):
    case = Case(count, reach)
    one, other = product(case.mdp, formula), product(case.sharded, formula)
    case.agree(optimal_satisfaction(one), optimal_satisfaction(other))
    if formula != FORMULAS[0]:
        return
    policy = np.repeat(case.policy[:, None], one.num_memory, 1)
    case.agree(
        satisfaction_probability(one, jnp.asarray(policy)),
        satisfaction_probability(other, case.there(policy)),
    )


@pytest.mark.parametrize(("count", "reach"), MESHES)
def test_graphs(count, reach):
    # Tables of another seed have another shape, and so another program.
    for seed in range(1 if (count, reach) == (4, 2) else 3):
        case = Case(count, reach, seed)
        region = np.random.default_rng(seed).random(S) < 0.6
        available, number = np.asarray(case.mdp.available), np.asarray(case.sharded.number)
        one, other = graphs(case.mdp, region), fixpoints(case.sharded, case.there(region))
        for name, found in other.items():
            for x, y in zip(one[name], found, strict=True):
                x, y = np.asarray(x), from_mesh(case.sharded, y)
                if name.endswith("components") and y.ndim == 1:
                    y = number[y]  # components are named by states of the mesh
                if y.ndim == 2:
                    x, y = x & available, y & available
                np.testing.assert_array_equal(x, y, err_msg=name)


def graphs(model, region):
    return {
        "attractor": attractor(model, region)[:2],
        "avoidable": [avoidable(model, region)],
        "surely": almost_surely_reaching(model, region)[:1],
        "end components": end_components(model, region),
        "bottom components": bottom_components(model, _support(model, region)),
    }


fixpoints = jax.jit(graphs)


def _support(model, region):
    """Some choices, at least one in each state."""
    if isinstance(region, np.ndarray):
        odd = region[:, None] & np.array([True, False])
        return np.where(odd.any(-1, keepdims=True), odd, np.asarray(model.available))
    odd = region[:, None] & jnp.array([True, False])
    return jnp.where(odd.any(-1, keepdims=True), odd, model.available)


@pytest.mark.slow
@pytest.mark.parametrize("count", [5, pytest.param(300, marks=pytest.mark.exhaustive)])
def test_components_by_sweeps_are_those_of_the_host(count):
    for seed in range(count):
        mdp = world(seed, [1, 2, None][seed % 3])
        for formula in (None, "G F a & F G !b", "F (a & X F b)"):
            model = (
                mdp
                if formula is None
                else product(mdp, formula, label_on=("entry", "exit")[seed % 2])
            )
            rng = np.random.default_rng(seed)
            shape = model.state_shape
            host, core = graph_of(model), rng.random(shape) < 0.8
            some = (rng.random((*shape, A)) < 0.8) & host.available
            stays = some & host.forall(core) & host.on_choices(core)
            for which, allowed, closed in (
                (core, stays, False),
                (np.ones(shape, bool), some, True),
            ):
                one = host.components(which, allowed, closed)
                other = swept(TracedGraph(model), which, allowed, closed)
                for x, y in zip(one, other, strict=True):
                    np.testing.assert_array_equal(x, y)


swept = jax.jit(components_by_sweeps, static_argnums=3)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "reach"), MESHES)
def test_games_and_occupancy(count, reach):
    case = Case(count, reach)
    one = Game(case.mdp, jnp.asarray(case.system))
    other = Game(case.sharded, case.there(case.system))
    # Operation by operation it takes a hundred small programs.
    solve = jax.jit(games_and_occupancy) if (count, reach) == (4, 2) else games_and_occupancy
    value, region, visits = solve(
        other, buchi(other, "a"), case.there(case.reward), case.there(case.policy)
    )
    case.agree(minimax_value(one, jnp.asarray(case.reward), 0.9), value)
    np.testing.assert_array_equal(
        from_mesh(case.sharded, region), winning_region(one, buchi(one, "a")).region
    )
    np.testing.assert_allclose(
        from_mesh(case.sharded, visits),
        occupancy_measure(case.mdp, jnp.asarray(case.policy), 0.9).value,
        atol=1e-9,
    )


wins = jax.jit(lambda game, goal: winning_region(game, goal).region)


def games_and_occupancy(game, goal, reward, policy):
    """The values, who wins and the visits."""
    return (
        minimax_value(game, reward, 0.9),
        wins(game, goal),
        occupancy_measure(game.mdp, policy, 0.9).value,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("count", "reach"), MESHES)
def test_gradients(count, reach):
    case = Case(count, reach)
    weight = np.random.default_rng(3).normal(size=S)

    def discounted(reward, policy, model, weight):
        return jnp.sum(weight * soft_value(model, reward, 0.9).value) + jnp.sum(
            weight * policy_value(model, policy, reward, 0.8).value
        )

    slope = jax.jit(jax.grad(discounted, argnums=(0, 1)))
    here = slope(jnp.asarray(case.reward), jnp.asarray(case.policy), case.mdp, weight)
    there = slope(
        case.there(case.reward), case.there(case.policy), case.sharded, case.there(weight)
    )
    for x, y in zip(here, there, strict=True):
        np.testing.assert_allclose(
            from_mesh(case.sharded, y) * case.mdp.available, x * case.mdp.available, atol=1e-8
        )


@pytest.mark.slow
@pytest.mark.parametrize(("count", "reach"), MESHES)
def test_derivatives_in_the_probabilities(count, reach):
    case = Case(count, reach)
    weight = np.random.default_rng(3).normal(size=S)
    mdp = case.mdp
    other = np.random.default_rng(4).random(mdp.probability.shape) * (mdp.probability > 0)
    total = other.sum(-1, keepdims=True)
    other = make_mdp(
        mdp.successor,
        np.where(total > 0, other / np.maximum(total, 1e-9), 0),
        available=mdp.available,
        label=mdp.label,
        propositions=mdp.propositions,
    )
    there = shard(other, case.sharded.mesh)

    def slope(share, models, reward, target, weight):
        def value(share):
            one, two = models
            parts = ("tables",) if hasattr(one, "tables") else ("probability",)
            mixed = one.replace(
                **{
                    name: jax.tree.map(
                        lambda x, y: x if x.dtype == np.int32 else (1 - share) * x + share * y,
                        getattr(one, name),
                        getattr(two, name),
                    )
                    for name in parts
                }
            )
            return jnp.sum(
                weight
                * (
                    reachability_probability(mixed, target).value
                    + optimal_value(mixed, reward, 0.8).value
                )
            )

        return jax.grad(value)(share)

    slope = jax.jit(slope)
    one = slope(0.3, (mdp, other), case.reward, case.target, weight)
    two = slope(
        0.3, (case.sharded, there), *(case.there(x) for x in (case.reward, case.target, weight))
    )
    np.testing.assert_allclose(two, one, rtol=1e-8)
