"""Training and test worlds of todirl: maps with their observations, and automata over them."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.validation import errors_in
from jaxltl.app.files.task_irl import TodirlFile, ScenesTable, map_file, read_entry
from jaxltl.app.files.worlds import MappedModel, grid_options
from jaxltl.core.automata import Automaton, to_automaton
from jaxltl.core.logic.labels import require_known
from jaxltl.core.logic.ltl import parse_ltl
from jaxltl.envs import temporal_gridworld
from jaxltl.envs.gridworld import ACTIONS, gridworld
from jaxltl.envs.text_map import cell_observations, parse_map
from jaxltl.io.colored_world import read_world


@dataclass(frozen=True, kw_only=True)
class ObservedScene(MappedModel):
    """A world and its observations."""

    name: str  # for people
    observation: jax.Array  # float[S, O]
    colored: temporal_gridworld.World | None = None  # the coloured world, or None for a text map
    actions: tuple[str, ...] = ACTIONS

    @property
    def shape(self) -> tuple[int, int]:
        rows, columns = (self.colored or self.cells).shape  # type: ignore[union-attr]
        return rows, columns


def load_scenes(
    task: TodirlFile, automaton: Automaton
) -> tuple[list[ObservedScene], list[ObservedScene]]:
    """The training worlds and the test worlds."""
    test_maps = (task.test and task.test.maps) or []
    training = [_read_scene(task, "world", i, x) for i, x in enumerate(task.world.maps)]
    test = [_read_scene(task, "test", i, x) for i, x in enumerate(test_maps)]
    first = training[0]
    for scene in [*training, *test]:
        if scene.colored and first.colored and scene.colored.kinds != first.colored.kinds:
            raise ValueError(
                f"{task.path}: {scene.name} has other objects and obstacles than {first.name}; "
                "give all of them by [world] objects and obstacles, or alike in each map."
            )
    if task.test is not None and task.test.generate is not None:
        test += _generate(task, task.test.generate, first, automaton)
    for table, scenes in (("world", training), ("test", test)):
        names = [scene.name for scene in scenes]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"{task.path}: [{table}] maps has {twice[0]} twice; leave one out.")
    if unknown := [name for name in task.left_out if name not in names]:  # of the test worlds
        raise ValueError(
            f"{task.path}: [test] leave_out names {unknown[0]!r}, which is no test world; there are "
            f"{', '.join(names[:8])}{', ...' if len(test) > 8 else ''}."
        )
    return training, test


def _read_scene(
    task: TodirlFile, table: str, number: int, entry: str | dict[str, str]
) -> ObservedScene:
    name = map_file(entry) or f"map {number + 1}"
    with errors_in(f"{task.path}: [{table}] {name}: "):
        text = read_entry(task.path, entry)
        world, radius = task.world, task.learner.radius
        if task.is_colored:
            names = ("margin", "slip", "objects", "obstacles")
            settings = {k: v for k, v in world.specified().items() if k in names}
            return _of_world(name, read_world(text, **settings), radius)
        cells, mdp = parse_map(text), gridworld(text, **grid_options(world))
        seen = jnp.asarray(cell_observations(cells, cell_kinds(world), radius), mdp.dtype)
        return ObservedScene(mdp=mdp, cells=cells, name=name, observation=seen)


def _of_world(name: str, world: temporal_gridworld.World, radius: int) -> ObservedScene:
    if radius > world.margin:
        raise ValueError(
            f"the learner sees {radius} cells around its own, the map has a margin of "
            f"{world.margin}; give [learner] radius = {world.margin}, or a map with a wider margin."
        )
    seen = temporal_gridworld.observations(world, radius)
    return ObservedScene(mdp=world.mdp, cells=None, name=name, observation=seen, colored=world)


def cell_kinds(world: ScenesTable) -> list[str]:
    """The kinds of cells of maps with a legend, in the order of observations."""
    wall = world.wall or "#"
    return [*(kind for kind in world.legend or () if kind != wall), wall]


def _generate(
    task: TodirlFile, number: int, first: ObservedScene, automaton: Automaton
) -> list[ObservedScene]:
    table, colored = task.test, first.colored
    assert table is not None and colored is not None
    world = task.world
    objects = temporal_gridworld.OBJECTS if world.objects is None else world.objects
    obstacles = temporal_gridworld.OBSTACLES if world.obstacles is None else world.obstacles
    kinds = [name for name, _ in colored.kinds]
    if kinds != [*objects, *obstacles]:
        raise ValueError(
            f"{task.path}: [test] generate must know which kinds of cells are objects, of which "
            "there is one each; give [world] objects and obstacles, not lines in the maps."
        )
    label = np.asarray(first.mdp.label)
    counts = [int(label[:, kinds.index(name)].sum()) for name in obstacles]
    slip = 0.0
    if first.mdp.num_successors > 1:
        slip = 1 - float(first.mdp.probability[0, 0, 0])
    start = table.seed or 0
    seeds = range(start, start + number)
    with errors_in(f"{task.path}: [test] generate: "):
        worlds = temporal_gridworld.random_worlds(
            seeds,
            automaton,
            shape=table.shape or first.shape,
            objects=objects,
            obstacles=obstacles,
            num_obstacles=(max(counts, default=0) if table.obstacles is None else table.obstacles),
            min_distance=table.min_distance or 3,
            margin=colored.margin,
            slip=slip,
        )
    return [
        _of_world(f"seed {seed}", world, task.learner.radius)
        for seed, world in zip(seeds, worlds, strict=True)
    ]


# --- automata -------------------------------------------------------------------------------


def load_automata(task: TodirlFile) -> tuple[Automaton, Automaton]:
    """Automata of the formula and the memory, over the labels of all kinds of cells."""
    alphabet = _alphabet(task)
    automaton = _translate(task, "[task] formula", task.formula, alphabet)
    if task.learner.horizon is not None and not automaton.has_final_states:
        raise ValueError(
            f"{task.path}: [learner] horizon = {task.learner.horizon} ends an episode after so "
            "many steps, which satisfy co-safe formulas and violate safety formulas only (the "
            f"formula has {automaton.acceptance} acceptance); leave it out, with a discount below 1."
        )
    if task.memory == task.formula:
        return automaton, automaton
    return automaton, _translate(task, "[learner] memory", task.memory, alphabet)


def _alphabet(task: TodirlFile) -> list[frozenset[str]]:
    if task.world.legend is not None:
        letters = [frozenset(names) for names in task.world.legend.values()]
        return list(dict.fromkeys([frozenset(), *letters]))
    colored = _read_scene(task, "world", 0, task.world.maps[0]).colored
    assert colored is not None
    return [frozenset(), *(frozenset({name}) for name, _ in colored.kinds)]


def _translate(
    task: TodirlFile, place: str, text: str, alphabet: list[frozenset[str]]
) -> Automaton:
    names = sorted(frozenset().union(*alphabet))
    with errors_in(f"{task.path}: {place}: "):
        formula = parse_ltl(text)
        require_known(formula.propositions, names, "the formula")
        letters = dict.fromkeys(letter & set(formula.propositions) for letter in alphabet)
        return to_automaton(formula, letters=list(letters))
