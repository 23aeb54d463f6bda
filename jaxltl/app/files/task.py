"""Task files: what to do, where, shown how, learned by what. Reading and checking them.

A task file is TOML with the tables ``[world]``, ``[task]``, ``[demonstrations]`` and
``[learner]``; ``examples/two_goals.toml`` shows every key. Files that it names are looked up
beside it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from jaxltl.app.files import tables
from jaxltl.app.files.tables import COUNT, NAMES, TEXT, Rule, choice, is_list, is_number, number_in
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.logic.labels import satisfying
from jaxltl.core.models.construct.counts import listed
from jaxltl.core.models.construct.lifting import project_trajectories
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.product import Product
from jaxltl.core.models.trajectories import Trajectories, make_trajectories
from jaxltl.core.types import Solution
from jaxltl.envs.gridworld import ACTIONS, gridworld
from jaxltl.envs.text_map import parse_map
from jaxltl.io.prism.explicit import files_beside

if TYPE_CHECKING:
    from jaxltl.app.logged import Logged


@dataclass(frozen=True)
class Task:
    """A checked task file.

    Attributes:
      path: the file; `name` is its stem, unless the file gives one.
      world, demonstrations, learner, test: the tables' keys and values, all known and of the
        right kind; keys that were left out are absent.
      formula: the task.
      label_on: which label a step of the product reads, ``"entry"`` or ``"exit"``.
      guarantee: what the policy is to guarantee: ``"best"``, ``"none"`` or a probability.
      over: of which initial states, ``"mean"`` or ``"worst"``.
      digest: a fingerprint of the file and of every file that it names.
    """

    path: Path
    name: str
    world: Mapping[str, Any]
    formula: str
    label_on: str
    demonstrations: Mapping[str, Any]
    learner: Mapping[str, Any]
    digest: str
    test: Mapping[str, Any] = field(default_factory=dict)
    guarantee: str | float = "best"
    over: str = "mean"

    @property
    def memory(self) -> str:
        """The formula whose automaton is the learner's memory; the task's own unless given."""
        return str(self.learner.get("memory", self.formula))

    @property
    def radius(self) -> int:
        """How far around its cell the learner sees."""
        return int(self.learner.get("radius", 1))

    @property
    def is_colored(self) -> bool:
        """Whether worlds are coloured grids, not text maps with a legend."""
        return "legend" not in self.world


def make_task(
    path: Path, data: Mapping[str, Any], raw: bytes, named: Sequence[str], label_on: str
) -> Task:
    """A task of a file's checked tables and bytes, the files that it names, and a default."""
    return Task(
        path=path,
        name=data.get("name", path.stem),
        world=data["world"],
        formula=data["task"]["formula"],
        label_on=data["task"].get("label_on", label_on),
        demonstrations=data["demonstrations"],
        learner=data["learner"],
        digest=tables.digest(path, raw, named),
        test=data.get("test", {}),
        guarantee=_guarantee(path, data),
        over=data["task"].get("over", "mean"),
    )


def _guarantee(path: Path, data: Mapping[str, Any]) -> str | float:
    """What a file asks for; a learner that does not see the task cannot guarantee it."""
    task, learner = data["task"], data["learner"]
    blind = [k for k in ("memory", "horizon") if k in learner]
    blind += ['in = "world"'] if learner.get("in") == "world" else []
    asked: str | float = task.get("guarantee", "none" if blind else "best")
    number = not isinstance(asked, str)
    tables.reject(
        path,
        "task",
        (
            (
                bool(blind) and asked != "none",
                f"guarantee = {asked!r} needs a learner that sees the task and has the time for it: leave "
                f"out {''.join(blind[:1])}",
            ),
            ("over" in task and not number, "over belongs to a guarantee that is a probability"),
            (
                number and "mu" in learner,
                f"guarantee = {asked} finds the weight mu that reaches it: leave mu out of [learner]",
            ),
        ),
    )
    return asked


class World(NamedTuple):
    """A model, with its map if it has one.

    Attributes:
      mdp: the model.
      cells: ``str[rows, columns]``, or None for a model from arrays.
      actions: A names.
      logged: the log that the model was counted from, or None.
    """

    mdp: MDP
    cells: np.ndarray | None
    actions: tuple[str, ...]
    logged: Logged | None = None

    def where(self, state: int) -> dict[str, Any]:
        """A state's number from 0 and, on a map, its row and column from 1; of a log, its name."""
        found = where(state, None if self.cells is None else self.cells.shape)
        return found if self.logged is None else {**found, "name": self.logged.states[state]}

    def place(self, state: int) -> str:
        """A state for people."""
        return place(self.where(state))


