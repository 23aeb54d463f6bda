"""Coloured worlds: what cells are by counting, feasibility by search, the expert by hand."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.values.undiscounted.performance import infeasible_starts
from jaxltl.envs import temporal_gridworld as tg
from jaxltl.envs.cell_kinds import many_objects
from jaxltl.io.colored_world import read_world, write_world
from tests import support

PLAN = {
    "o1": [(1, 7)],
    "o2": [(7, 1)],
    "o3": [(10, 10)],
    "ob": [(4, 4), (4, 5), (4, 6), (4, 7), (10, 7)],
}
KINDS = {**tg.OBJECTS, **tg.OBSTACLES}


def counted(world, kinds=KINDS):
    """The cells of each kind, from 1, by counting the colours of every patch one by one."""
    colors, margin = np.asarray(world.colors), world.margin
    found = {name: [] for name in kinds}
    for row in range(1, world.shape[0] + 1):
        for column in range(1, world.shape[1] + 1):
            r, c = row + margin - 1, column + margin - 1
            patch = [tg.COLORS[colors[i, j]] for i in (r - 1, r, r + 1) for j in (c - 1, c, c + 1)]
            for name, counts in kinds.items():
                if Counter(patch) == Counter(counts):
                    found[name].append((row, column))
    return found


def labelled(world):
    label = np.asarray(world.mdp.label)
    cells = [(r + 1, c + 1) for r in range(world.shape[0]) for c in range(world.shape[1])]
    return {
        name: [cell for cell, holds in zip(cells, label[:, i], strict=True) if holds]
        for i, name in enumerate(world.mdp.propositions)
    }


def exit_product(world, task=tg.COMPLETE):
    return jl.product(world.mdp, task, label_on="exit")


@pytest.mark.parametrize("seed", range(20))
def test_the_training_world_is_exactly_as_planned(seed):
    world = tg.training_world(seed)
    assert counted(world) == labelled(world) == PLAN
    black = np.argwhere(np.asarray(world.colors)[3:8, 3:10] == tg.COLORS.index("black")) + 3
    # Four obstacles are the inside of one black rectangle of 3 x 6 cells.
    assert {(r, c) for r in (3, 4, 5) for c in range(3, 9)} <= {(r, c) for r, c in black}
    start = np.asarray(world.mdp.initial)
    np.testing.assert_allclose(start, np.where(np.asarray(world.mdp.label).any(1), 0, 1 / 92))


def test_colours_follow_the_seed_and_inner_ones_not_the_margin():
    world = tg.training_world(3)
    np.testing.assert_array_equal(world.colors, tg.training_world(3).colors)
    np.testing.assert_array_equal(world.colors, tg.training_world(3, margin=2).colors[1:-1, 1:-1])
    assert (np.asarray(world.colors) != np.asarray(tg.training_world(4).colors)).any()
    shares = np.bincount(
        np.concatenate([np.asarray(tg.training_world(i).colors)[0, :6] for i in range(40)]),
        minlength=5,
    )
    assert shares.sum() == 240 and (shares > 25).all()  # free cells have all colours


def test_moves_are_those_of_the_grid_world():
    world = tg.make_world({}, 0, shape=(3, 4), slip=0.2)
    plain = jl.gridworld("....\n....\n....", slip=0.2)
    np.testing.assert_array_equal(world.mdp.successor, plain.successor)
    np.testing.assert_array_equal(world.mdp.probability, plain.probability)


def test_patches_are_cut_out_of_the_colours():
    world = tg.training_world(1, margin=2)
    colors = np.asarray(world.colors)
    for radius in (0, 1, 2):
        seen = np.asarray(tg.patches(world, radius))
        for state in (0, 7, 42, 99):
            r, c = state // 10 + 2, state % 10 + 2
            cut = colors[r - radius : r + radius + 1, c - radius : c + radius + 1]
            np.testing.assert_array_equal(seen[state], cut)
    hot = np.asarray(tg.observations(world, 2))
    assert hot.shape == (100, 125)
    image = hot.reshape(100, 5, 5, 5)
    np.testing.assert_array_equal(image.argmax(-1), tg.patches(world, 2))
    np.testing.assert_array_equal(image.sum(-1), 1)
    with pytest.raises(ValueError, match=r"radius=3; this world shows 0 to 2 .* margin=3"):
        tg.patches(world, 3)


def test_worlds_can_be_stacked():
    worlds = [tg.training_world(seed) for seed in (0, 1)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *worlds)
    seen = jax.jit(jax.vmap(tg.observations))(stacked)
    assert seen.shape == (2, 100, 45)
    np.testing.assert_array_equal(seen[1], tg.observations(worlds[1]))


# --- random worlds ----------------------------------------------------------------------------


def check_random(world, kinds, num_obstacles, distance):
    assert counted(world, kinds) == labelled(world)
    cells = labelled(world)
    obstacles = cells.pop("ob")
    assert len(obstacles) == num_obstacles
    assert all(len(here) == 1 for here in cells.values())
    objects = [here[0] for here in cells.values()]
    for i, (r, c) in enumerate(objects):
        for y, x in objects[:i]:
            assert max(abs(r - y), abs(c - x)) >= distance
        for y, x in obstacles:
            assert max(abs(r - y), abs(c - x)) >= 3


def test_random_worlds_are_what_they_say():
    worlds = tg.random_worlds(range(30))
    for world in worlds:
        check_random(world, KINDS, 5, 3)
        assert not infeasible_starts(exit_product(world)).any()
    np.testing.assert_array_equal(worlds[7].colors, tg.random_world(7).colors)
    assert len({labelled(world)["o1"][0] for world in worlds}) > 10


def test_random_worlds_of_other_sizes_objects_and_tasks():
    objects = many_objects(5)
    task = "!ob U (o5 & (!ob U o4))"
    world = tg.random_world(
        2,
        task,
        shape=(12, 17),
        objects=objects,
        num_obstacles=9,
        min_distance=5,
        margin=2,
        slip=0.1,
    )
    check_random(world, {**objects, **tg.OBSTACLES}, 9, 5)
    assert world.colors.shape == (16, 21) and world.mdp.num_successors == 3
    assert not infeasible_starts(exit_product(world, task)).any()
    automaton = jl.to_automaton("F o1", letters=[set(), {"o1"}])
    assert tg.random_world(0, automaton).mdp.num_states == 100
    assert tg.random_world(0, "true", num_obstacles=0).mdp.label.sum() == 3


@pytest.mark.parametrize("task", ["G !ob & G F o1", "G (o1 -> X G !o2)", "F G o1 | G F !ob"])
def test_random_worlds_for_tasks_without_end(task):
    for world in tg.random_worlds(range(3), task, shape=(7, 6), num_obstacles=6, min_distance=2):
        best = jl.optimal_satisfaction(exit_product(world, task))
        assert (np.asarray(best.lower)[np.asarray(exit_product(world, task).initial) > 0] > 0).all()


def test_random_worlds_are_drawn_until_a_task_without_end_can_be_done():
    options = {
        "shape": (5, 5),
        "objects": {"o1": tg.OBJECTS["o1"]},
        "num_obstacles": 5,
        "obstacle_distance": 1,
    }

    def failing(worlds, task):
        return [infeasible_starts(exit_product(world, task)).any() for world in worlds]

    task = "G !ob & G F o1"
    assert any(failing(tg.random_worlds(range(20), "true", **options), task))
    assert not any(failing(tg.random_worlds(range(20), task, **options), task))
    with pytest.raises(ValueError, match="seed 0: in 5 placements"):
        tg.random_world(0, "G F (o1 & ob)", max_tries=5, **options)


@support.counts(60, 1000)
def test_hundreds_of_random_worlds(count):
    for world in tg.random_worlds(range(count)):
        check_random(world, KINDS, 5, 3)


def test_many_objects_differ():
    kinds = many_objects(16)
    assert len({tuple(sorted(x.items())) for x in kinds.values()}) == 16
    assert {name: kinds[name] for name in ("o1", "o2", "o3")} == tg.OBJECTS
    with pytest.raises(ValueError, match="num=17; it must be at most 16"):
        many_objects(17)


# Obstacles wall off a corner: from there nothing can be reached.
WALLED = {"o1": [(6, 2)], "o2": [(6, 5)], "ob": [(1, 3), (2, 3), (3, 3), (3, 2), (3, 1)]}


def test_starts_without_a_way_are_found():
    world = tg.make_world(WALLED, 0, shape=(7, 6))
    model = exit_product(world, "!ob U (o1 & (!ob U o2))")
    assert np.flatnonzero(infeasible_starts(model)).tolist() == [0, 1, 6, 7]
    assert not infeasible_starts(exit_product(world, "F (o1 & F o2)")).any()


@pytest.mark.parametrize(
    "task, slip, label_on",
    [
        ("!ob U (o1 & (!ob U o2))", 0.0, "exit"),
        ("!ob U (o1 & (!ob U o2))", 0.2, "entry"),
        ("F (o1 & X o1)", 0.2, "exit"),
        ("(!o2 U o1) & F o2", 0.0, "entry"),
    ],
)
def test_feasibility_agrees_with_the_attractor(task, slip, label_on):
    world = tg.make_world(WALLED, 0, shape=(7, 6), slip=slip)
    model = jl.product(world.mdp, task, label_on=label_on)
    can = np.asarray(jl.graphs.attractor(model, model.final, model.available).region)
    if label_on == "exit":  # as the generator reads
        found = tg._can_finish(
            *(
                np.asarray(x)
                for x in (world.mdp.successor, model.next_memory, model.automaton.final)
            )
        )
        np.testing.assert_array_equal(found, can)
    expected = ~can[np.arange(42), np.asarray(model.initial_memory)]
    expected &= np.asarray(world.mdp.initial) > 0
    np.testing.assert_array_equal(infeasible_starts(model), expected)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: tg.random_world(5, "F o4"), r"'o4', which the world does not have"),
        (
            lambda: tg.random_world(5, "F (o1 & o2)", max_tries=3),
            r"seed 5: in 3 placements on 10 x 10",
        ),
        (lambda: tg.random_world(5, shape=(3, 3), max_tries=3), "the objects had no room"),
        (lambda: tg.random_world(5, num_obstacles=-1), "num_obstacles=-1; it must be at least 0"),
        (lambda: tg.random_world(5, shape=(0, 3)), r"shape=\(0, 3\)"),
        (lambda: tg.make_world({"o9": [(1, 1)]}, 0), "'o9' is no kind of cell; there are o1, o2"),
        (lambda: tg.make_world({"o1": [(0, 3)]}, 0), r"o1 in cell \(0, 3\) is outside"),
        (
            lambda: tg.make_world({"o1": [(2, 3)], "o2": [(2, 3)]}, 0),
            r"cell \(2, 3\) is used twice",
        ),
        (
            lambda: tg.make_world({"o1": [(2, 3)], "o2": [(4, 4)]}, 0),
            r"patch of o2 in cell \(4, 4\)",
        ),
        (lambda: tg.make_world({"ob": [(2, 3), (2, 5)]}, 0), r"cell \(2, 4\) would be ob"),
        (lambda: tg.make_world({"ob": [(1, 1)]}, 0, shape=(1, 1)), "no cell is a distractor"),
        (lambda: tg.make_world({}, 0, margin=0), "margin=0"),
        (lambda: tg.make_world({}, 0, slip=1.5), "slip=1.5"),
        (lambda: tg.make_world({}, 0, objects={"a": {"red": 4}}), "are 4 cells; a patch has 9"),
        (
            lambda: tg.make_world({}, 0, objects={"a": {"blue": 9}}),
            "a: color='blue'; choose one of red",
        ),
        (
            lambda: tg.make_world({}, 0, objects={"a": {"red": 10, "black": -1}}),
            "black=-1; it must be at least 0",
        ),
        (
            lambda: tg.make_world({}, 0, objects={"a": {"black": 9}}),
            "a and ob have the same colours",
        ),
        (
            lambda: tg.make_world({}, 0, objects={"ob": {"red": 9}}),
            "both an object and an obstacle",
        ),
        (lambda: tg.categories(np.zeros((3, 3))), "type float64; pass integers"),
        (lambda: tg.categories([[0, 1, 2], [0, 5, 0], [0, 0, 0]]), r"colors\[1, 1\] = 5"),
    ],
)
def test_bad_worlds_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# --- the expert -------------------------------------------------------------------------------


def test_the_automaton_is_that_of_table_3():
    model = exit_product(tg.training_world())
    distance = np.asarray(tg._distance(model.automaton))
    assert sorted(distance) == [0, 1, 2, 3, np.inf] and distance[0] == 3
    over = np.asarray(tg.is_over(model))[0]
    assert over.tolist() == [d in (0, np.inf) for d in distance]


@pytest.mark.parametrize("label_on", ["entry", "exit"])
def test_the_expert_is_rewarded_by_where_the_task_goes(label_on):
    world = tg.training_world()
    model = jl.product(world.mdp, tg.COMPLETE, label_on=label_on)
    given = np.asarray(tg.expert_reward(model, progress=50, failure=-20, step=-2, won=7, lost=-9))
    kind = np.asarray(world.mdp.label) @ np.array([1, 2, 3, 4])  # 0: nothing
    # In the order of progress, what each kind of cell does: + on, - failing, . nothing.
    table = {3: ".+---", 2: "..+--", 1: "...+-"}
    value = {"+": 50, "-": -20, ".": -2}
    distance = np.asarray(tg._distance(model.automaton))
    successor = np.asarray(world.mdp.successor)[:, :, 0]
    for q, d in enumerate(distance):
        for s in range(100):
            for a in range(4):
                read = kind[s if label_on == "exit" else successor[s, a]]
                left = {0: 7, np.inf: -9}
                expected = left[d] if d in left else value[table[int(d)][read]]
                assert given[s, q, a] == expected


def test_rewards_on_entry_are_expected_over_slips():
    world = tg.make_world({"o1": [(1, 2)]}, 0, shape=(2, 2), slip=0.2)
    model = jl.product(world.mdp, "F o1", label_on="entry")
    reward = np.asarray(tg.expert_reward(model))[:, int(model.automaton.initial)]
    # From cell (1, 1), right enters o1 unless it slips; up and down slip into it by a tenth.
    np.testing.assert_allclose(reward[0], [0.1, 0.1, -1.0, 7.8], atol=1e-12)


@pytest.mark.slow
def test_demonstrations_end_where_the_task_is_decided():
    world = tg.training_world()
    model = exit_product(world)
    policy = tg.expert_policy(model)
    runs = tg.demonstrations(jax.random.key(1), model, policy, 60)
    assert runs.state.shape == (60, 100)
    lifted = jl.models.lift_trajectories(model, runs)
    memory = np.asarray(lifted.state) % model.num_memory
    after = np.asarray(model.next_memory)
    over, final = np.asarray(tg.is_over(model))[0], np.asarray(model.automaton.final)
    ends = []
    lengths = runs.length.tolist()
    for states, q, length in zip(np.asarray(runs.state), memory, lengths, strict=True):
        assert not over[q[:length]].any()
        ends.append(final[after[states[length - 1], q[length - 1]]])
        assert over[after[states[length - 1], q[length - 1]]] or length == 100
    assert np.mean(ends) > 0.9  # the expert does the task
    # They are runs of the world.
    rows = zip(runs.state.tolist(), runs.action.tolist(), runs.length.tolist(), strict=True)
    pairs = [list(zip(states, actions, strict=True))[:length] for states, actions, length in rows]
    assert jl.make_trajectories(world.mdp, pairs).length.tolist() == runs.length.tolist()


# --- text files -------------------------------------------------------------------------------


def test_worlds_survive_their_text():
    world = tg.random_world(1, "F o5", shape=(9, 12), objects=many_objects(5), margin=2, slip=0.15)
    again = read_world(write_world(world))
    assert jax.tree.structure(again) == jax.tree.structure(world)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-6), again, world)
    np.testing.assert_array_equal(again.mdp.label, world.mdp.label)


def test_a_map_alone_has_the_dissertations_kinds():
    world = read_world("rbrpp\nbrbpp\nrbrpp\n")
    assert world.shape == (1, 3) and world.mdp.propositions == ("o1", "o2", "o3", "ob")
    assert labelled(world)["o1"] == [(1, 1)]
    assert dict(tg.training_world().kinds) == dict(world.kinds)


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "the map is empty"),
        ("rrr\nrxr\nrrr", "map row 2, column 2: 'x' is no colour; use r "),
        ("rrr\nrrrr\nrrr", "map row 2 has 4 cells, row 1 has 3"),
        ("rrr\nrrr", r"colors have shape \(2, 3\)"),
        ("margin: two\n\nrrr\nrrr\nrrr", "line 1: margin is 'two', which is no number"),
        ("margin: 1\nmargn: 2\nrrr\nrrr\nrrr", "line 2: margn: '2'; write it as"),
        ("o1: 9 red\no1: 9 black\nrrr", "line 2: o1 is given twice"),
        ("o1: five red, 4 black\nrrr", "line 1: o1 is 'five', which is no number"),
        ("slip: 2\nrrr\nrrr\nrrr", "slip=2.0"),
    ],
)
def test_bad_texts_are_named(text, message):
    with pytest.raises(ValueError, match=message):
        read_world(text)
