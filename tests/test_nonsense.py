"""Whoever gives nonsense to what takes intervals, data or parameters is told so, by ValueError."""

import importlib
import re
import warnings
from functools import cache, partial
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.algos import (
    cce,
    feasible,
    interval_learning,
    many_tasks,
    ppo,
    regions,
    trust_region,
)
from jaxltl.algos.cce.exponential_family import diagonal_gaussian
from jaxltl.core import validation
from jaxltl.core.automata.sequences import reach_avoid_sequences
from jaxltl.core.environments.episodes import with_time_limit
from jaxltl.core.statistics.binomial import bounded_mean
from jaxltl.core.statistics.confidence_sets import samples_needed
from jaxltl.core.values.evaluation.evaluation import frequency_estimate
from jaxltl.core.values.multi_objective.multi_objective import constrained_optimum
from jaxltl.core.values.multi_objective.objectives import Objective
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.total_reward import total_reward
from jaxltl.envs import navigation
from jaxltl.envs.flat_world import flat_world
from jaxltl.envs.letter_world import letter_world
from jaxltl.envs.navigation_steps import as_environment
from jaxltl.envs.networks import make_network
from jaxltl.envs.robots import grid_game, robots
from jaxltl.envs.zone_world import zone_world

# Modules whose names are those of functions of their packages.
en, ep, st, te = (
    importlib.import_module(f"jaxltl.core.environments.{name}")
    for name in ("environment", "episodes", "sequence_task", "task_environment")
)

NONSENSE = {
    "none": None,
    "nan": float("nan"),
    "infinite": float("inf"),
    "text": "x",
    "negative": -1,
    "part": -0.5,
    "empty": [],
    "shape": np.zeros((2, 5)),
    "huge": 10**30,
    "object": object(),
    "texts": ["x", "y"],
    "dict": {"x": 1},
}
# What NumPy and Python say of it, which names neither the argument nor what to give.
RAW = re.compile(
    "could not convert|could not broadcast|setting an array|inhomogeneous|truth value|invalid "
    "literal|zero-size|cannot convert|not enough values|Incompatible shapes"
)