def where(state: int, shape: Sequence[int] | None) -> dict[str, Any]:
    """A state's number from 0 and, on a map of a shape, its row and column from 1."""
    if shape is None:
        return {"state": int(state)}
    row, column = divmod(int(state), shape[1])
    return {"state": int(state), "row": row + 1, "column": column + 1}


def place(where: Mapping[str, Any]) -> str:
    """A state as people name it: row and column from 1 on a map, else its name, or number from 0."""
    if "row" in where:
        return f"row {where['row']}, column {where['column']}"
    return f"state {where.get('name', where['state'])}"


def many(number: int, what: str) -> str:
    """A number of things, in words."""
    return f"{number} {what}{'' if number == 1 else 's'}"


# --- the keys of each table -----------------------------------------------------------------


# Of task files of any method.
WORLD = {
    "legend": tables.LEGEND,
    "wall": TEXT,
    "slip": number_in(0, 1),
    "absorbing": NAMES,
    "initial": TEXT,
}
TASK = {
    "formula": TEXT,
    "label_on": choice("entry", "exit"),
    "guarantee": Rule(
        lambda v: v in ("best", "none") or (is_number(v) and 0 < v <= 1),
        '"best", "none" or a probability in (0, 1]',
    ),
    "over": choice("mean", "worst"),
}
SYNTHETIC = {"synthetic": COUNT, "discount": number_in(0, 1, below=True), "length": COUNT}
LEARNER = {"l2": number_in(0), "learning_rate": number_in(0), "steps": COUNT}
REQUIRED: dict[str, Sequence[str]] = {
    "": ("world", "task", "demonstrations", "learner"),
    "task": ("formula",),
    "learner": ("method", "discount"),
}
_NAMES_OF_STATES = Rule(lambda v: is_list(v, str) and bool(v), "a list of names of states")
_OF_LOG: dict[str, Rule] = {
    "confidence": Rule(
        lambda v: is_number(v) and 0 < v < 1, "a number between 0 and 1, such as 0.95"
    ),
    "labels": TEXT,
    "terminal": _NAMES_OF_STATES,
    "graph": choice("seen", "complete"),
    "method": choice("anytime", "clopper-pearson", "hoeffding", "weissman"),
}
_KEYS: dict[str, dict[str, Rule]] = {
    "world": {
        "map": tables.MAP,
        **WORLD,
        "model": TEXT,
        "transitions": TEXT,
        **_OF_LOG,
        "initial": Rule(
            lambda v: TEXT.holds(v) or _NAMES_OF_STATES.holds(v),
            "a text; of a log, the name of a state or a list of names",
        ),
    },
    "task": TASK,
    "demonstrations": {"file": TEXT, **SYNTHETIC},
    "learner": {
        # Files of other methods are read by modules of their own; see method_of.
        "method": Rule(lambda v: v == "mlirl", '"mlirl" or "todirl"'),
        "in": choice("product", "world"),
        "discount": number_in(0, 1, below=True),
        "mu": number_in(0),
        **LEARNER,
        "policy": choice("boltzmann", "soft"),
        "adjoint": choice("exact", "approximate"),
        "optimizer": choice("lbfgs", "adam", "sgd"),
        "tolerance": number_in(0),
        "start": Rule(
            lambda v: isinstance(v, list) and all(map(is_number, v)),
            "a list of finite numbers, one per feature",
        ),
        "start_scale": number_in(0),
        "satisfaction_over": choice("initial", "all"),
        "avoid": NAMES,
        "goal": NAMES,
        "progress": Rule(
            lambda v: is_list(v, str) or is_list(v, int),
            "a list of propositions (in the world) or of automaton states (in the product)",
        ),
    },
}


def method_of(path: str | Path) -> Any:
    """What a task file says of ``[learner] method``, unchecked; None if it says nothing.

    Raises:
      ValueError: the file cannot be read or is no TOML.
    """
    learner = tables.read_toml(Path(path), "the task file")[0].get("learner")
    return learner.get("method") if isinstance(learner, dict) else None


