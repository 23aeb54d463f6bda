"""Finite-memory policies: tables of actions with an automaton state as memory, without JAX."""

from __future__ import annotations

import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, runtime_checkable, cast

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Array, PyTree
from jaxltl.core.automata.automaton import Automaton, letter_index
from jaxltl.core.pretty_print import brief

Key = Array | np.random.Generator | None
Label = Collection[str] | Array  # the propositions that hold, or the number of a letter
ARROWS = {"up": "↑", "down": "↓", "left": "←", "right": "→", "stay": "•"}  # names of moves
_CERTAIN = 0.995  # least probability that is written as one action


@brief
class Progress(NamedTuple):
    """A policy's position in an episode.

    Attributes:
      state, memory, step: state or observation of the world, automaton state, and time.

    >>> Progress(state=3, memory=0, step=0).memory
    0
    """

    state: PyTree
    memory: Array
    step: Array


@brief
@dataclass(frozen=True, eq=False)
class FiniteMemoryPolicy:
    """A policy of a model with the state of an automaton as its memory.

    Its methods are pure functions of NumPy arrays, or of JAX arrays inside ``jit`` and ``vmap``.

    Attributes:
      action: ``float[S, Q, A]`` distributions, or ``int[S, Q]`` actions; with an axis ``[T, ...]``
        in front for a policy of T steps.
      initial_memory: ``int32[S]``, the memory state in the initial state s.
      next_memory: ``int32[S, Q]``, the memory state after reading the label of s.
      label_on: the label that a step reads, that of the state that is entered (``"entry"``) or left
        (``"exit"``); static.
      automaton: of the memory, which labels from sensors need and verdicts; or None.
      letter: ``int32[S]``, the automaton's letter of each state; or None.
      actions, states: names, or empty.

    >>> import jaxltl as jl
    >>> path = jl.make_mdp([[[1], [0]], [[1], [0]]], [[[1.0], [1.0]]] * 2, label={"a": [1]})
    >>> policy = jl.project_policy(jl.product(path, "F a"), np.array([[0, 1], [0, 1]]))
    >>> at = policy.start(0)
    >>> policy.act(None, at).item(), policy.act(None, policy.update(at, 1)).item()
    (0, 1)
    """

    action: Array
    initial_memory: Array
    next_memory: Array
    label_on: str = "entry"
    automaton: Automaton | None = None
    letter: Array | None = None
    actions: tuple[str, ...] = ()
    states: tuple[str, ...] = ()

    @property
    def num_states(self) -> int:
        """S."""
        return int(self.next_memory.shape[-2])

    @property
    def num_actions(self) -> int:
        """A; of a deterministic policy the names, or one more than its largest action."""
        if self.is_random:
            return int(self.action.shape[-1])
        return len(self.actions) or int(np.asarray(self.action).max(initial=-1)) + 1

    @property
    def is_random(self) -> bool:
        """True for distributions of actions."""
        return np.dtype(self.action.dtype).kind not in "iu"

    @property
    def has_horizon(self) -> bool:
        """True if the first axis of `action` is a time step."""
        return bool(self.action.ndim - self.is_random > self.next_memory.ndim)

    def replace(self, **updates: PyTree) -> FiniteMemoryPolicy:
        """A copy with the given fields replaced."""
        return replace(self, **updates)

    def start(self, state: Array | int | str, label: Label | None = None) -> Progress:
        """The position in an initial state; a `label` that is given replaces that of the model."""
        state = self._state(state)
        if label is None:
            return Progress(state, _at(self.initial_memory, state), np.zeros((), np.int32))
        automaton = self._automaton()
        memory = (
            np.asarray(automaton.initial)
            if self.label_on == "exit"
            else self._read(automaton.initial, label)
        )
        return Progress(state, memory, np.zeros((), np.int32))

    def act(self, key: Key, at: Progress) -> Array:
        """An action, drawn by a JAX key or a NumPy generator; None if deterministic."""
        table = self.action
        if self.has_horizon:
            row = _at(table, at.step.clip(0, len(table) - 1), at.state, at.memory)
        else:
            row = _at(table, at.state, at.memory)
        if not self.is_random:
            return row
        if key is None:
            raise ValueError(
                "act: key is None, and the policy is stochastic; give a JAX key or a "
                "numpy.random.Generator."
            )
        if not isinstance(key, np.random.Generator):
            jax = sys.modules["jax"]  # the key is its own
            weight = jax.numpy.log(row)
            return cast(Array, jax.random.categorical(key, weight, axis=-1).astype(np.int32))
        total = np.asarray(row, np.float64).cumsum(-1)
        point = key.random(total.shape[:-1])[..., None] * total[..., -1:]
        # Rounding may give the total itself, which is the last action of positive weight.
        last = (total < total[..., -1:]).sum(-1)
        return cast(Array, np.minimum((total <= point).sum(-1), last).astype(np.int32))

    def update(
        self, at: Progress, state: Array | int | str, label: Label | None = None
    ) -> Progress:
        """The position after a step into `state`; a `label` that is given is read instead."""
        state = self._state(state)
        if label is None:
            read = state if self.label_on == "entry" else at.state
            memory = _at(self.next_memory, read, at.memory)
        else:
            memory = self._read(at.memory, label)
        return Progress(state, memory, at.step + 1)

    def on_host(self) -> FiniteMemoryPolicy:
        """The policy with NumPy arrays."""
        names = ("action", "initial_memory", "next_memory")
        tables: dict[str, PyTree] = {name: np.asarray(getattr(self, name)) for name in names}
        return replace(self, **tables)

    def controller(self, seed: int = 0) -> Controller:
        """A :class:`Controller` of this policy."""
        return Controller(self, seed)

    def _state(self, state: Array | int | str) -> Array:
        if isinstance(state, str):
            if state not in self.states:
                raise ValueError(
                    f"state {state!r} is unknown; the policy has "
                    f"{', '.join(self.states[:6]) or 'no names of states'}"
                    f"{', ...' if len(self.states) > 6 else ''}."
                )
            state = self.states.index(state)
        if isinstance(state, int | np.integer):
            if not 0 <= state < self.num_states:
                raise ValueError(f"state {state} does not exist; give 0 to {self.num_states - 1}.")
            return np.asarray(state)
        return state

    def _automaton(self) -> Automaton:
        if self.automaton is None:
            raise ValueError(
                "label is given, and the policy has no automaton that reads it; make the policy by "
                "project_policy(product, policy), or leave out the label."
            )
        return self.automaton

    def _read(self, memory: Array | int, label: Label) -> Array:
        automaton = self._automaton()
        if isinstance(label, Collection) and not isinstance(label, np.ndarray):
            label = np.asarray(letter_index(automaton, label))
        return _at(automaton.delta, memory, label)