@cache
def things(folder):
    """A coin in all forms, and how to ask about it."""
    sparse = jl.make_sparse(
        None,
        [0, 2, 3, 4],
        [1, 2, 1, 2],
        [0.5, 0.5, 1, 1],
        initial=[1, 0, 0],
        label=[[0], [1], [0]],
        propositions=["a"],
        rewards={"r": jl.models.Rewards(state=[1.0, 0, 0])},
    )
    model = jl.make_interval(sparse, [0.4, 0.3, 1, 1], [0.7, 0.6, 1, 1])
    counts = jl.make_counts([0, 0, 0], [0, 0, 0], [1, 2, 1])
    (folder / "log.csv").write_text("state,action,next\n0,0,1\n0,0,2\n")
    (folder / "labels.csv").write_text("state,label\n1,a\n")
    (folder / "coin.drn").write_text(
        "@type: DTMC\n@parameters\np\n@nr_states\n3\n@model\nstate 0 init\n\taction 0\n\t\t1 : p\n"
        "\t\t2 : 1-p\nstate 1 goal\n\taction 0\n\t\t1 : 1\nstate 2\n\taction 0\n\t\t2 : 1\n"
    )
    read = jl.io.read_parametric(folder / "coin.drn")
    box = read.over(0.1, 0.9)
    problem = feasible.make_problem(box, "goal", bound=">=")
    asked = {"model": model, "target": "a", "objective": "max", "nature": "adversarial"}
    solved = reachability_probability(model, "a", nature="adversarial")
    ends = {"lower": [0.4, 0.3, 1, 1], "upper": [0.7, 0.6, 1, 1]}
    ball = {"center": [0.5, 0.5, 1, 1], "radius": [0.1, 0, 0]}
    told = {
        "model": sparse,
        "counts": counts,
        "formula": "F a",
        "confidence": 0.9,
        "method": "anytime",
        "objective": "max",
    }
    some = {"problem": problem, "low": 0.2, "high": 0.8}
    rows = {"entry_start": [0, 2, 3, 4], "successor": [1, 2, 1, 2]}
    return [
        (jl.make_interval, {"model": sparse, **ends, **ball}),
        (
            jl.models.interval_rows,
            {
                "row_start": None,
                **rows,
                **ends,
                **ball,
                "rewards": {},
                "initial": [1, 0, 0],
                "propositions": (),
                "valuation": {},
            },
        ),
        (reachability_probability, {**asked, "policy": None, "stay": None, "tolerance": 1e-6}),
        (total_reward, {**asked, "reward": "r", "policy": None, "tolerance": 1e-6}),
        (
            jl.optimal_value,
            {"model": model, "reward": "r", "discount": 0.9, "nature": None, "tolerance": 1e-6},
        ),
        (
            jl.values.robust_expectation,
            {"model": model, "value": [0.0, 1, 2], "nature": "adversarial"},
        ),
        (
            jl.optimal_satisfaction,
            {"model": model, "formula": "F a", "states": [0], "label_on": None},
        ),
        (jl.values.next_probability, asked),
        (
            jl.values.bounded_reachability,
            {**asked, "num_steps": 2, "stay": None, "policy": None, "by_step": False},
        ),
        (jl.values.cumulative_reward, {"model": model, "reward": "r", "num_steps": 2}),
        (jl.values.instantaneous_reward, {"model": model, "reward": "r", "num_step": 2}),
        (
            jl.values.robust_sensitivity,
            {
                "model": model,
                "solution": solved,
                "target": "a",
                "nature": "adversarial",
                "stay": None,
                "initial": [1, 0, 0],
            },
        ),
        (jl.values.prepare, {**asked, "stay": None, "reward": None, "policy": None}),
        (
            jl.statistics.intervals_from_counts,
            {
                "counts": [1, 2, 3, 4],
                "confidence": 0.9,
                "method": "anytime",
                "used": None,
                "entry_start": [0, 2, 4],
                "rows": None,
                "num_outcomes": None,
                "num_claims": None,
            },
        ),
        (
            samples_needed,
            {
                "width": 0.1,
                "confidence": 0.9,
                "method": "anytime",
                "num_claims": 1,
                "num_outcomes": 2,
            },
        ),
        (
            jl.make_counts,
            {
                "state": [0],
                "action": [0],
                "successor": [1],
                "count": [2],
                "states": None,
                "actions": None,
            },
        ),
        (jl.models.align_counts, {"model": sparse, "counts": counts}),
        (
            jl.models.model_from_counts,
            {
                "counts": counts,
                "initial": "0",
                "labels": {"a": ["1"]},
                "terminal": ["1"],
                "graph": "seen",
            },
        ),
        (
            jl.read_log,
            {
                "path": folder / "log.csv",
                "model": sparse,
                "count": "count",
                "columns": ("state", "action", "next"),
            },
        ),
        (jl.read_log, {"path": folder / "log.csv", "states": None, "actions": None}),
        (
            jl.io.read_labels,
            {
                "path": folder / "labels.csv",
                "states": ["0", "1", "2"],
                "columns": ("state", "label"),
            },
        ),
        (
            jl.learn_guarantee,
            {**told, "graph": "given", "tolerance": 1e-6},
        ),
        (jl.values.guarantee_curve, {**told, "graph": "given", "sizes": [1, 2], "seed": 0}),
        (jl.solve_property, {"model": model, "prop": 'Pmaxmin=? [F "a"]', "states": None}),
        (
            jl.make_parametric,
            {"model": sparse, "numbers": coin, "low": [0.1], "high": [0.9], "parameters": ["p"]},
        ),
        (box.at, {"values": [0.5]}),
        (box.within, {"low": 0.2, "high": 0.8}),
        (read.at, {"values": {"p": 0.5}}),
        (read.over, {"low": 0.1, "high": 0.9}),
        (jl.io.read_parametric, {"path": folder / "coin.drn"}),
        (
            feasible.make_problem,
            {
                "model": box,
                "target": "goal",
                "bound": ">=",
                "reward": None,
                "stay": None,
                "objective": "max",
            },
        ),
        (feasible.within, some),
        (
            feasible.feasible,
            {
                "problem": problem,
                "threshold": 0.5,
                "num_starts": 2,
                "budget": feasible.Budget(num_steps=3),
                "hparams": None,
            },
        ),
        (feasible.Budget, {"num_steps": 3, "num_proofs": None, "tolerance": 1e-6}),
        (feasible.certify, {"problem": problem, "parameters": [0.5], "tolerance": 1e-6}),
        (regions.enclose, some),
        (regions.prove_regions, {**some, "threshold": 0.5, "max_boxes": 5}),
        (
            regions.prove_around,
            {"problem": problem, "threshold": 0.3, "point": [0.5], "num_halvings": 3},
        ),
        (interval_learning.make_problem, {"world": sparse, "formula": "F a"}),
    ]


