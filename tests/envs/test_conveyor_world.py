"""ConveyorWorld against drawn maps, and its certified optima."""

import jax
import numpy as np
import pytest

import jaxltl as jl

# Walls are #, belts to the right are >; the first line is y = 8.
MAP = """
#####....
...>>>.ac
...###...
...######
S..######
...######
...###...
...>>>.ab
#####....
"""
COLUMN = """
###
#d#
#b#
#a#
#S#
#a#
#b#
#c#
###
"""
RIGHT, UP, LEFT, DOWN = (1, 0), (0, 1), (-1, 0), (0, -1)


def places(table, width):
    cells = np.asarray(table.world[0] if isinstance(table.world, tuple) else table.world)
    return [(int(c) % width, int(c) // width) for c in cells]


@pytest.mark.parametrize(("text", "simple", "chain"), [(MAP, False, 2), (COLUMN, True, 3)])
def test_moves_and_labels_are_those_of_the_drawn_map(text, simple, chain):
    rows = text.split()[::-1]
    kind = {(x, y): c for y, row in enumerate(rows) for x, c in enumerate(row)}
    start = next(place for place, c in kind.items() if c == "S")
    world = jl.envs.conveyor_world(chain, simple=simple)
    table = jl.tabulate(world)
    at = places(table, len(rows[0]))
    assert at[int(np.unique(table.start)[0])] == start and world.horizon == 50
    host, label = table.model.host, np.asarray(table.model.label)
    successor = np.asarray(host.successor)[host.entry_start[:-1]]
    reached = {start}
    for row, (state, action) in enumerate(zip(host.state, table.model.action, strict=True)):
        x, y = at[state]
        step = (UP, DOWN, LEFT, RIGHT)[int(action)]
        against = LEFT if kind[x, y] == ">" else None
        if simple and y != start[1]:
            against = DOWN if y > start[1] else UP
        target = (x + step[0], y + step[1])
        if step == against or kind.get(target, "#") == "#":
            target = (x, y)
        assert at[successor[row]] == target
        reached.add(target)
        held = {p for p, holds in zip(world.propositions, label[state], strict=True) if holds}
        assert held == ({kind[x, y]} if kind[x, y].islower() else set())
    assert len(at) == len(reached)


def chain_formula(names):
    return f"F {names[0]}" if len(names) == 1 else f"F ({names[0]} & {chain_formula(names[1:])})"


@pytest.mark.parametrize(
    ("chain", "simple", "fewest"), [(1, False, 10), (10, False, 19), (32, True, 32)]
)
def test_both_tasks_are_certain_from_the_fewest_steps_on(chain, simple, fewest):
    world = jl.envs.conveyor_world(chain, simple=simple, horizon=4 * fewest)
    table = jl.tabulate(world)
    for last in (-2, -1):
        formula = chain_formula([*world.propositions[:-2], world.propositions[last]])
        for steps, optimum in ((fewest - 1, 0.0), (fewest, 1.0)):
            task = jl.to_automaton(formula, letters=[{}, *({p} for p in world.propositions)])
            lazy = np.full((table.model.num_states, len(task.delta), 4), 0.25)
            found = jl.optimality_gap(table, task, lazy, num_steps=steps)
            assert found.mean_optimum == (optimum, optimum)
    assert len(world.propositions) == len(set(world.propositions)) == chain + 1


def test_wrong_arguments_are_named():
    for chain in (0, 65, 1.5):
        with pytest.raises(ValueError, match="chain"):
            jl.envs.conveyor_world(chain)


def test_an_episode_is_of_one_program():
    world = jl.envs.conveyor_world(1, horizon=4)
    down = jl.environments.make_agent(lambda seen, key: 1)
    episode = jl.run_episode(jax.random.key(0), world, down, num_steps=4)
    assert np.asarray(episode.world[0]).tolist() == [4 * 8, 3 * 8, 2 * 8, 8, 8]
