"""Gymnasium's environments with tables (toy text: FrozenLake, CliffWalking, Taxi) as models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Sized
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jaxltl.core.models.sparse import Rewards, SparseMDP, make_sparse
from jaxltl.core.types import require_shape
from jaxltl.envs.gymnasium_runner import TERMINATED


def from_gymnasium(
    env: object,
    *,
    labels: Mapping[str, Sequence[int]] | None = None,
    initial: ArrayLike | None = None,
) -> SparseMDP:
    """The MDP of the transition table of a Gymnasium environment.

    `env.unwrapped.P[s][a]` lists branches ``(probability, next state, reward, terminated)``. A branch
    that terminates leads to an absorbing copy of its state without reward, from S on, with the
    additional label ``"terminated"``. Limits on the number of steps are not in the table.

    Args:
      env: an environment, or its id, for which the package gymnasium is needed.
      labels: propositions, each with the states where it holds.
      initial: ``float[S]``; default: the environment's `initial_state_distrib`, or uniform.

    Returns:
      A :class:`~jaxltl.core.models.sparse.SparseMDP` with the reward ``"reward"`` and the variable
      ``"state"``.

    Raises:
      ValueError: the environment has no table, or the table is malformed: naming state and action.

    >>> class Corridor:  # to the right, to the goal
    ...     P = {0: {0: [(0.5, 0, 0.0, False), (0.5, 1, 1.0, True)]},
    ...          1: {0: [(1.0, 1, 0.0, True)]}}
    >>> model = from_gymnasium(Corridor(), labels={"goal": [1]}, initial=[1, 0])
    >>> model.num_states, model.propositions, model.label[2].tolist()
    (3, ('goal', 'terminated'), [True, True])
    """
    env = _made(env)
    table = _read(env)
    count = table.num_states
    initial = getattr(env, "initial_state_distrib", None) if initial is None else initial
    start = np.full(count, 1 / count) if initial is None else np.asarray(initial, np.float64)
    require_shape("initial", start, (count,))
    ended = np.unique(table.successor[table.terminated])
    sink = count + np.arange(ended.size)
    successor = np.where(
        table.terminated, count + np.searchsorted(ended, table.successor), table.successor
    )
    choices = np.append(np.bincount(table.state, minlength=count), np.ones(ended.size, int))
    entries = np.append(np.bincount(table.row), np.ones(ended.size, int))
    return make_sparse(
        np.append(0, choices.cumsum()),
        np.append(0, entries.cumsum()),
        np.append(successor, sink),
        np.append(table.probability, np.ones(ended.size)),
        initial=np.append(start, np.zeros(ended.size)),
        label=_labels(labels or {}, ended, count),
        rewards={"reward": Rewards(transition=np.append(table.reward, np.zeros(ended.size)))},
        action=np.append(table.action, np.zeros(ended.size, int)),
        valuation={"state": np.append(np.arange(count), ended)},
    )


def _made(env: object) -> Any:
    if isinstance(env, str):
        try:
            import gymnasium
        except ImportError:
            raise ValueError(
                f"{env!r} is made by the package gymnasium, which is not installed; install "
                '"jaxltl[gymnasium]".'
            ) from None
        try:
            env = gymnasium.make(env)
        except gymnasium.error.Error as error:
            raise ValueError(f"gymnasium does not make {env!r}: {error}") from None
    return getattr(env, "unwrapped", env)


class _ChoiceTable(NamedTuple):
    """The choices of all states, and their branches."""

    num_states: int
    state: np.ndarray  # of each choice
    action: np.ndarray
    row: np.ndarray  # of each branch, its choice
    probability: np.ndarray
    successor: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray


def _read(env: object) -> _ChoiceTable:
    table, name = getattr(env, "P", None), type(env).__name__
    if not isinstance(table, Mapping) or not table or set(table) != set(range(len(table))):
        description = (
            "none" if table is None else f"a {type(table).__name__} that is not such a table"
        )
        raise ValueError(
            f"{name}: expected a table P[state][action] for states 0, 1, ...; it has {description}. "
            "Only environments of toy text have one."
        )
    choices: list[tuple[int, int]] = []
    branches: list[tuple[int, float, int, float, bool]] = []
    for s in range(len(table)):
        of = table[s]
        if not isinstance(of, Mapping) or not of or not all(_is_whole(a) for a in of):
            raise ValueError(
                f"{name}: P[{s}] is {of!r:.60}; expected a table of actions by number."
            )
        for a in sorted(of):
            if not isinstance(of[a], Sequence) or not of[a]:
                raise ValueError(
                    f"{name}: P[{s}][{a}] is {of[a]!r:.60}; expected a list of branches."
                )
            branches += [(len(choices), *_branch(f"{name}: P[{s}][{a}]", x, table)) for x in of[a]]
            choices.append((s, int(a)))
    row, probability, successor, reward, terminated = zip(*branches, strict=True)
    state, action = zip(*choices, strict=True)
    return _ChoiceTable(
        len(table), np.array(state), np.array(action), np.array(row), np.array(probability),
        np.array(successor), np.array(reward), np.array(terminated),
    )  # fmt: skip


def _is_whole(value: object) -> bool:
    return isinstance(value, int | np.integer) and bool(value >= 0)


def _branch(
    place: str, branch: tuple[float, int, float, bool], table: Sized
) -> tuple[float, int, float, bool]:
    try:
        probability, successor, reward, terminated = branch
        values = float(probability), int(successor), float(reward), bool(terminated)
    except (TypeError, ValueError):
        raise ValueError(
            f"{place} has the branch {branch!r:.80}; expected (probability, next state, reward, "
            "terminated)."
        ) from None
    if not 0 <= values[1] < len(table):
        raise ValueError(f"{place} leads to state {values[1]}; states are 0 to {len(table) - 1}.")
    return values


def _labels(
    states_of: Mapping[str, Sequence[int]], ended: np.ndarray, count: int
) -> dict[str, list[int]]:
    """Labels by proposition; an added state has the labels of its original."""
    labels: dict[str, list[int]] = {}
    for name, states in states_of.items():
        wrong = [s for s in states if not 0 <= s < count]
        if wrong or name == TERMINATED:
            raise ValueError(
                f"labels: {name!r} holds in state {wrong[0]}; states are 0 to {count - 1}."
                if wrong
                else f"labels: {TERMINATED!r} is where an episode has ended; choose another name."
            )
        labels[name] = [*states, *(count + np.flatnonzero(np.isin(ended, states))).tolist()]
    return {**labels, TERMINATED: list(range(count, count + ended.size))}