def imported(name, attribute, *given):
    return getattr(importlib.import_module(name), attribute)(*given)


def pair(made):
    return {"env": made[0], "params": made[1]}


# Of each: the package, how to make what its adapter takes, and what else it takes.
ADAPTERS = {
    "gymnax": ("gymnax", lambda: pair(imported("gymnax", "make", "Catch-bsuite")), {}),
    "navix": ("navix", lambda: {"env": imported("navix", "make", "Navix-Empty-5x5-v0")}, {}),
    "xminigrid": (
        "xminigrid",
        lambda: pair(imported("xminigrid", "make", "MiniGrid-Empty-5x5")),
        {},
    ),
    "jumanji": (
        "jumanji",
        lambda: {"env": imported("jumanji", "make", "Game2048-v1")},
        {"in_turn": False},
    ),
    "brax": ("brax", lambda: {"env": imported("brax.envs", "get_environment", "fast")}, {}),
    "playground": (
        "mujoco_playground",
        lambda: {"env": imported("mujoco_playground._src.registry", "load", "CartpoleBalance")},
        {},
    ),
    "jaxmarl": (
        "jaxmarl",
        lambda: {"env": imported("jaxmarl", "make", "MPE_simple_v3")},
        {"others": None, "agent": "agent_0"},
    ),
    "pgx": (
        "pgx",
        lambda: {"env": imported("pgx", "make", "tic_tac_toe")},
        {"opponent": lambda state, key: 0, "player": 0},
    ),
}


