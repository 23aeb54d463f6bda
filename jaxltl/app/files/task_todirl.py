"""Task files whose reward is to carry over to other worlds: ``method = "todirl"``.

Beside the tables of :mod:`jaxltl.app.files.task` there is ``[test]``, the worlds in which the
learned reward is put to use; ``examples/in_order.toml`` shows every key. Worlds are coloured grids
as :func:`jaxltl.io.colored_world.read_world` reads them, or text maps with a legend.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.app.files import tables
from jaxltl.app.files import task as tasks
from jaxltl.app.files.tables import COUNT, TEXT, Rule, choice, is_list, number_in
from jaxltl.app.files.task import Task, World
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.logic.labels import require_known
from jaxltl.core.logic.ltl import parse_ltl
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.trajectories import Trajectories
from jaxltl.envs import temporal_gridworld
from jaxltl.envs.cell_kinds import COLORS
from jaxltl.envs.gridworld import ACTIONS, gridworld
from jaxltl.envs.text_map import parse_map
from jaxltl.io.colored_world import read_world


class Scene(NamedTuple):
    """A world, and what is seen of it.

    Attributes:
      name: for people.
      mdp: the world.
      observation: ``float[S, O]``.
      shape: rows and columns.
      colored: the coloured world, or None for a text map.
      cells: ``str[rows, columns]``, or None for a coloured world.
    """

    name: str
    mdp: MDP
    observation: jax.Array
    shape: tuple[int, int]
    colored: temporal_gridworld.World | None
    cells: np.ndarray | None

    def place(self, state: int) -> dict[str, int]:
        """A state with its row and column, from 1."""
        return tasks.where(state, self.shape)


# --- the keys of each table -----------------------------------------------------------------


def _is_counts(value: Any) -> bool:
    return isinstance(value, dict) and all(
        isinstance(row, dict) and is_list(list(row.values()), int) for row in value.values()
    )


def _is_maps(value: Any) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(tables.MAP.holds(x) for x in value)


_WHOLE = Rule(lambda v: is_list([v], int) and v >= 0, "a whole number of at least 0")
_COUNTS = Rule(
    _is_counts, "a table of kinds and their colours, such as { o1 = { red = 5, black = 4 } }"
)
_MAPS = Rule(
    _is_maps,
    'a list of files and of maps with line breaks, such as ["map.txt"], with at least one of them',
)
_COLORED = {"objects": _COUNTS, "obstacles": _COUNTS, "margin": COUNT}
_REWARDS = ("progress", "failure", "step", "won", "lost")
_GENERATED = {
    "obstacles": _WHOLE,
    "min_distance": COUNT,
    "shape": Rule(lambda v: is_list(v, int) and len(v) == 2 and min(v) >= 1, "[rows, columns]"),
    "seed": _WHOLE,
}
_NO_LOG = Rule(
    lambda v: False,
    'left out: a log has no cells for a network to look around in; "mlirl" learns from logs',
)
_KEYS: dict[str, dict[str, Rule]] = {
    "world": {"maps": _MAPS, **_COLORED, **tasks.WORLD, "transitions": _NO_LOG},
    "task": tasks.TASK,
    "demonstrations": {
        "files": Rule(lambda v: is_list(v, str) and len(v) > 0, "a list of files, one per world"),
        **tasks.SYNTHETIC,
        **dict.fromkeys(_REWARDS, tables.NUMBER),
    },
    "learner": {
        "method": choice("todirl"),
        "discount": number_in(0, 1),
        "memory": TEXT,
        "radius": _WHOLE,
        "hidden": Rule(
            lambda v: is_list(v, int) and all(x >= 1 for x in v),
            "a list of the widths of the hidden layers, such as [80, 80]",
        ),
        **tasks.LEARNER,
        "patience": COUNT,
        "held_out": number_in(0, 1, below=True),
        "optimizer": choice("adam", "sgd", "rmsprop", "lbfgs"),
        "horizon": COUNT,
    },
    "test": {
        "maps": _MAPS,
        "generate": COUNT,
        **_GENERATED,
        "leave_out": Rule(lambda v: is_list(v, str), "a list of names of test worlds"),
    },
}


def read_task(path: str | Path) -> Task:
    """Reads a task file.

    Raises:
      ValueError: the file, or one that it names, is missing or malformed, or a key is
        unknown, missing or wrong. The message names the file, the place and the fix.
    """
    path = Path(path)
    required = {**tasks.REQUIRED, "world": ("maps",)}
    data, raw = tables.read_tables(path, "the task file", _KEYS, required)
    world, shown, test = data["world"], data["demonstrations"], data.get("test", {})
    if "legend" in world:
        tables.refuse(path, "world", world, _COLORED, "coloured worlds, which have no legend")
    else:
        of_text = ("wall", "absorbing", "initial")
        tables.refuse(path, "world", world, of_text, "maps with a legend")
    of_synthetic = ("discount", "length", *_REWARDS)
    tables.check_demonstrations(path, shown, "files", "files = [...]", of_synthetic)
    rewards = [key for key in _REWARDS if key in shown]
    tables.reject(
        path,
        "demonstrations",
        [
            (
                bool(rewards) and "discount" not in shown,
                f"{''.join(rewards[:1])} belongs to a demonstrator who maximises a reward; give its "
                "discount too, for example 0.95, or leave it out for runs of the quickest of the best "
                "policies",
            ),
        ],
    )
    files, number = shown.get("files", world["maps"]), len(world["maps"])
    tables.reject(
        path,
        "demonstrations",
        [
            (
                len(files) != number,
                f"names {len(files)} files for {number} worlds; give one for each "
                "of [world] maps, in their order",
            ),
        ],
    )
    _check_learner(path, data["learner"])
    if "test" in data:
        _check_test(path, test, "legend" in world)
    named = [*_files(world), *_files(test), *shown.get("files", ())]
    return tasks.make_task(path, data, raw, named, "exit")


def _check_learner(path: Path, learner: Mapping[str, Any]) -> None:
    tables.reject(
        path,
        "learner",
        (
            (
                learner["discount"] == 1 and "horizon" not in learner,
                "discount = 1 needs a horizon, the number of steps of a run; or choose a discount below "
                "1, such as 0.95",
            ),
            (
                learner.get("optimizer") == "lbfgs" and "learning_rate" in learner,
                'learning_rate does not belong to optimizer = "lbfgs", which searches for its own',
            ),
            (
                learner.get("held_out") == 0 and "patience" in learner,
                "patience waits for a better held-out likelihood; it needs a held_out above 0",
            ),
        ),
    )


def _check_test(path: Path, test: Mapping[str, Any], plain: bool) -> None:
    tables.reject(
        path,
        "test",
        (
            (
                "maps" not in test and "generate" not in test,
                "must have maps = [...] or generate = N, or both",
            ),
            (
                "generate" in test and plain,
                "generate makes coloured worlds; where [world] has a legend, give maps = [...]",
            ),
        ),
    )
    if "generate" not in test:
        tables.refuse(path, "test", test, _GENERATED, "generate = N")


def _files(table: Mapping[str, Any]) -> list[str]:
    """The files that a table's maps name."""
    return [name for name in map(_file_of, table.get("maps", ())) if name is not None]


