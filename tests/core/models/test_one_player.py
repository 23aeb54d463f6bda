"""No function that is for one player answers for a game, as if the environment helped."""

import inspect
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models import Game

# Those that know who moves; the cells of tests/core/values/test_matrix.py test their answers.
FOR_GAMES = {
    "minimax_value", "strategy_value", "mean_payoff", "average_reward", "reachability_probability",
    "total_reward", "optimal_value", "policy_value", "satisfaction_probability", "optimal_satisfaction",
    "bounded_reachability", "next_probability", "cumulative_reward", "instantaneous_reward",
    "reward_bounded_reachability", "solve_property", "winning_region", "permissive_strategy",
    "verify", "almost_sure_buchi", "almost_surely_reaching", "avoidable",
}  # fmt: skip
# Analyses of the graph and operations on models, which are not about who chooses.
NOT_ABOUT_CHOICE = {
    "attractor", "end_components", "lift_policy", "project_policy", "with_allowed", "restrict",
    "expectation", "pushforward", "exists_successor", "forall_successor", "sample_successor",
    "make_trajectories", "rollout", "lift_trajectories", "project_trajectories", "make_counts",
    "align_counts", "states_with_label", "reach", "safety", "buchi", "cobuchi",
    "gr1", "parity", "shard", "to_mesh", "make_game", "make_multiplayer_game", "make_parametric", "make_pomdp",
    "choice_reward",
    "occurring_letters", "make_interval", "stack_products", "write_model",
    "tabulate_policy", "model_from_parts", "from_mesh", "to_sparse", "to_padded", "apply_strategy",
}  # fmt: skip

GOAL = np.array([False, False, True])
GIVEN = {
    "target": GOAL, "goal": GOAL, "region": GOAL, "states": GOAL,
    "policy": np.zeros(3, np.int32), "policies": np.zeros(3, np.int32),
    "reward": np.ones((3, 2)), "discount": 0.9, "num_steps": 2, "num_step": 2, "bound": 2.0,
    "value": np.zeros(3), "prop": 'Pmax=? [ F "b" ]', "objectives": [], "solution": None,
    "counts": None, "formula": "F b", "confidence": 0.9, "graph": "given", "sizes": [1],
    "features": np.zeros((3, 2, 1)), "actions": None, "key": None,
}  # fmt: skip


def functions():
    """The public functions whose first argument is a model, by name."""
    for module in (jl, jl.values, jl.graphs, jl.models, jl.games):
        for name in dir(module):
            function = getattr(module, name)
            if name.startswith("_") or not inspect.isfunction(function):
                continue
            first = next(iter(inspect.signature(function).parameters), None)
            if first in ("model", "models"):
                yield name, function


SOLVERS = dict(functions())


def game(kind):
    world = jl.make_mdp(
        [[[1, 2], [2, 1]], [[0, 2], [1, 0]], [[2, 2]] * 2],
        [[[0.5, 0.5], [1, 0]], [[0.5, 0.5], [1, 0]], [[1, 0]] * 2],
        label={"b": [2]},
        initial=[1, 0, 0],
    )
    if kind == "sparse":
        world = jl.to_sparse(world)
    if kind == "interval":
        used = np.asarray(world.probability) > 0
        world = jl.make_interval(world, 0 * used, 1 * used)
    found = jl.make_game(world, [True, False, True])
    return jl.product(found, "F b") if kind == "product" else found


@pytest.mark.parametrize("name", sorted(SOLVERS.keys() - FOR_GAMES - NOT_ABOUT_CHOICE))
def test_games_are_refused_by_solvers_for_one_player(name):
    solve = SOLVERS[name]
    required = [
        p.name
        for p in list(inspect.signature(solve).parameters.values())[1:]
        if p.default is p.empty and p.kind is not p.VAR_KEYWORD
    ]
    given = {x: GIVEN[x] for x in required}
    for kind in ("padded", "sparse", "interval", "product"):
        model = game(kind)
        refused(solve, model, **given)
        if "stay" in inspect.signature(solve).parameters:
            refused(solve, model, **given, stay=~GOAL)
        if kind != "interval":
            traced = partial(solve, **given)
            batch = jax.tree.map(lambda x: jnp.stack([x, x]), model)
            refused(partial(jax.eval_shape, traced), model, name=name)
            refused(partial(jax.eval_shape, jax.vmap(traced)), batch, name=name)


def refused(solve, model, name=None, **given):
    name = solve.__name__ if name is None else name
    with pytest.raises(ValueError, match=rf"^{name}: models? is a Game, .*ask for .*game"):
        solve(model, **given)


def test_conversions_name_the_game_and_the_remedy():
    for convert in (jl.to_sparse, jl.to_padded):
        with pytest.raises(ValueError, match=r"the model is a Game.*make_game"):
            convert(game("sparse"))


def test_a_game_has_the_policies_of_its_product():
    lifted = jl.lift_policy(game("product"), jnp.zeros(3, int))
    assert lifted.shape == (3, 2)
    with pytest.raises(ValueError, match="give product"):
        jl.lift_policy(game("padded"), jnp.zeros(3, int))
    assert isinstance(game("product"), Game)