@cache
def simulated():
    """A corridor with a task, and what is asked of it."""

    def step(place, action, key):
        return en.Timestep(jnp.clip(place + 2 * action - 1, 0, 2), reward=0.0, terminated=False)

    corridor = {
        "reset": lambda key: jnp.int32(0),
        "step": step,
        "observe": lambda place: place[None] / 2,
        "actions": 2,
        "labels": lambda place: place == jnp.array([0, 2]),
        "propositions": ["home", "goal"],
        "allowed": None,
        "observations": None,
        "horizon": 4,
        "starts": None,
        "outcomes": None,
    }
    world = en.make_environment(**corridor)
    task = te.task_environment(world, "F goal")
    agent = ep.make_agent(lambda seen, key: jnp.int32(0))
    events, key = st.make_events(["home", "goal"]), jax.random.key(0)
    sets = st.proposition_sets(events)
    asked = {
        "propositions": ["home", "goal"],
        "reward": "auto",
        "discount": None,
        "ratio": None,
        "learner_discount": 1.0,
        "ending": "repeat",
        "embedding": None,
    }
    told = {"events": events, "propositions": ("home", "goal"), "depth": 2, "max_sequences": 2}
    table, plan = jl.tabulate(world), many_tasks.make_plan("F goal", **told)
    return [
        (en.make_box, {"low": 0.0, "high": 1.0, "shape": (2,), "dtype": None}),
        (en.make_environment, corridor),
        (ep.make_agent, {"function": step}),
        (ep.run_episode, {"key": key, "environment": world, "agent": agent, "num_steps": 2}),
        (with_time_limit, {"environment": world, "num_steps": 2}),
        (te.make_task_tables, {"formula": "F goal", **asked}),
        (te.task_environment, {"environment": world, "formula": "F goal", "labels": None, **asked}),
        (te.with_task_tables, {"environment": task, "tables": te.task_tables(task)}),
        (te.task_tables, {"environment": task}),
        (te.stack_tasks, {"environments": [task]}),
        (te.stack_tables, {"tables": [te.task_tables(task)]}),
        (te.residual_formula, {"task": task, "memory": 0}),
        (st.make_events, {"propositions": ["a"], "at_most": 1}),
        (st.sequence_sampler, {"length": [1], "reach": [1], "avoid": [1], "sets": sets}),
        (
            st.sequence_environment,
            {
                "environment": world,
                "events": events,
                "violation": -1.0,
                "progress": 0.0,
                "sampler": st.sequence_sampler([1], [1], [1], sets),
            },
        ),
        (
            jl.tabulate,
            {
                "environment": world,
                "worlds": None,
                "max_states": 10,
                "num_keys": 2,
                "key": key,
                "distinct": None,
            },
        ),
        (
            jl.evaluate,
            {
                "key": key,
                "agent": agent,
                "environment": task,
                "num_episodes": 4,
                "num_steps": 3,
                "confidence": 0.9,
                "threshold": 0.5,
                "discount": 0.9,
                "batch": 2,
            },
        ),
        (frequency_estimate, {"count": 1, "total": 2, "failure": 0.05}),
        (
            jl.values.episode_evaluator,
            {
                "environment": task,
                "agent": lambda numbers: agent,
                "objective": "reward",
                "costs": "failure",
                "num_episodes": 2,
                "num_steps": 2,
                "discount": 1.0,
            },
        ),
        (
            jl.values.tabulate_policy,
            {
                "policy": lambda seen, memory: jnp.int32(0),
                "environment": world,
                "table": table,
                "num_memory": 2,
            },
        ),
        (
            jl.optimality_gap,
            {"table": table, "formula": "F goal", "policy": np.zeros((3, 2), int), "num_steps": 3},
        ),
        (bounded_mean, {"numbers": [0.5], "failure": 0.1, "planned": None}),
        (reach_avoid_sequences, {"automaton": jl.to_automaton("F goal"), **told}),
        (many_tasks.make_plan, {"formula": "F goal", **told}),
        (many_tasks.stack_plans, {"plans": [plan]}),
        (
            many_tasks.sequence_agent,
            {"network": step, "plan": plan, "actions": None, "squash": "clip"},
        ),
        *taught(world, key),
        (
            partial(letter_world, connected=False),
            {"size": 4, "letters": 2, "num_copies": 1, "horizon": 5, "num_maps": 4, "seed": 0},
        ),
        (
            partial(letter_world, size=3, letters=1, num_copies=1, num_maps=2),
            {"connected": True, "flat": False},
        ),
        (partial(letter_world, layout="a.\n..", letters=1), {"initial": 1, "horizon": 5}),
        (
            flat_world,
            {
                "discs": (("red", 0.0, 0.0, 0.5),),
                "extent": 2.0,
                "time_step": 0.1,
                "horizon": 5,
                "discrete": False,
                "initial": None,
                "num_starts": 4,
                "seed": 0,
            },
        ),
        (
            zone_world,
            {
                "colors": ("a", "b"),
                "num_zones": 1,
                "radius": 0.4,
                "extent": 2.5,
                "saturation": 0.05,
                "num_maps": 4,
                "seed": 0,
            },
        ),
    ]