def _file_of(entry: str | Mapping[str, str]) -> str | None:
    if isinstance(entry, Mapping):
        return entry["file"]
    return None if "\n" in entry else entry


# --- worlds ---------------------------------------------------------------------------------


def load_scenes(task: Task, judge: Automaton) -> tuple[list[Scene], list[Scene]]:
    """The worlds to learn in and those to test in.

    Args:
      task: the task file.
      judge: the automaton of the task, which can be done in generated worlds.

    Raises:
      ValueError: a malformed map, or worlds that do not fit each other. The message names the
        table, the world and the place.
    """
    training = [_read_scene(task, "world", i) for i in range(len(task.world["maps"]))]
    test = [_read_scene(task, "test", i) for i in range(len(task.test.get("maps", ())))]
    first = training[0]
    for scene in [*training, *test]:
        if scene.colored and first.colored and scene.colored.kinds != first.colored.kinds:
            raise ValueError(
                f"{task.path}: {scene.name} has other objects and obstacles than {first.name}; "
                "give all of them by [world] objects and obstacles, or alike in each map."
            )
    if "generate" in task.test:
        test += _generate(task, first, judge)
    for table, scenes in (("world", training), ("test", test)):
        names = [scene.name for scene in scenes]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(
                    f"{task.path}: [{table}] maps has {name} twice; leave one of them out."
                )
    for name in task.test.get("leave_out", ()):
        if name not in [scene.name for scene in test]:
            raise ValueError(
                f"{task.path}: [test] leave_out names {name!r}, which is no test world; there are "
                f"{', '.join(scene.name for scene in test[:8])}{', ...' if len(test) > 8 else ''}."
            )
    return training, test