def action_text(action: Sequence[float] | Array, actions: Sequence[str]) -> str:
    """An action, as an arrow if it is a direction; or several with their probabilities.

    >>> action_text([0.0, 1.0], ["up", "right"]), action_text([0.25, 0.75], ["up", "wait"])
    ('→', 'wait .75, ↑ .25')
    """
    weight = np.asarray(action, float)
    names = [ARROWS.get(str(x), str(x)) for x in actions] or list(map(str, range(weight.size)))
    best = int(weight.argmax())
    if weight[best] >= _CERTAIN:
        return names[best]
    order = np.argsort(-weight, kind="stable").tolist()
    parts = [
        f"{names[a]} {weight[a]:.2f}".replace(" 0.", " .") for a in order if weight[a] >= 0.005
    ]
    return ", ".join(parts)


def _at(table: Array, *index: Array | int) -> Array:
    """``table[index]``, also for a NumPy table at JAX indices."""
    jax = sys.modules.get("jax")
    if jax is not None and any(isinstance(i, jax.Array) for i in index):
        table = jax.numpy.asarray(table)
    return cast(Array, table[index])


@runtime_checkable
class Policy(Protocol):
    """Pure functions of a policy with memory, of finite memory or an exported network.

    >>> hasattr(FiniteMemoryPolicy, "start") and hasattr(FiniteMemoryPolicy, "update")
    True
    """

    def start(self, state: PyTree, label: Collection[str] | None = None) -> PyTree:
        """The memory in an initial state or observation."""

    def act(self, key: Key, at: PyTree) -> PyTree:
        """An action."""

    def update(self, at: PyTree, state: PyTree, label: Collection[str] | None = None) -> PyTree:
        """The memory after a step."""


class Controller:
    """A policy that runs step by step, without JAX: on a robot, or in a simulator.

    Args:
      policy: the policy.
      seed: of the actions that it draws.

    >>> moves = FiniteMemoryPolicy(np.array([[0, 1]]), np.zeros(1, int), np.array([[1, 0]]))
    >>> robot = Controller(moves)
    >>> robot.start(0), robot.act(), robot.update(0), robot.act()
    (None, 0, None, 1)
    """

    def __init__(self, policy: Policy, seed: int = 0) -> None:
        self.policy = policy.on_host() if isinstance(policy, FiniteMemoryPolicy) else policy
        # Distinct from the stream of an environment that has the same seed.
        self._generator = np.random.default_rng((validation.integer("seed", seed), 1))
        self.at: PyTree = None

    def start(self, state: PyTree, label: Collection[str] | None = None) -> None:
        """Begins an episode in a state, or with an observation."""
        self.at = self.policy.start(state, label)

    def act(self, key: Key = None, *, allowed: PyTree = None) -> PyTree:
        """The next action; the controller's own generator is the default key.

        `allowed` is the mask of available actions, for a network that reads one; a table is refused.
        """
        self._require_start()
        if allowed is not None and isinstance(self.policy, FiniteMemoryPolicy):
            raise ValueError(
                "allowed is given, and the policy is a table; leave it out, and make the policy from the "
                "masked model or by shield_policy."
            )
        masks = () if allowed is None else (allowed,)
        action = self.policy.act(self._generator if key is None else key, self.at, *masks)
        return int(action) if np.ndim(action) == 0 else np.asarray(action)

    def update(self, state: PyTree, label: Collection[str] | None = None) -> None:
        """Reads the state, or the observation, that a step led to."""
        self._require_start()
        self.at = self.policy.update(self.at, state, label)

    def _require_start(self) -> None:
        if self.at is None:
            raise ValueError("the episode has not begun; call start(state) first.")
