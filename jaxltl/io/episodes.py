"""Episodes of the packages imitation and Minari, as demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import SupportsIndex

import numpy as np

from jaxltl.core import validation
from jaxltl.core.models import MDP, DenseMDP, Trajectories, make_trajectories

TERMINATED = "terminated"
_NAMES = (("obs", "acts"), ("observations", "actions"))


def from_episodes(
    model: MDP | DenseMDP,
    episodes: Iterable[object],
    *,
    state: Callable[..., SupportsIndex] | None = None,
    action: Callable[..., SupportsIndex] | None = None,
) -> Trajectories:
    """Demonstrations from episodes of imitation or Minari.

    Args:
      model: the model in which they are demonstrations.
      episodes: objects with ``obs`` and ``acts`` (``imitation.data.types.Trajectory``) or with
        ``observations`` and ``actions`` (a Minari dataset), of one observation more than actions.
      state, action: number of the state of an observation, and of the action of the model; default
        the observations and actions themselves, which must be integers then.

    Returns:
      :class:`~jaxltl.core.models.trajectories.Trajectories`; last successors are checked, not kept.
      That of a terminated episode may be an absorbing copy, as in
      :func:`~jaxltl.envs.from_gymnasium`.

    Raises:
      ValueError: naming the episode: other lengths, observations that are no integers, or a step
        that is impossible in the model.

    Example:
      >>> from types import SimpleNamespace
      >>> from jaxltl import from_dense
      >>> world = from_dense([[[0, 1.0]], [[0, 1.0]]])
      >>> episode = SimpleNamespace(obs=np.array([0, 1, 1]), acts=np.array([0, 0]))
      >>> from_episodes(world, [episode]).state.tolist()
      [[0, 1]]
    """
    pairs, ends = [], []
    for number, episode in enumerate(episodes):
        states, actions = _read(episode, number, state, action)
        pairs.append(list(zip(states, actions, strict=False)))
        if not 0 <= states[-1] < model.num_states:
            raise ValueError(
                f"episode {number} ends in state {states[-1]}; states are 0 to "
                f"{model.num_states - 1}."
            )
        ended = getattr(episode, "terminal", getattr(episode, "terminations", False))
        ends.append((states[-1], bool(np.any(ended))))
    trajectories = make_trajectories(model, pairs)
    whole = []
    for steps, (final, ended) in zip(pairs, ends, strict=True):
        final = _copy(model, *steps[-1], final) if ended else final
        whole.append([*steps, (final, int(np.argmax(np.asarray(model.available)[final])))])
    make_trajectories(model, whole)  # checks the last successors too
    return trajectories


def _read(
    episode: object,
    number: int,
    state: Callable[..., SupportsIndex] | None,
    action: Callable[..., SupportsIndex] | None,
) -> tuple[list[int], list[int]]:
    """The states and actions of an episode."""
    names = next((x for x in _NAMES if all(hasattr(episode, name) for name in x)), None)
    if names is None:
        raise ValueError(
            f"episode {number} is {validation.shorten(episode)}; give objects with obs and acts, or "
            "with observations and actions."
        )
    observed, acted = _steps(getattr(episode, names[0])), list(getattr(episode, names[1]))
    if not acted or len(observed) != len(acted) + 1:
        raise ValueError(
            f"episode {number} has {len(observed)} observations and {len(acted)} actions; expected "
            "at least one action, and one observation more than actions."
        )
    place = f"episode {number}, "
    return (
        [_index(x, state, f"{place}observation {t}", "state") for t, x in enumerate(observed)],
        [_index(x, action, f"{place}action {t}", "action") for t, x in enumerate(acted)],
    )


def _copy(model: MDP | DenseMDP, state: int, action: int, final: int) -> int:
    """The successor with the labels of the final state and "terminated"; else the final state."""
    if TERMINATED not in model.propositions or not isinstance(model, MDP):
        return final
    label = np.asarray(model.label)
    expected = label[final] | (np.array(model.propositions) == TERMINATED)
    likely = np.asarray(model.probability)[state, action] > 0
    for successor in np.asarray(model.successor)[state, action][likely].tolist():
        if (label[successor] == expected).all():
            return int(successor)
    return final


def _steps(seen: Mapping[str, Sequence[object]] | Sequence[object]) -> list[object]:
    """One observation for each step, also from a dictionary or a tuple of arrays."""
    seen = seen.unwrap() if hasattr(seen, "unwrap") else seen  # imitation's DictObs
    if not isinstance(seen, Mapping | tuple):
        return list(seen)
    columns = seen.values() if isinstance(seen, Mapping) else seen
    rows = zip(*map(_steps, columns), strict=True)
    return [dict(zip(seen, row, strict=True)) if isinstance(seen, Mapping) else row for row in rows]


def _index(
    value: object, number_of: Callable[..., SupportsIndex] | None, place: str, name: str
) -> int:
    index = np.asarray(value if number_of is None else number_of(value))
    if index.size != 1 or index.dtype.kind not in "iu":
        raise ValueError(
            f"{place} is {validation.shorten(value)}; give {name}=, a function that returns the "
            f"number of the {name}."
        )
    return int(index.item())