def _read_scene(task: Task, table: str, number: int) -> Scene:
    source = task.world if table == "world" else task.test
    entry = source["maps"][number]
    file = _file_of(entry)
    name = f"map {number + 1}" if file is None else file
    with tables.errors_in(f"{task.path}: [{table}] {name}: "):
        text = entry if file is None else tables.read_map(task.path, {"file": file})
        if task.is_colored:
            return _colored_scene(name, text, task.world, task.radius)
        return _plain_scene(name, text, task.world, task.radius)


def _with_settings(text: str, world: Mapping[str, Any]) -> str:
    """The text of a coloured world, followed by the settings of the task file that it lacks."""
    own = {line.partition(":")[0].strip() for line in text.splitlines() if ":" in line}
    lines = [f"{key}: {world[key]}" for key in ("margin", "slip") if key in world]
    if _gives_kinds(world) and own <= {"margin", "slip"}:
        for name, counts in [*_counts(world, "objects"), *_counts(world, "obstacles")]:
            shown = ", ".join(f"{n} {color}" for color, n in counts.items())
            lines.append(f"{name}: {shown}")
    return "\n".join([text, *lines])


def _gives_kinds(world: Mapping[str, Any]) -> bool:
    return "objects" in world or "obstacles" in world


def _counts(world: Mapping[str, Any], key: str) -> list[tuple[str, Mapping[str, int]]]:
    default = {
        "objects": temporal_gridworld.OBJECTS,
        "obstacles": temporal_gridworld.OBSTACLES,
    }
    return list(world.get(key, default[key]).items())


def _colored_scene(name: str, text: str, world: Mapping[str, Any], radius: int) -> Scene:
    found = read_world(_with_settings(text, world))
    if _gives_kinds(world):
        given = dict([*_counts(world, "objects"), *_counts(world, "obstacles")])
        own = {
            kind: {c: n for c, n in zip(COLORS, row, strict=True) if n} for kind, row in found.kinds
        }
        if own != {k: {c: n for c, n in row.items() if n} for k, row in given.items()}:
            raise ValueError(
                f"the map says {', '.join(own)} by lines of its own, which differ from [world] "
                "objects and obstacles; remove one of the two."
            )
    return _of_world(name, found, radius)


def _of_world(name: str, world: temporal_gridworld.World, radius: int) -> Scene:
    if radius > world.margin:
        raise ValueError(
            f"the learner sees {radius} cells around its own, the map has a margin of "
            f"{world.margin}; give [learner] radius = {world.margin}, or a map with a wider margin."
        )
    seen = temporal_gridworld.observations(world, radius)
    return Scene(name, world.mdp, seen, world.shape, world, None)


def _plain_scene(name: str, text: str, world: Mapping[str, Any], radius: int) -> Scene:
    options = {k: v for k, v in world.items() if k != "maps"}
    cells = parse_map(text)
    mdp = gridworld(text, **options)
    seen = cell_observations(cells, cell_kinds(world), radius)
    rows, columns = cells.shape
    return Scene(name, mdp, jnp.asarray(seen, mdp.dtype), (rows, columns), None, cells)


def cell_kinds(world: Mapping[str, Any]) -> list[str]:
    """The kinds of cells of maps with a legend; what is seen off the map comes after them."""
    wall = world.get("wall", "#")
    return [*(kind for kind in world["legend"] if kind != wall), wall]


def cell_observations(cells: np.ndarray, kinds: Sequence[str], radius: int) -> np.ndarray:
    """The kinds of the cells around each cell, one-hot: ``float[S, O]``.

    ``O = (2 * radius + 1)**2 * (K + 1)`` for K kinds, the last of which is off the map.

    Example:
      >>> cell_observations(np.array([["a", "b"]]), ["a", "b"], 0).tolist()
      [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """
    number = np.full(tuple(n + 2 * radius for n in cells.shape), len(kinds))
    inside = tuple(slice(radius, radius + n) for n in cells.shape)
    number[inside] = np.searchsorted(sorted(kinds), cells)
    order = np.append(np.argsort(kinds), len(kinds))  # from sorted kinds to their places
    width = 2 * radius + 1
    around = np.lib.stride_tricks.sliding_window_view(order[number], (width, width))
    return np.eye(len(kinds) + 1)[around].reshape(cells.size, -1)