def taught(world, key):
    """What learners are asked; they are traced alone, since what they take is decided by then."""
    problem = ppo.make_problem(world)
    settings = {"num_envs": 2, "num_steps": 2, "num_epochs": 1, "num_minibatches": 1}
    hparams = ppo.Hparams(discount=0.9, **settings)
    state = jax.eval_shape(lambda: ppo.init(key, problem, hparams))
    coin = jl.from_dense([[[0.5, 0.5]], [[0, 1]]], label=[[0], [1]], propositions=["a"])
    told = {"reward": None, "observe": None, "opponent": None}
    safe = {"environment": jl.environments.model_environment(coin), "state_of": None}
    plane = navigation.navigation()
    network = navigation.policy_network(plane)
    score = navigation.evaluator(plane, 1, num_trajectories=1)
    family = diagonal_gaussian(jnp.zeros(network.num_parameters), 1.0)

    def begun(**given):
        return jax.eval_shape(lambda: ppo.init(key, problem, ppo.Hparams(**given)))

    def searched(**given):
        return jax.eval_shape(
            lambda: cce.init(key, cce.make_problem(score, family), cce.Hparams(**given))
        )

    there = trust_region.make_problem(as_environment(plane, 1), horizon=3, limit=1.0)

    def trusted(**given):
        return jax.eval_shape(
            lambda: trust_region.init(
                key, there, trust_region.Hparams(**{"discount": 0.9, "normalize": False} | given)
            )
        )

    hidden = {"num_trajectories": 2, "num_value_batches": 2, "hidden": (2,), "value_hidden": ()}
    bold = {"problem": there, "hparams": trust_region.Hparams(discount=0.9, **hidden)}
    bold["state"] = blank(jax.eval_shape(lambda: trust_region.init(key, **bold)))
    seeking = {"problem": cce.make_problem(score, family), "hparams": cce.Hparams(population=10)}
    search = blank(jax.eval_shape(lambda: cce.init(key, **seeking)))
    return [
        (trust_region.make_problem, {"environment": world, "horizon": 3, "limit": 1.0}),
        (
            partial(traced, trust_region.rollout),
            {"key": key, "num_trajectories": 2, "sampled": True, **bold},
        ),
        (trust_region.policy, bold),
        (partial(traced, trust_region.step), bold),
        (
            partial(traced, trust_region.act),
            {"state": bold["state"], "hparams": bold["hparams"], "observation": jnp.zeros(4)},
        ),
        (partial(traced, trust_region.run), bold | {"num_steps": 2}),
        (cce.make_problem, {"evaluate": score, "family": family, "limit": 1.0, "scale": None}),
        (partial(traced, cce.init), {"key": key, **seeking}),
        (partial(traced, cce.step), {"state": search, **seeking}),
        (cce.policy, {"state": search, **seeking}),
        (cce.result, {"state": search, "key": key, **seeking}),
        (
            partial(traced, cce.assess),
            {
                "problem": seeking["problem"],
                "parameters": jnp.zeros(network.num_parameters),
                "key": key,
                "num_evaluations": 2,
            },
        ),
        (ppo.make_problem, {"environment": world, "network": None, "memory": None}),
        (
            partial(ppo.make_problem, world),
            {"network": ppo.RecurrentActorCritic(num_actions=2, memory=4), "memory": None},
        ),
        (partial(traced, ppo.init), {"key": key, "problem": problem, "hparams": hparams}),
        (ppo.policy, {"state": state, "problem": problem, "hparams": hparams}),
        (
            begun,
            {
                "discount": 0.9,
                "gae_lambda": 0.9,
                "learning_rate": 0.1,
                "clip": 0.1,
                "value_clip": None,
                "value_weight": 0.5,
                "entropy_weight": 0.1,
                "target_kl": None,
                "max_gradient_norm": 0.5,
                "adam_epsilon": 1e-5,
                "normalize_advantage": True,
                "normalize_observation": False,
                "normalize_reward": False,
                "squash": "clip",
                "num_resets": None,
                **settings,
            },
        ),
        (searched, {"elite_reuse": False, "antithetic": False, "population": 10, "rho": 0.5}),
        (
            trusted,
            {"normalize": True, "num_trajectories": 4, "num_value_batches": 2, "hidden": (4,)},
        ),
        (
            many_tasks.train_in_stages,
            {
                "key": key,
                "problems": [problem],
                "hparams": hparams,
                "init": lambda *given: state,
                "run": lambda state, *given, num_steps: (state, Ended()),
                "num_chunks": 1,
                "num_steps": 1,
                "enough": 0.9,
                "report": None,
            },
        ),
        (jl.environments.model_environment, {"model": coin, **told}),
        (jl.environments.model_environment, {"model": robots(2), **told}),
        (
            jl.games.shield_environment,
            {"strategy": jl.permissive_strategy(coin, "F a"), **safe},
        ),
        (jl.games.shield_environment, {"strategy": np.ones((2, 1), bool), **safe}),
        (robots, {"size": 3}),
        (partial(grid_game, "a..\n..b"), {"system_stays": True, "environment_stays": False}),
        (partial(make_network, "2-3-1"), {"biases": True}),
        (partial(as_environment, plane), {"task": 1, "absorbing": None}),
        (partial(navigation.evaluator, plane), {"task": 1, "absorbing": None}),
    ]


