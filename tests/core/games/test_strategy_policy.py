"""Strategies of games as finite-memory policies: they win in the world alone."""

import itertools

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.games.permissive import permissive_strategy
from jaxltl.core.games.strategy_policy import ReachedNodes, policy_of_nodes, strategy_policy
from jaxltl.core.games.winning import winning_region
from jaxltl.core.models.game import make_game
from jaxltl.core.models.mdp import make_mdp
from tests import reference_games
from tests.support import as_mdp


def played(game, policy, player):
    """The game in which a policy plays for a player, by its tables alone: nodes, and their owner."""
    successor, chance = np.asarray(game.mdp.successor), np.asarray(game.mdp.probability)
    available, system = np.asarray(game.available), np.asarray(game.system)
    allowed = np.asarray(policy.action) > 0
    starts = np.flatnonzero(np.asarray(game.initial) > 0)
    order = [(int(s), int(policy.initial_memory[s])) for s in starts]
    index, rows, moves = {pair: n for n, pair in enumerate(order)}, [], []
    for s, q in order:
        row, own = np.zeros_like(successor[s]), system[s] == (player == "system")
        moves.append(allowed[s, q] if own else available[s])
        assert (moves[-1] <= available[s]).all() and moves[-1].any()
        for a, k in zip(*np.nonzero(moves[-1][:, None] & (chance[s] > 0)), strict=True):
            t = int(successor[s, a, k])
            read = t if policy.label_on == "entry" else s
            pair = t, int(policy.next_memory[read, q])
            if pair not in index:
                index[pair] = len(order)
                order.append(pair)
            row[a, k] = index[pair]
        rows.append(row)
    s, moves = np.array(order)[:, 0], np.array(moves)
    mdp = make_mdp(
        np.stack(rows),
        np.where(moves[:, :, None], chance[s], 0),
        available=moves,
        initial=np.arange(len(s)) < len(starts),
        label=np.asarray(game.mdp.label)[s],
        propositions=game.propositions,
    )
    return make_game(mdp, np.full(len(s), player == "environment"))


def games(seed, **options):
    rng = np.random.default_rng(seed)
    while True:
        play = reference_games.random_game(rng, 7, **options)
        world = as_mdp(play.model)
        label = rng.random((world.num_states, 3)) < [0.3, 0.3, 0.15]
        world = world.replace(label=jax.numpy.asarray(label), propositions=("a", "b", "c"))
        for state in range(world.num_states):
            start = np.arange(world.num_states) == state
            yield make_game(world.replace(initial=jax.numpy.asarray(start * 1.0)), play.system)


TASKS = ["G !c", "G F a", "F a & G !c", "G F a & G F b", "F G a | G F b", "a U (b & F c)"]
GR1 = "G F a -> G F b & G F !c"


def objective(game, task):
    return jl.games.gr1(game, ["a"], ["b", "!c"]) if task == GR1 else task


@pytest.mark.few(4)
@pytest.mark.parametrize("task", [*TASKS, GR1])
def test_strategies_win_as_policies(task):
    count = {"system": 0, "environment": 0}
    for game in itertools.islice(games(len(task)), 60):
        found = winning_region(game, objective(game, task))
        player = "system" if bool(found.realizable) else "environment"
        count[player] += 1
        if count[player] > 3:
            continue
        strategies = [found]
        if player == "system":
            strategies.append(permissive_strategy(game, objective(game, task)))
        for strategy in strategies:
            policy = strategy_policy(game, strategy, player=player)
            alone = winning_region(played(game, policy, player), task)
            start = np.asarray(alone.game.initial) > 0
            assert (np.asarray(alone.region)[start] == (player == "system")).all(), player
    assert min(count.values()) > 0


@pytest.mark.parametrize(("method", "bound"), [("counter", 4), ("parity", None), ("rank", None)])
def test_permissive_strategies_with_memory_of_their_own(method, bound):
    done = 0
    for game in itertools.islice(games(3, num_successors=1), 20):
        try:
            strategy = permissive_strategy(game, "G F a", method=method, bound=bound)
        except ValueError:
            continue
        policy = strategy_policy(game, strategy)
        assert bool(winning_region(played(game, policy, "system"), "G F a").realizable)
        done += 1
    assert done > 3


def test_a_policy_of_a_task_has_its_automaton(tmp_path):
    world = jl.gridworld(". . a\n. # .\nb . .", initial="b")
    game = make_game(world, np.ones(world.num_states, bool))
    policy = strategy_policy(
        game, winning_region(game, "G F a & G F b"), actions=["u", "d", "l", "r"]
    )
    assert policy.automaton is not None and policy.label_on == "exit"
    jl.io.save_policy(tmp_path / "policy.npz", policy)
    robot = jl.io.load_policy(tmp_path / "policy.npz").controller()
    robot.start(int(np.argmax(np.asarray(world.initial))))
    met = set()
    for _ in range(40):
        state = int(robot.at.state)
        robot.update(int(world.successor[state, robot.act(), 0]))
        met |= {n for n, x in zip(world.propositions, world.label[state], strict=True) if x}
    assert {"a", "b"} <= met


def test_a_policy_of_a_sparse_game_has_its_names():
    # The system chooses "down" to the bad state 2 or "up" to 1, where the other player returns.
    world = jl.make_sparse(
        [0, 2, 3, 4],
        range(5),
        [2, 1, 0, 2],
        [1.0] * 4,
        initial=[1, 0, 0],
        label={"bad": [2]},
        action=[0, 2, 1, 1],
        action_names=["down", "go", "up"],
    )
    game = make_game(world, [True, False, True])
    for solve in (winning_region, permissive_strategy):
        policy = strategy_policy(game, solve(game, "G !bad"))
        assert policy.actions == ("down", "go", "up")
        assert np.asarray(policy.action)[:, 0].tolist() == [[0, 0, 1], [0, 1, 0], [0, 1, 0]]
    runs = jl.rollout(world, policy, jax.random.key(0), num_trajectories=1, num_steps=4)
    assert runs.state.tolist() == [[0, 1, 0, 1]]


def test_what_is_refused():
    game = next(g for g in games(0) if bool(winning_region(g, "G !c").realizable))
    found = winning_region(game, "G !c")
    with pytest.raises(ValueError, match="the environment wins from no initial state"):
        strategy_policy(game, found, player="environment")
    with pytest.raises(ValueError, match="a permissive strategy is the system's"):
        strategy_policy(game, permissive_strategy(game, "G !c"), player="environment")
    kinds = (winning_region(g, "G !c", chance="adversarial") for g in games(0))
    hard = next(x for x in kinds if bool(x.realizable) and len(x.game.system) > 7)
    with pytest.raises(ValueError, match="chance='random'"):
        strategy_policy(game, hard)


def test_memory_that_depends_on_an_adversarys_choice_is_refused():
    """Nodes 1 and 2, both state 1 of the world, follow node 0 by different actions."""
    mdp = make_mdp([[[1], [2]], [[1], [1]], [[2], [2]]], [[[1.0], [1.0]]] * 3, initial=[1, 0, 0])
    game = make_game(mdp, np.ones(3, bool))
    with pytest.raises(ValueError, match="depends on more than the states"):
        policy_of_nodes(ReachedNodes(game, np.array([0, 1, 1]), np.array([0, 0, 1])), 2)