def read_task(path: str | Path) -> Task:
    """Reads a task file.

    Raises:
      ValueError: the file, or one that it names, is missing or malformed, or a key is
        unknown, missing or wrong. The message names the file, the place and the fix.
    """
    path = Path(path)
    data, raw = tables.read_tables(path, "the task file", _KEYS, REQUIRED)
    world, shown = data["world"], data["demonstrations"]
    tables.check_source(path, "world", world, ("legend", "wall", "slip", "absorbing"), _OF_LOG)
    tables.reject(
        path,
        "world",
        (
            (
                "transitions" in world and "confidence" not in world,
                "lacks confidence, with which the log is to guarantee something, such as 0.95",
            ),
            (
                "transitions" in world and "initial" not in world,
                "lacks initial, the name of the state in which runs start, or a list of names",
            ),
            (
                "transitions" not in world and isinstance(world.get("initial"), list),
                "initial is a list of names of states, which a log has; here it must be a text",
            ),
        ),
    )
    tables.check_demonstrations(path, shown, "file", 'file = "..."', ("discount", "length"))
    _check_learner(path, data["learner"])
    text = world.get("map")
    named = [text["file"]] if isinstance(text, dict) else []
    files = (world, "model"), (world, "transitions"), (world, "labels"), (shown, "file")
    named += [table[key] for table, key in files if key in table]
    if "model" in world:  # PRISM's labels stand in a file of their own
        named += [str(x.absolute()) for x in files_beside(path.parent / world["model"])]
    return make_task(path, data, raw, named, "entry")


def _check_learner(path: Path, learner: Mapping[str, Any]) -> None:
    in_world, progress = learner.get("in", "product") == "world", learner.get("progress", ())
    kind: type = str if in_world else int
    wanted = "propositions" if in_world else "automaton states (or left out)"
    tables.reject(
        path,
        "learner",
        (
            (
                in_world and "goal" not in learner,
                'lacks goal, the propositions of the goal cells, which in = "world" needs since the '
                "learner does not see the formula",
            ),
            (
                in_world and "mu" in learner,
                'mu weighs the probability of doing the task; it needs in = "product"',
            ),
            (not in_world and "goal" in learner, 'goal belongs to in = "world"'),
            (
                "learning_rate" in learner and learner.get("optimizer", "lbfgs") == "lbfgs",
                'learning_rate belongs to optimizer = "adam" or "sgd"; "lbfgs", the default, searches for '
                "its own",
            ),
            (
                any(not isinstance(x, kind) for x in progress),
                f"progress = {progress!r}; it must be a list of {wanted}",
            ),
        ),
    )


# --- the world ------------------------------------------------------------------------------


def load_world(task: Task) -> World:
    """The model that a task file describes.

    Raises:
      ValueError: a malformed map or model. The message names the file and the place.
    """
    spec = dict(task.world)
    with tables.errors_in(f"{task.path}: [world] "):
        if "transitions" in spec:
            # Deferred: that of a log is more than a map needs.
            from jaxltl.app.logged import load_logged

            mdp, actions, logged = load_logged(task.path.parent, spec)
            return World(mdp, None, actions, logged)
        if "model" in spec:
            path = task.path.parent / spec["model"]
            # Deferred: readers of all formats are more than a map needs.
            from jaxltl.app.files.models import read_padded

            found = read_padded(path)
            mdp = initial_where(found.mdp, spec.get("initial"), path)
            return World(mdp, None, found.actions)
        text = tables.read_map(task.path, spec.pop("map"))
        return World(gridworld(text, **spec), parse_map(text), ACTIONS)


def initial_where(mdp: MDP, formula: str | None, path: Path) -> MDP:
    """The model of a file, starting uniformly where a Boolean formula holds; None leaves it."""
    if formula is None:
        return mdp
    with tables.errors_in(f"{str(path)!r}: "):
        return replace(mdp, initial=_where_holds(formula, mdp))


def _where_holds(formula: str, mdp: MDP) -> jax.Array:
    """The uniform distribution over the states whose labels satisfy a propositional formula."""
    holds = satisfying(np.asarray(mdp.label), mdp.propositions, formula, "initial")
    if not holds.any():
        raise ValueError(f"initial={formula!r} holds in no state.")
    return jax.numpy.asarray(holds / holds.sum(), mdp.dtype)


# --- demonstrations -------------------------------------------------------------------------


