"""Products of environments of the package gymnasium and tasks, as gymnasium environments."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Sequence

import numpy as np
from numpy.typing import ArrayLike

from jaxltl.core.array_types import PyTree
from jaxltl.core.automata.automaton import named_propositions
from jaxltl.core.automata.translate import FormulaLike
from jaxltl.core.automata.runs import Verdict
from jaxltl.core.environments.monitor import automaton_of_any_labels
from jaxltl.core.environments.task_environment import TaskTables, make_task_tables

Labels = Callable[[PyTree, PyTree], Collection[str]]


def gymnasium_task(
    env: PyTree,
    formula: FormulaLike,
    labels: Labels,
    *,
    propositions: Sequence[str] | None = None,
    ending: str = "repeat",
    reward: str = "auto",
    discount: float | None = None,
    ratio: float | None = None,
    shaping: str | ArrayLike | None = None,
    learner_discount: float = 1.0,
) -> PyTree:
    """The product of a gymnasium environment and a temporal-logic task, for other learners.

    A ``gymnasium.Wrapper`` with the rewards and ends of :func:`~jaxltl.task_environment`. Observations
    have the automaton state q of Q: of ``Discrete(n)`` the number ``s * Q + q``; of a ``Box`` the
    flattened vector and q one-hot; of a ``Dict`` the key ``"memory"``; others become
    ``"observation"`` in such a ``Dict``. `info` has ``verdict``, ``memory``, and of a step
    ``discount`` (the task's) and ``reward`` (the environment's). Learners with a constant discount
    fit co-safe and safety tasks, with discount 1.

    Args:
      env: the environment.
      formula: a formula, its text, or an automaton.
      labels: ``(observation, info) -> propositions that hold``, a collection of names.
      propositions: the names that `labels` may return; default: those of the formula.
      ending: the verdict of terminal states, see :func:`~jaxltl.task_environment`.
      reward, discount, ratio, shaping, learner_discount: see
        :func:`~jaxltl.core.environments.task_reward.make_task_reward`.

    Returns:
      The product, a ``gymnasium.Env``.

    Raises:
      ValueError: an unknown proposition, or gymnasium is not installed.

    >>> import gymnasium
    >>> lake = gymnasium.make("FrozenLake-v1", is_slippery=False)
    >>> task = gymnasium_task(lake, "F (corner & F goal)",
    ...     lambda seen, info: {3: {"corner"}, 15: {"goal"}}.get(seen, set()))
    >>> int(task.observation_space.n), task.reset(seed=0)[0]
    (48, 0)
    """
    automaton = automaton_of_any_labels(formula)
    names = named_propositions(automaton) if propositions is None else tuple(propositions)
    tables = make_task_tables(
        automaton,
        names,
        ending=ending,
        reward=reward,
        discount=discount,
        ratio=ratio,
        shaping=shaping,
        learner_discount=learner_discount,
    )
    return _wrapper()(env, tables, labels, names)


@functools.cache  # one class, made when gymnasium is first needed
def _wrapper() -> type:
    try:
        import gymnasium
    except ImportError as problem:
        raise ValueError(
            'gymnasium_task needs the package gymnasium; pip install "jaxltl[gymnasium]".'
        ) from problem
    kinds = (_GymnasiumSteps, gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs)
    return type("TaskWrapper", kinds, {})


def __getattr__(name: str) -> type:
    if name == "TaskWrapper":  # by which gymnasium.make finds the class again
        return _wrapper()
    raise AttributeError(f"module {__name__} has no attribute {name!r}")


class _GymnasiumSteps:
    env: PyTree
    observation_space: PyTree

    def __init__(
        self, env: PyTree, tables: TaskTables, labels: Labels, names: tuple[str, ...]
    ) -> None:
        import gymnasium

        this: PyTree = self  # becomes a gymnasium.Wrapper when gymnasium is imported
        gymnasium.utils.RecordConstructorArgs.__init__(
            this, _disable_deepcopy=True, tables=tables, labels=labels, names=names
        )
        gymnasium.Wrapper.__init__(this, env)
        spaces = self._spaces = gymnasium.spaces
        self._tables, self._labels, self._names = tables, labels, names
        self._memory, size = 0, len(tables.delta)
        one_hot, inner = spaces.Box(0, 1, (size,), np.float32), env.observation_space
        if isinstance(inner, spaces.Discrete):
            self.observation_space = spaces.Discrete(int(inner.n) * size)
        elif isinstance(inner, spaces.Box):
            low, high = (
                np.append(x.ravel().astype(np.float32), y)
                for x, y in ((inner.low, one_hot.low), (inner.high, one_hot.high))
            )
            self.observation_space = spaces.Box(low, high, dtype=np.float32)
        else:
            parts = inner.spaces if isinstance(inner, spaces.Dict) else {"observation": inner}
            if "memory" in parts:
                raise ValueError('env observes a "memory"; rename it by TransformObservation.')
            self.observation_space = spaces.Dict({**parts, "memory": one_hot})

    def reset(self, *, seed: int | None = None, options: PyTree = None) -> PyTree:
        seen, info = self.env.reset(seed=seed, options=options)
        self._memory = int(self._tables.delta[self._tables.initial, self._letter(seen, info)])
        return self._observe(seen), self._details(info, self._tables.verdict[self._memory])

    def step(self, action: PyTree) -> PyTree:
        seen, earned, ended, cut, info = self.env.step(action)
        tables, before, letter = self._tables, self._memory, self._letter(seen, info)
        after = int(tables.delta[before, letter])
        verdict = tables.repeated[after, letter] if ended else tables.verdict[after]
        decided, discount = verdict != Verdict.UNDECIDED, float(tables.discount[before, letter])
        ended = bool(ended or decided)
        reward = tables.decided[verdict] if decided else tables.reward[before, letter]
        ahead = 0 if ended else tables.learner_discount * discount * tables.potential[after]
        self._memory = after
        details = {**self._details(info, verdict), "discount": discount, "reward": float(earned)}
        total = float(reward + ahead - tables.potential[before])
        return self._observe(seen), total, ended, bool(cut), details

    def _letter(self, seen: PyTree, info: PyTree) -> int:
        label = self._labels(seen, info)
        if isinstance(label, str) or (unknown := sorted({*label} - {*self._names})):
            wrong = repr(label) if isinstance(label, str) else f"{unknown[0]!r}"
            raise ValueError(
                f"labels returned {wrong}; expected a collection of names among "
                f"{', '.join(self._names)}."
            )
        code = sum(
            int(w)
            for w, name in zip(self._tables.weight, self._names, strict=True)
            if name in label
        )
        return int(self._tables.letter[code])

    def _details(self, info: PyTree, verdict: int) -> PyTree:
        return {**info, "verdict": int(verdict), "memory": self._memory}

    def _observe(self, seen: PyTree) -> PyTree:
        spaces, size, inner = self._spaces, len(self._tables.delta), self.env.observation_space
        if isinstance(inner, spaces.Discrete):
            return (int(seen) - int(inner.start)) * size + self._memory
        row = np.eye(size, dtype=np.float32)[self._memory]
        if isinstance(inner, spaces.Box):
            return np.append(np.asarray(seen, np.float32).ravel(), row)
        parts = seen if isinstance(inner, spaces.Dict) else {"observation": seen}
        return {**parts, "memory": row}
