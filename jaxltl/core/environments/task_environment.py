"""Environments with a temporal-logic task: the product of an environment and an automaton.

:func:`task_environment` steps an environment and the automaton of a formula together. The result is
an :class:`~jaxltl.core.environments.environment.Environment`: its observations include the automaton
state, its episodes end as soon as the verdict is decided (see ``monitor``), and its rewards are
those of the task. The automaton first reads the label of the initial state, then that of each
successor state.

The tables of a task are arrays: new tables do not recompile, and tasks of different formulas,
padded to one shape by :func:`stack_tasks`, run in one vmapped program.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.core import struct, validation
from jaxltl.core.automata import Automaton
from jaxltl.core.automata.runs import Verdict, lasso_verdicts, verdicts
from jaxltl.core.environments.environment import (
    ENDINGS,
    Environment,
    Timestep,
    make_box,
    make_environment,
    of_world,
    optional,
    require_environment,
)
from jaxltl.core.environments.monitor import automaton_of_any_labels, make_finite_task
from jaxltl.core.environments.task_reward import make_task_reward
from jaxltl.core.logic.labels import require_known
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.models.protocols import Array, Key, PyTree
from jaxltl.core.pretty_print import brief

_Tree = TypeVar("_Tree")


@brief
class TaskWorld(NamedTuple):
    """A state of the product of an environment and a task.

    Attributes:
      world: the environment's state.
      memory: ``int32[]``, the automaton state after reading the label of `world`.
      verdict: ``int32[]``, the :class:`~jaxltl.core.environments.monitor.Verdict`; in a terminal
        state, as the option `ending` defines it.
      accepted: ``bool[]``, True if the last transition of the automaton was accepting: of even
        priority, or for a co-safe or safety task into a final state.
      visits: ``int32[]``, the number of accepting transitions so far, the first label included.

    >>> TaskWorld(world=7, memory=1, verdict=0, accepted=False, visits=0).memory
    1
    """

    world: PyTree
    memory: jax.Array
    verdict: jax.Array
    accepted: jax.Array
    visits: jax.Array


@brief
class TaskObservation(NamedTuple):
    """An observation of a :class:`TaskWorld`.

    Attributes:
      world: the observation of the environment.
      memory: ``float[Q]``, the automaton state one-hot, or its row of an embedding.

    >>> TaskObservation(world=[0.5], memory=[0.0, 1.0]).memory  # in state 1 of 2
    [0.0, 1.0]
    """

    world: PyTree
    memory: jax.Array


@brief
@dataclass(frozen=True)
class TaskTables:
    """A task over the labels of an environment, as arrays; see :func:`make_task_tables`.

    Attributes:
      weight, letter: ``int32[P]``, contributions of propositions to the code of a label, and
        ``int32[C]``, the automaton's letter of each code.
      delta, initial: ``int32[Q, L]``, the successors, and the state before the first label.
      verdict: ``int32[Q]``, in each state.
      repeated: ``int32[Q, L]``, the verdict of a terminal state by its automaton state and letter.
      accepting: ``bool[Q, L]``, the accepting transitions.
      reward, discount: ``float[Q, L]``, of the transitions.
      decided: ``float[3]``, the reward at each verdict, which replaces that of the transition.
      potential, learner_discount: ``float[Q]`` and ``float[]``, for reward shaping; zero for none.
      embedding: ``float[Q, ...]``, observations of the states, or None: one-hot.
      state_names: the residual formulas of the states, or empty; not part of the tree.

    >>> tables = make_task_tables("F goal", ["wall", "goal"])
    >>> tables.delta.tolist(), tables.verdict.tolist(), tables.decided.tolist()
    ([[0, 1], [1, 1]], [0, 1], [0.0, 1.0, 0.0])
    """

    weight: Array
    letter: Array
    delta: Array
    initial: Array
    verdict: Array
    repeated: Array
    accepting: Array
    reward: Array
    discount: Array
    decided: Array
    potential: Array
    learner_discount: Array
    embedding: Array
    state_names: tuple[str, ...] = ()


struct.register(
    TaskTables,
    arrays=[field.name for field in fields(TaskTables) if field.name != "state_names"],
    static=(),
    text={"state_names": ()},
)


def make_task_tables(
    formula: Formula | str | Automaton,
    propositions: Sequence[str],
    *,
    ending: str = "repeat",
    embedding: ArrayLike | None = None,
    reward: str = "auto",
    discount: float | None = None,
    ratio: float | None = None,
    shaping: str | ArrayLike | None = None,
    learner_discount: float = 1.0,
) -> TaskTables:
    """The tables of a task.

    Args:
      formula: a formula, its text, or an automaton.
      propositions: the P names of the labels.
      ending: the verdict of a terminal state of the environment while the task is undecided:
        ``"repeat"``: that of the last label repeated for ever, as in an absorbing state;
        ``"violated"``; ``"undecided"``; or ``"rejected"``: violated, even where the label of the
        terminal state satisfies the formula.
      embedding: ``float[Q, ...]``, observations of the automaton states; default: one-hot.
      reward, discount, ratio, shaping, learner_discount: see
        :func:`~jaxltl.core.environments.task_reward.make_task_reward`.

    Returns:
      :class:`TaskTables`.

    Raises:
      ValueError: an unknown proposition, an embedding of another shape, or a reward that does not
        fit the task.
    """
    validation.choice("ending", ending, ENDINGS)
    propositions = validation.distinct_names("propositions", propositions)
    automaton = automaton_of_any_labels(formula)
    if not isinstance(formula, Automaton):
        require_known(automaton.propositions, propositions, f"the formula {str(formula)!r}")
    with jax.ensure_compile_time_eval():  # tables are made on the host wherever it is called
        reading = make_finite_task(automaton, propositions)
    decisions = verdicts(automaton)
    pay = make_task_reward(
        automaton,
        decisions,
        reward=reward,
        discount=discount,
        ratio=ratio,
        shaping=shaping,
        learner_discount=learner_discount,
    )
    weight = np.zeros(len(propositions), np.int32)
    weight[list(reading.columns)] = 1 << np.arange(len(reading.columns))
    features = None if embedding is None else validation.float_array("embedding", embedding)
    if features is not None and (
        features.ndim < 2 or len(features) != len(decisions) or features.dtype.kind not in "biuf"
    ):
        raise ValueError(
            f"embedding has shape {list(features.shape)} and type {features.dtype}; give numbers "
            f"[{len(decisions)}, ...], a row for each state of the automaton."
        )
    number = jnp.result_type(float)
    return TaskTables(
        weight=weight,
        letter=np.asarray(reading.letter),
        delta=np.asarray(automaton.delta, np.int32),
        initial=np.int32(automaton.initial),
        verdict=decisions,
        repeated=_terminal_verdicts(automaton, decisions, ending),
        accepting=pay.accepting,
        reward=pay.reward.astype(number),
        discount=pay.discount.astype(number),
        decided=pay.decided.astype(number),
        potential=pay.potential.astype(number),
        learner_discount=np.asarray(learner_discount, number),
        embedding=None if features is None else features.astype(number),
        state_names=automaton.state_names,
    )


def _terminal_verdicts(automaton: Automaton, decisions: Array, ending: str) -> Array:
    """``int32[Q, L]``: the verdict of a terminal state, by its automaton state and letter."""
    if ending == "repeat":
        return lasso_verdicts(automaton)
    table = np.full(np.shape(automaton.delta), Verdict.VIOLATED, np.int32)
    if ending == "rejected":
        return table
    last = Verdict.VIOLATED if ending == "violated" else Verdict.UNDECIDED
    decided = decisions != Verdict.UNDECIDED
    table[:] = np.where(decided, decisions, last)[:, None]
    return table


def _require_open(formula: str, verdict: int) -> None:
    """Raises ValueError for a formula that is valid or unsatisfiable."""
    if verdict != Verdict.UNDECIDED:
        kind, some = ("valid", "every") if verdict == Verdict.SATISFIED else ("unsatisfiable", "no")
        raise ValueError(
            f"the formula {formula!r} is {kind}: {some} sequence of labels satisfies it, so that every "
            "episode ends at its first step; give another, or, to keep it, its automaton "
            "to_automaton(formula)."
        )


def task_environment(
    environment: Environment,
    formula: Formula | str | Automaton | TaskTables,
    *,
    labels: Callable[..., jax.Array] | None = None,
    propositions: Sequence[str] | None = None,
    ending: str | None = None,
    embedding: ArrayLike | None = None,
    reward: str = "auto",
    discount: float | None = None,
    ratio: float | None = None,
    shaping: str | ArrayLike | None = None,
    learner_discount: float = 1.0,
) -> Environment:
    """The product of an environment and a temporal-logic task, as an environment.

    Its states are :class:`TaskWorld`, its observations :class:`TaskObservation`. The rewards and
    discounts of the task (``Timestep.discount``; the learner's own discount is 1) replace the
    environment's rewards; see :func:`~jaxltl.core.environments.task_reward.make_task_reward`. Episodes
    terminate where the environment's do, and at the first step with a decided verdict. Truncation
    leaves the verdict undecided.

    Args:
      environment: the environment.
      formula: a formula, its text, an automaton over all subsets of its propositions, or the tables
        of :func:`make_task_tables`, which exclude the arguments from `ending` on.
      labels, propositions: ``world -> bool[P]`` and its names; default: the environment's.
      ending: the verdict of terminal states, see :func:`make_task_tables`; default: the environment's.
      embedding: ``float[Q, ...]``, observations of the automaton states; default: one-hot.
      reward, discount, ratio, shaping, learner_discount: see
        :func:`~jaxltl.core.environments.task_reward.make_task_reward`.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment`.

    Raises:
      ValueError: labels that are not ``bool[P]``, unknown propositions, a formula that is valid or
        unsatisfiable (an automaton may be), a reward that does not fit the
        task, a discount out of range, or a potential or an embedding of another shape.

    >>> from jaxltl import environments, gridworld
    >>> corridor = environments.model_environment(gridworld("home . goal", initial="home"))
    >>> task = task_environment(corridor, "F (goal & F home)")
    >>> world = task.reset(jax.random.key(0))
    >>> for action in (3, 3, 2, 2):  # right, left
    ...     print(residual_formula(task, world.memory))
    ...     found = task.step(world, action, jax.random.key(0))
    ...     world = found.world
    F (goal & F home)
    F (goal & F home)
    F home | F (goal & F home)
    F home | F (goal & F home)
    >>> float(found.reward), bool(found.terminated), Verdict(int(world.verdict)).name
    (1.0, True, 'SATISFIED')
    """
    environment = require_environment(environment)
    names = environment.propositions if propositions is None else propositions
    copied = ("reset", "step", "observe", "actions", "allowed", "observations", "horizon", "starts")
    others: dict[str, PyTree] = {name: getattr(environment, name) for name in copied}
    inner = make_environment(
        **others,
        outcomes=environment.outcomes,
        labels=environment.labels if labels is None else labels,
        propositions=names,
    )
    options: dict[str, Any] = {
        "ending": ending,
        "embedding": embedding,
        "reward": reward,
        "discount": discount,
        "ratio": ratio,
        "shaping": shaping,
        "learner_discount": learner_discount,
    }
    if not isinstance(formula, TaskTables):
        options["ending"] = environment.ending if ending is None else ending
        tables = make_task_tables(formula, inner.propositions, **options)
        if not isinstance(formula, Automaton):
            _require_open(str(formula), tables.verdict[tables.initial])
    else:
        defaults = task_environment.__kwdefaults__ or {}
        if changed := [name for name, x in options.items() if x is not defaults[name]]:
            raise ValueError(f"{', '.join(changed)}: give this to make_task_tables instead.")
        tables = formula
    names = inner.propositions
    if tables.weight.shape != (len(names),):
        raise ValueError(
            f"the tables are of {tables.weight.shape[-1]} propositions, and the world has "
            f"{len(names)}: {', '.join(names) or '(none)'}. Make them with the world's own."
        )
    return with_tables(inner, tables)


def with_task_tables(environment: Environment, tables: TaskTables) -> Environment:
    """The task environment with another task over the same propositions; runs under ``jit`` and ``vmap``."""
    task_tables(environment)
    validation.instance("tables", tables, TaskTables, "those of make_task_tables")
    return with_tables(without_task(environment)[0], tables)


def without_task(environment: Environment) -> tuple[Environment, TaskTables | None]:
    """The environment inside :func:`task_environment` and the tables; any other environment and None."""
    tasked = cast(PyTree, require_environment(environment))
    if getattr(tasked.observe, "func", None) is not _observe:
        return environment, None
    parts: dict[str, PyTree] = {
        name: None if (part := getattr(tasked, name)) is None else part.args[-1]
        for name in ("reset", "step", "observe", "labels", "allowed", "starts", "outcomes")
    }
    inner = replace(environment, **parts, observations=tasked.observations.world)
    return inner, task_tables(environment)


def task_tables(environment: Environment) -> TaskTables:
    """The tables of a task environment; ValueError for any other environment."""
    arguments = getattr(getattr(environment, "reset", None), "args", ())
    if not arguments or not isinstance(arguments[0], TaskTables):
        raise ValueError("this environment has no task; make it with task_environment.")
    return arguments[0]


def stack_tables(tables: Sequence[TaskTables]) -> TaskTables:
    """Tasks padded to one shape with a leading axis; states in padding are violated and unreachable."""
    tables = validation.sequence("tables", tables)
    if not tables:
        raise ValueError("there is no task; give at least one.")
    for one in tables:
        validation.instance("tables", one, TaskTables, "a list of those of make_task_tables")
    return _stacked(_padded(tables))


def stack_tasks(environments: Sequence[Environment]) -> Environment:
    """Task environments of one environment, padded to one shape, with a leading axis of N.

    One compiled program runs all: ``vmap(run_episode, in_axes=(0, 0, None))(keys, stacked, agent)``.

    Args:
      environments: N results of :func:`task_environment`, of environments of one structure.

    Returns:
      An environment with arrays of a leading axis N.

    Raises:
      ValueError: no environment, or environments of different structure.

    >>> from jaxltl import environments, from_dense
    >>> walk = environments.model_environment(from_dense(
    ...     [[[.5, .5]], [[.5, .5]]], label=[[0], [1]], propositions=["a"]))
    >>> both = stack_tasks([task_environment(walk, "F a"), task_environment(walk, "G F a")])
    >>> jax.vmap(lambda e, key: e.reset(key).memory, (0, None))(both, jax.random.key(0)).shape
    (2,)
    """
    environments = validation.sequence("environments", environments)
    if not environments:
        raise ValueError("there is no environment; give at least one.")
    padded = _padded([task_tables(e) for e in environments])
    tasked = [with_task_tables(e, t) for e, t in zip(environments, padded, strict=True)]
    shapes = [_structure(e) for e in tasked]
    for number, shape in enumerate(shapes):
        if shape != shapes[0]:
            raise ValueError(
                f"environments 0 and {number} are worlds of different structure: their functions, "
                "spaces, propositions, horizons and shapes of arrays must be the same."
            )
    return _stacked(tasked)


def residual_formula(task: Environment | TaskTables | Automaton, memory: PyTree) -> str:
    """The residual formula in a state of a task's automaton: the obligation on the remaining word.

    Automata from files, very large ones, stacks and results of ``jit`` have state numbers instead.

    Args:
      task: a task environment, its tables, or an automaton.
      memory: the automaton state, such as ``world.memory`` of a :class:`TaskWorld`.

    Returns:
      The formula as text.

    Raises:
      ValueError: an unknown state.

    >>> import jaxltl as jl
    >>> residual_formula(jl.to_automaton("F (a & X b)"), 0)
    'F (a & X b)'
    """
    if isinstance(task, Automaton):
        names, count = task.state_names, len(task.delta)
    else:
        tables = task if isinstance(task, TaskTables) else task_tables(task)
        names, count = tables.state_names, tables.delta.shape[-2]
    state = validation.integer("memory", memory)
    if not 0 <= state < count:
        raise ValueError(f"memory={state}; the automaton has the states 0..{count - 1}.")
    return names[state] if state < len(names) else f"state {state} of {count}"


# --- the functions of the joint world -------------------------------------------------------------


def with_tables(inner: Environment, tables: TaskTables) -> Environment:
    """The product of an environment and the tables of a task over its propositions."""
    if tables.embedding is None:
        memory = make_box(0, 1, tables.delta.shape[-2:-1])
    else:
        memory = make_box(-np.inf, np.inf, tables.embedding.shape[1:])
    spaces: PyTree = TaskObservation(inner.observations, memory)  # type: ignore[arg-type]
    return replace(
        inner,
        reset=Partial(_reset, tables, inner.labels, inner.reset),
        step=Partial(_step, tables, inner.labels, inner.step),
        observe=Partial(_observe, tables, inner.observe),
        labels=Partial(of_world, inner.labels),
        allowed=optional(of_world, inner.allowed),
        starts=optional(_starts, tables, inner.labels, inner.starts),
        outcomes=optional(_outcomes, tables, inner.labels, inner.outcomes),
        observations=spaces,
    )


def _read(tables: TaskTables, label: jax.Array) -> jax.Array:
    """The letter of a label."""
    return jnp.asarray(tables.letter)[jnp.sum(jnp.where(label, tables.weight, 0), dtype=jnp.int32)]


def _reset(
    tables: TaskTables, labels: Callable[..., PyTree], reset: Callable[..., PyTree], key: Key
) -> TaskWorld:
    return _begin(tables, labels, reset(key))


def _starts(
    tables: TaskTables, labels: Callable[..., PyTree], starts: Callable[..., PyTree]
) -> tuple[TaskWorld, jax.Array]:
    worlds, probability = starts()
    return jax.vmap(lambda world: _begin(tables, labels, world))(worlds), probability


def _begin(tables: TaskTables, labels: Callable[..., PyTree], world: PyTree) -> TaskWorld:
    """The initial product state, after the automaton has read the first label."""
    tables = jax.tree.map(jnp.asarray, tables)
    letter = _read(tables, labels(world))
    memory = tables.delta[tables.initial, letter]
    accepted = tables.accepting[tables.initial, letter]
    return TaskWorld(world, memory, tables.verdict[memory], accepted, accepted.astype(jnp.int32))


def _step(
    tables: TaskTables,
    labels: Callable[..., PyTree],
    step: Callable[..., Timestep],
    before: TaskWorld,
    action: PyTree,
    key: Key,
) -> Timestep:
    return _read_on(tables, labels, before, Timestep(*step(before.world, action, key)))


def _outcomes(
    tables: TaskTables,
    labels: Callable[..., PyTree],
    outcomes: Callable[..., PyTree],
    before: TaskWorld,
    action: PyTree,
) -> tuple[Timestep, jax.Array]:
    timesteps, probability = outcomes(before.world, action)
    timesteps = Timestep(*timesteps)
    rest = (jnp.broadcast_to(jnp.asarray(x), jnp.shape(probability)) for x in timesteps[1:])
    return jax.vmap(lambda step: _read_on(tables, labels, before, step))(
        Timestep(timesteps.world, *rest)
    ), probability


def _read_on(
    tables: TaskTables, labels: Callable[..., PyTree], before: TaskWorld, step: Timestep
) -> Timestep:
    """A step of the product, from a step of the environment."""
    tables = jax.tree.map(jnp.asarray, tables)
    reading = before.memory, _read(tables, labels(step.world))
    memory, accepted = tables.delta[reading], tables.accepting[reading]
    over = jnp.asarray(step.terminated, bool)
    verdict = jnp.where(over, tables.repeated[memory, reading[1]], tables.verdict[memory])
    decided = verdict != Verdict.UNDECIDED
    terminated = over | decided
    discount = step.discount * tables.discount[reading]
    # Ng, Harada & Russell 1999; the potential after the end is zero.
    after = jnp.where(terminated, 0, tables.learner_discount * discount * tables.potential[memory])
    reward = jnp.where(decided, tables.decided[verdict], tables.reward[reading])
    world = TaskWorld(step.world, memory, verdict, accepted, before.visits + accepted)
    return step._replace(
        world=world,
        reward=reward + after - tables.potential[before.memory],
        terminated=terminated,
        discount=discount,
    )


def _observe(
    tables: TaskTables, observe: Callable[..., PyTree], joint: TaskWorld
) -> TaskObservation:
    return TaskObservation(observe(joint.world), memory_seen(tables, joint.memory))


def memory_seen(tables: TaskTables, memory: jax.Array) -> jax.Array:
    """The observation ``float[Q]`` of an automaton state, one-hot or its embedding."""
    if tables.embedding is None:
        return jax.nn.one_hot(memory, tables.delta.shape[-2])
    return jnp.asarray(tables.embedding)[memory]


# --- tables ---------------------------------------------------------------------------------------


def _padded(tables: Sequence[TaskTables]) -> list[TaskTables]:
    """The tasks with the numbers of states, letters and codes of the largest."""
    num_memory = max(t.delta.shape[0] for t in tables)
    num_letters = max(t.delta.shape[1] for t in tables)
    num_codes = max(len(t.letter) for t in tables)
    for number, t in enumerate(tables):
        if t.weight.shape != tables[0].weight.shape:
            raise ValueError(
                f"tasks 0 and {number} are over {len(tables[0].weight)} and {len(t.weight)} "
                "propositions; make all of them over those of the one world."
            )
        shapes = [None if x.embedding is None else x.embedding.shape[1:] for x in (tables[0], t)]
        if shapes[0] != shapes[1]:
            raise ValueError(
                f"tasks 0 and {number} have embeddings of shapes {shapes[0]} and "
                f"{shapes[1]} a state; give them one width."
            )

    def grow(array: Array, rows: int, columns: int | None = None, fill: float = 0) -> np.ndarray:
        array = np.asarray(array)
        wide = [(0, rows - array.shape[0])]
        wide += [] if array.ndim == 1 else [(0, 0 if columns is None else columns - array.shape[1])]
        wide += [(0, 0)] * (array.ndim - 2)
        return np.pad(array, wide, constant_values=fill)

    sizes = num_memory, num_letters
    return [
        replace(
            t,
            letter=grow(t.letter, num_codes),
            delta=grow(t.delta, *sizes),
            verdict=grow(t.verdict, num_memory, fill=Verdict.VIOLATED),
            repeated=grow(t.repeated, *sizes, fill=Verdict.VIOLATED),
            accepting=grow(t.accepting, *sizes),
            reward=grow(t.reward, *sizes),
            discount=grow(t.discount, *sizes),
            potential=grow(t.potential, num_memory),
            embedding=None if t.embedding is None else grow(t.embedding, num_memory),
            state_names=(),
        )
        for t in tables
    ]


def _stacked(trees: Sequence[_Tree]) -> _Tree:
    return cast(_Tree, jax.tree.map(lambda *x: jnp.stack([jnp.asarray(row) for row in x]), *trees))


def _structure(tree: PyTree) -> PyTree:
    leaves, shape = jax.tree.flatten(tree)
    return [np.shape(leaf) for leaf in leaves], shape