def load_demonstrations(task: Task, world: World) -> Trajectories:
    """The demonstrations of a task's file; see :func:`read_demonstrations`."""
    return read_demonstrations(task.path.parent / task.demonstrations["file"], world)


def read_demonstrations(path: Path, world: World) -> Trajectories:
    """The demonstrations of a file.

    The file is JSON, ``{"demonstrations": [...]}``. Each demonstration is an object with
    ``"cells"``, ``[row, column]`` counted from 1 at the top left (or ``"states"``, numbers
    counted from 0), and ``"actions"``, names or numbers from 0, one per cell. A cell more than
    actions is where the demonstration ended. In the world of a log, states and actions are those
    names that the log has.

    Raises:
      ValueError: not such a file, or a demonstration that the world cannot have made. The
        message names the demonstration and the step, both counted from 1.
    """
    try:
        data = json.loads(tables.read_bytes(path, "the demonstrations"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: this is not JSON: {error}") from None
    shown = data.get("demonstrations") if isinstance(data, dict) else None
    if not isinstance(shown, list) or not shown:
        raise ValueError(
            f'{path}: expected {{"demonstrations": [...]}} with at least one demonstration.'
        )
    sequences = []
    for number, one in enumerate(shown, start=1):
        with tables.errors_in(f"{path}: demonstration {number}"):
            sequences.append(_read_demonstration(one, world))
    return make_trajectories(world.mdp, sequences)


def _read_demonstration(one: Any, world: World) -> list[tuple[int, int]]:
    keys = set(one) if isinstance(one, dict) else set()
    if keys not in ({"cells", "actions"}, {"states", "actions"}):
        found = f"it has {', '.join(map(repr, sorted(keys)))}" if keys else f"got {one!r:.60}"
        raise ValueError(
            f': expected {{"cells": [[row, column], ...], "actions": [...]}}, or "states" in place '
            f'of "cells"; {found}.'
        )
    kind = "cells" if "cells" in keys else "states"
    places, names = one[kind], one["actions"]
    if not isinstance(places, list) or not isinstance(names, list) or not names:
        raise ValueError(f": {kind} and actions must be lists, with at least one action.")
    if len(places) - len(names) not in (0, 1):
        raise ValueError(
            f": {len(places)} {kind} and {len(names)} actions; give one action for each of the "
            f"{kind}, except perhaps the last."
        )
    read = _read_cell if kind == "cells" else _read_state
    states, actions = (_each_step(*x, world) for x in ((read, places), (_read_action, names)))
    available = np.asarray(world.mdp.available)
    successor, probability = np.asarray(world.mdp.successor), np.asarray(world.mdp.probability)
    for t, (s, a) in enumerate(zip(states, actions, strict=False)):
        doing = f", step {t + 1}: {world.actions[a]!r} in {world.place(s)}"
        if not available[s, a]:
            can = ", ".join(np.array(world.actions)[available[s]])
            raise ValueError(f"{doing} is not available there; available are {can}.")
        reached = np.unique(successor[s, a][probability[s, a] > 0])
        if t + 1 < len(states) and states[t + 1] not in reached:
            can = " or ".join(world.place(r) for r in reached)
            raise ValueError(
                f"{doing} cannot lead to {world.place(states[t + 1])}, which comes next; it "
                f"leads to {can}."
            )
    return list(zip(states, actions, strict=False))


def _each_step(read: Callable[[Any, World], int], values: list[Any], world: World) -> list[int]:
    found = []
    for step, value in enumerate(values, start=1):
        with tables.errors_in(f", step {step}: "):
            found.append(read(value, world))
    return found


def _read_cell(value: Any, world: World) -> int:
    if world.cells is None:
        raise ValueError('the model has no map, so give "states" instead of "cells".')
    if not (is_list(value, int) and len(value) == 2):
        raise ValueError(f"the cell is {value!r}; it must be [row, column].")
    row, column = value
    rows, columns = world.cells.shape
    if not (1 <= row <= rows and 1 <= column <= columns):
        raise ValueError(f"the cell [{row}, {column}] is {tables.off_map(world.cells.shape)}")
    return (row - 1) * columns + column - 1


def _read_state(value: Any, world: World) -> int:
    if world.logged is not None:
        return _read_name("state", value, world.logged.states)
    last = world.mdp.num_states - 1
    if not is_list([value], int) or not 0 <= value <= last:
        raise ValueError(f"the state is {value!r}; states are 0 to {last}.")
    return int(value)


def _read_name(what: str, value: Any, names: tuple[str, ...]) -> int:
    """The number of what a log names; a name that is a number may stand without quotes."""
    name = str(value) if is_list([value], int) else value
    if name in names:
        return names.index(name)
    raise ValueError(f"the {what} {value!r} is not in the log, which has {listed(names)}.")


def _read_action(value: Any, world: World) -> int:
    if world.logged is not None:
        return _read_name("action", value, world.actions)
    if value in world.actions:
        return world.actions.index(value)
    if is_list([value], int) and 0 <= value < len(world.actions):
        return int(value)
    raise ValueError(
        f"the action {value!r} is unknown; the actions are {', '.join(world.actions)}."
    )


_STEP_BYTES = 128  # of a demonstrated step, while runs are made and checked
_MOST_BYTES = 4e9


def synthetic_demonstrations(
    task: Task, model: Product, key: jax.Array, best: Solution
) -> tuple[Trajectories, int]:
    """Runs of the quickest of the best policies, in the world.

    With a discount in ``[demonstrations]``, those of a policy that maximises the discounted reward
    of doing a co-safe task. A run of a co-safe task ends where it is done; one that has not done
    it within the asked length, or starts where it is done, shows nothing and is dropped. Runs of
    other tasks have the asked length, and are dropped where the task is lost.

    Args:
      task: its ``[demonstrations]`` gives the number, length (default 200) and discount.
      model: the product of the world and the task.
      key: a PRNG key, consumed.
      best: of :func:`~jaxltl.core.values.undiscounted.satisfaction.optimal_satisfaction`.

    Returns:
      :class:`~jaxltl.core.models.trajectories.Trajectories` of the world, and how many were
      dropped.

    Raises:
      ValueError: a discount for a task that is not co-safe, more runs than memory holds, or no run
        did it.
    """
    # Deferred: a task with a file of demonstrations has no need of it.
    from jaxltl.core.models.trajectories import rollout

    spec = task.demonstrations
    asked, length = spec["synthetic"], spec.get("length", 200)
    if (size := asked * (length + 1) * _STEP_BYTES) > _MOST_BYTES:
        raise ValueError(
            f"{task.path}: [demonstrations] synthetic = {asked} runs of up to {length} steps would "
            f"take about {size / 1e9:.3g} GB; ask for fewer or shorter ones, at most "
            f"{_MOST_BYTES / 1e9:g} GB."
        )
    ends = model.automaton.acceptance == "cosafe"
    stop = model.final if ends else jax.numpy.asarray(np.asarray(best.upper) <= 0)
    # One step more than asked tells a run that has just arrived from one that has not.
    runs = rollout(
        model,
        _demonstrator(task, model, best),
        key,
        num_trajectories=asked,
        num_steps=length + 1,
        stop=stop,
    )
    runs = project_trajectories(model, runs)
    states, actions, lengths = (np.asarray(x) for x in (runs.state, runs.action, runs.length))
    kept = [
        list(zip(x[: min(n, length)].tolist(), u[: min(n, length)].tolist(), strict=True))
        for x, u, n in zip(states, actions, lengths, strict=True)
        if (0 < n <= length if ends else n > length)
    ]
    if not kept:
        raise ValueError(
            f"{task.path}: [demonstrations] none of {asked} synthetic runs did the task within "
            f"{length} steps; raise length or discount, or check that the task can be done."
        )
    return make_trajectories(model.mdp, kept), asked - len(kept)


def _demonstrator(task: Task, model: Product, best: Solution) -> jax.Array:
    discount = task.demonstrations.get("discount")
    if discount is None:
        return best.policy
    require_end(task, model.automaton)
    from jaxltl.core.models.ops.operators import expectation
    from jaxltl.core.values.discounted.discounted import optimal_value

    arriving = expectation(model, model.final.astype(model.dtype))
    reward = jax.numpy.where(model.final[..., None], 0, arriving)
    return optimal_value(model, reward, discount).policy


def require_end(task: Task, automaton: Automaton) -> None:
    """Refuses a demonstrator's discount for a task without end."""
    if "discount" in task.demonstrations and automaton.acceptance != "cosafe":
        raise ValueError(
            f"{task.path}: [demonstrations] discount is that of the reward of doing a task that "
            "ends, which takes a co-safe formula; leave it out for runs of the quickest policy."
        )