def _generate(task: Task, first: Scene, judge: Automaton) -> list[Scene]:
    spec, world = task.test, task.world
    assert first.colored is not None
    objects, obstacles = (dict(_counts(world, key)) for key in ("objects", "obstacles"))
    kinds = [name for name, _ in first.colored.kinds]
    if kinds != [*objects, *obstacles]:
        raise ValueError(
            f"{task.path}: [test] generate must know which kinds of cells are objects, of which "
            "there is one each; give [world] objects and obstacles, not lines in the maps."
        )
    label = np.asarray(first.mdp.label)
    shown = [int(label[:, kinds.index(name)].sum()) for name in obstacles]
    slip = 0.0
    if first.mdp.num_successors > 1:
        slip = 1 - float(first.mdp.probability[0, 0, 0])
    seeds = range(spec.get("seed", 0), spec.get("seed", 0) + spec["generate"])
    with tables.errors_in(f"{task.path}: [test] generate: "):
        made = temporal_gridworld.random_worlds(
            seeds,
            judge,
            shape=tuple(spec.get("shape", first.shape)),
            objects=objects,
            obstacles=obstacles,
            num_obstacles=spec.get("obstacles", max(shown, default=0)),
            min_distance=spec.get("min_distance", 3),
            margin=first.colored.margin,
            slip=slip,
        )
    return [
        _of_world(f"seed {seed}", world, task.radius)
        for seed, world in zip(seeds, made, strict=True)
    ]


# --- automata -------------------------------------------------------------------------------


def load_automata(task: Task) -> tuple[Automaton, Automaton]:
    """The automaton of the task, and the one that is the learner's memory.

    Both are over all labels that a cell can have, whichever the worlds show, so that memory means
    the same in every world.

    Raises:
      ValueError: a malformed formula, an unknown proposition, or a horizon for a task without end.
    """
    alphabet = _alphabet(task)
    judge = _translate(task, "[task] formula", task.formula, alphabet)
    if "horizon" in task.learner and judge.acceptance not in ("cosafe", "safety"):
        raise ValueError(
            f"{task.path}: [learner] horizon = {task.learner['horizon']} ends a run after so many "
            f"steps, by which no task without end is done (the formula has {judge.acceptance} "
            "acceptance); leave it out, with a discount below 1."
        )
    if task.memory == task.formula:
        return judge, judge
    return judge, _translate(task, "[learner] memory", task.memory, alphabet)


def _alphabet(task: Task) -> list[frozenset[str]]:
    if not task.is_colored:
        shown = [frozenset(names) for names in task.world["legend"].values()]
        return list(dict.fromkeys([frozenset(), *shown]))
    colored = _read_scene(task, "world", 0).colored
    assert colored is not None
    return [frozenset(), *(frozenset({name}) for name, _ in colored.kinds)]


def _translate(task: Task, place: str, text: str, alphabet: list[frozenset[str]]) -> Automaton:
    names = sorted(frozenset().union(*alphabet))
    with tables.errors_in(f"{task.path}: {place}: "):
        formula = parse_ltl(text)
        require_known(formula.propositions, names, "the formula")
        read = dict.fromkeys(letter & set(formula.propositions) for letter in alphabet)
        return to_automaton(formula, letters=list(read))


# --- demonstrations -------------------------------------------------------------------------


def load_demonstrations(task: Task, scenes: Sequence[Scene]) -> list[Trajectories]:
    """The demonstrations in each of the training worlds, from their files.

    Raises:
      ValueError: see :func:`jaxltl.app.files.task.read_demonstrations`.
    """
    found = []
    for name, scene in zip(task.demonstrations["files"], scenes, strict=True):
        size = np.arange(scene.mdp.num_states).reshape(scene.shape).astype(str)
        world = World(scene.mdp, size, ACTIONS)
        found.append(tasks.read_demonstrations(task.path.parent / name, world))
    return found


def expert_rewards(task: Task) -> dict[str, float]:
    """The rewards of the synthetic demonstrator that the file gives."""
    return {k: task.demonstrations[k] for k in _REWARDS if k in task.demonstrations}