def blank(shapes):
    """Zeros of some shapes, and a key where there is to be one."""
    return jax.tree.map(
        lambda x: (
            jax.random.key(0)
            if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)
            else np.zeros(x.shape, x.dtype)
        ),
        shapes,
    )


class Ended(NamedTuple):
    """What training tells in which no episode ended."""

    episode_return: np.ndarray = np.array([np.nan])
    episodes: np.ndarray = np.array([0])


def traced(function, **given):
    """What a function would return, of which nothing is compiled."""
    return jax.eval_shape(lambda: function(**given))


# In place of one value several, and one as a text.
SEVERAL = {"truths": np.array([True, False]), "axis": np.ones(3), "digits": "0.5"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", NONSENSE | SEVERAL)
def test_nonsense_about_simulated_worlds_is_told(kind):
    for call, given in simulated():
        for name in given:
            try:
                call(**given | {name: (NONSENSE | SEVERAL)[kind]})
            except ValueError as error:
                assert not RAW.search(str(error)), (call, name, error)


@pytest.mark.parametrize("name", ADAPTERS)
def test_nonsense_given_to_adapters_is_told(name):
    package, make, others = ADAPTERS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip(package)
        with jax.enable_x64(False):
            given = make() | {"labels": None, "propositions": ()} | others
            adapter = getattr(jl.envs, f"from_{name}")
            adapter(**given)
            for argument, (kind, value) in product(given, (NONSENSE | SEVERAL).items()):
                try:
                    adapter(**given | {argument: value})
                except ValueError as error:
                    assert not RAW.search(str(error)), (kind, argument, error)


def test_what_is_of_another_run_is_named():
    """Of settings, states, parameters and observations; nothing is compiled."""
    key, world = (
        jax.random.key(0),
        jl.envs.letter_world(size=3, letters=2, num_copies=1, num_maps=2),
    )
    plane = navigation.navigation()
    small = ppo.make_problem(world, network=ppo.ActorCritic(num_actions=4, hidden=(2,)))
    large = ppo.make_problem(world, network=ppo.ActorCritic(num_actions=4, hidden=(3,)))
    hparams = ppo.Hparams(discount=0.9, num_envs=2, num_steps=2)
    state = blank(jax.eval_shape(lambda: ppo.init(key, small, hparams)))
    there = trust_region.make_problem(as_environment(plane, 1), horizon=3)
    bold = trust_region.Hparams(discount=0.9, method="trpo", hidden=(2,), normalize=False)
    trusted = blank(jax.eval_shape(lambda: trust_region.init(key, there, bold)))
    wide = bold.replace(hidden=(3,))

    def search(size, costs):
        def scored(x, key):
            return x.sum(), jnp.zeros(costs)

        return cce.make_problem(scored, diagonal_gaussian(jnp.zeros(size), 1.0))

    found = cce.init(key, search(2, 1), cce.Hparams())
    events = st.make_events(world.propositions)
    plan = many_tasks.make_plan("F a", events, world.propositions, depth=1)
    network = many_tasks.trained(
        many_tasks.SequenceNetwork(num_actions=4, hidden=(2,)), state.parameters
    )
    agent = many_tasks.sequence_agent(network, plan)
    task = te.task_environment(world, "F a")

    def rollout(**given):
        return trust_region.rollout(
            **{
                "key": key,
                "state": trusted,
                "problem": there,
                "hparams": bold,
                "num_trajectories": 2,
            }
            | given
        )

    def acted(agent, env):
        return jax.eval_shape(lambda: ep.run_episode(key, env, agent, num_steps=1))

    for call, message in (
        (lambda: rollout(sampled=np.ones(2, bool)), r"sampled=\[True, True\]; give True or"),
        (lambda: rollout(sampled="yes"), "sampled='yes'; give True or False"),
        (lambda: rollout(num_trajectories=0), "num_trajectories=0; it must be at least 1"),
        (lambda: rollout(key=jax.random.split(key)), "give a single one"),
        (lambda: rollout(state=found), "state is State; give one of trust_region.init"),
        (lambda: rollout(problem=small), "problem is Problem; give one of trust_region.make"),
        (lambda: traced(rollout, hparams=wide), "parameters are not those of this TanhNetwork"),
        (lambda: trust_region.act(trusted, bold, jnp.zeros(3)), r"trained on vectors float\["),
        (
            lambda: cce.step(found, search(3, 1), cce.Hparams()),
            r"policies float\[2\] with 1 costs, the problem of float\[3\] with 1",
        ),
        (lambda: cce.step(found, search(2, 2), cce.Hparams()), "with 1 costs, .* with 2"),
        (
            lambda: cce.assess(key, search(2, 1), jnp.zeros(3)),
            r"parameters is .*; give those of one policy, float\[2\]",
        ),
        (
            lambda: traced(ppo.step, state=state, problem=large, hparams=hparams),
            "parameters are not those of this ActorCritic",
        ),
        (lambda: acted(ppo.policy(state, large, hparams), world), "not those of this Actor"),
        (lambda: ppo.run(state, "x", hparams, num_steps=1), "problem is 'x'; give a number or"),
        (lambda: acted(agent, task), "not those of this SequenceNetwork"),
        (lambda: acted(agent, world), "give that of an environment of task_environment"),
        (
            lambda: many_tasks.sequence_policy(lambda x: jnp.zeros(3), plan, 0.0, 0),
            r"network returns \(3,\) for an observation",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_flags_are_named():
    for call, message in (
        (lambda: letter_world(flat=np.ones(2, bool)), r"flat=\[True, True\]; give True or Fa"),
        (lambda: letter_world(connected=None), "connected=None; give True or False"),
        (lambda: flat_world(discrete="no"), "discrete='no'; give True or False"),
        (lambda: jax.jit(lambda x: flat_world(discrete=x))(True), "discrete=.*; give True or"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    assert letter_world(
        size=3, letters=1, num_maps=2, num_copies=1, flat=jnp.bool_(True)
    ).observations.shape == (18,)


def coin(x):
    return jnp.array([x[0], 1 - x[0], 1, 1])


@pytest.mark.parametrize("kind", NONSENSE)
def test_nonsense_is_told(kind, tmp_path_factory):
    """What is accepted is a value of its kind; what is not raises a ValueError of ours."""
    folder = tmp_path_factory.getbasetemp() / "nonsense"
    folder.mkdir(exist_ok=True)
    for call, given in things(folder):
        for name in given:
            try:
                call(**given | {name: NONSENSE[kind]})
            except ValueError as error:
                assert not RAW.search(str(error)), (call, name, error)


def test_good_input_is_taken(tmp_path):
    for call, given in things(tmp_path):
        call(**given)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda m: jl.values.bounded_reachability(m, "a", None),
            "num_steps=None; it must be an integer",
        ),
        (lambda m: reachability_probability(m, "a", policy="x"), "policy is 'x'; give the number"),
        (
            lambda m: constrained_optimum(m, [Objective(target="a"), Objective(target="a")]),
            "ask for one at a time",
        ),
        (lambda m: jl.models.to_dense(m), "or give its nominal model, model.nominal"),
        (lambda m: jl.graphs.attractor(m, m.states_with_label("a")), "IntervalMDP has intervals"),
        (lambda m: jl.make_interval(m, m.lower, m.upper), "of an interval model, its nominal one"),
    ],
)
def test_who_asks_of_intervals_what_is_not_solved(call, message):
    model = jl.models.interval_rows(
        None,
        [0, 2, 3, 4],
        [1, 2, 1, 2],
        [0.4, 0.3, 1, 1],
        [0.7, 0.6, 1, 1],
        initial=[1, 0, 0],
        label=[[0], [1], [0]],
        propositions=["a"],
        rewards={"r": jl.models.Rewards(state=[1.0, 0, 0])},
    )
    with pytest.raises(ValueError, match=message):
        call(model)


def test_claims_thresholds_and_steps():
    counts = {"counts": [[1, 2, 3]], "confidence": 0.9}
    with pytest.raises(ValueError, match="num_claims=inf; it must be an integer"):
        jl.statistics.intervals_from_counts(**counts, num_claims=np.inf)
    world = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
    problem = interval_learning.make_problem(world, "true")
    for steps in (None, "x", np.nan, [1]):
        with pytest.raises(ValueError, match=r"num_steps=.*integer of at least 1"):
            interval_learning.train(
                jax.random.key(0), problem, interval_learning.Hparams(), num_steps=steps
            )


def test_a_log_of_a_world_whose_slips_repeat_a_successor(tmp_path):
    """Two slips against a wall end at one place: one transition, by name."""
    world = jl.make_mdp([[[0, 0, 1]], [[1, 1, 1]]], [[[0.25, 0.25, 0.5]], [[1, 0, 0]]])
    path = tmp_path / "log.csv"
    path.write_text("state,action,next\n0,0,0\n0,0,1\n0,0,0\n")
    counts = jl.read_log(path, world)
    assert counts.count.tolist() == [2, 1]
    assert jl.learn_guarantee(world, counts, "true", 0.9, graph="given").bound == 1
    with pytest.raises(ValueError, match="convert a model whose rows repeat a successor by to_sp"):
        jl.models.align_counts(world, counts)
    path.write_text("state,action,next\n1,0,0\n")
    with pytest.raises(ValueError, match="line 2"):
        jl.read_log(path, world)


def test_words_and_numbers():
    assert validation.integer("n", 3.0) == 3
    assert validation.finite_number("x", "0.5") == 0.5
    assert validation.choice("bound", "<=", (">=", "<=")) == "<="
    assert validation.sequence("names", "ab") == ["a", "b"]
    for given, message in (
        (2, "n=2; it must be at least 3"),
        (9, "n=9; it must be at most 8"),
        (3.5, "integer of at least 3"),
        (True, "at least 3"),
    ):
        with pytest.raises(ValueError, match=message):
            validation.integer("n", given, least=3, limit=8)
    for given in (None, np.inf, [1.0], "x"):
        with pytest.raises(ValueError, match=r"give a finite number|give numbers"):
            validation.finite_number("x", given)
