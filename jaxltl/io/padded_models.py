"""Models of files of any format with padded successor lists, as learners and games take them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jaxltl.core.validation import errors_in
from jaxltl.core.models.action_numbers import row_actions
from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models import POMDP, MDP, Game, IntervalMDP, MultiplayerGame, SparseMDP
from jaxltl.io.model_files import read_model
from jaxltl.io.npz import model_of, parse_arrays

_MAX_NAMES = 100  # each is a column of the padded model


@dataclass(frozen=True)
class ReadModel:
    """A model with padded successor lists, and the other contents of its file."""

    mdp: MDP  # the model
    actions: tuple[str, ...]  # A names
    more: dict[str, np.ndarray]  # other arrays by name; "system" of a game


def read_padded(path: Path, more: Sequence[str] = (), constants: str | None = None) -> ReadModel:
    """Model of a file, of a format of ``read_model`` or an ``.npz`` of padded arrays.

    `constants` are those of a program in the PRISM language, such as ``"N=64,MAX=4"``.

    Actions have the names of choices if these are distinct in each state and at most 100, else
    the rank of a choice in its state.
    """
    name = str(path)
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise ValueError(f"the model cannot be read: {name!r}: {error.strerror}.") from None
    if path.suffix.lower() == ".npz" or raw.startswith(b"PK"):
        arrays = parse_arrays(raw, name, more)
        if "entry_start" not in arrays:
            mdp, names = model_of(arrays, name)
            return ReadModel(
                mdp,
                names or _numbered("action", mdp.num_actions),
                {k: arrays[k] for k in more if k in arrays},
            )
    del raw
    model = read_model(path, constants=constants)
    arrays_of_game: dict[str, np.ndarray] = {}
    if isinstance(model, IntervalMDP):
        raise ValueError(
            f"{name!r} holds a model whose probabilities are intervals; jaxltl solve answers "
            "questions about it, and learners need single numbers."
        )
    if isinstance(model, POMDP):
        raise ValueError(
            f"{name!r} holds a POMDP; jaxltl solve answers questions about it, and tasks are for models "
            "whose states are seen."
        )
    if isinstance(model, MultiplayerGame):
        if len(model.players) > 2:
            raise ValueError(
                f"{name!r} holds a game of {len(model.players)} players; synthesis is for two, of which "
                "the first is the system."
            )
        model = model.game([1])
    if isinstance(model, Game):
        if "system" not in more:
            raise ValueError(
                f"{name!r} holds a game of two players, expected a model of one; games are for "
                "jaxltl synthesize."
            )
        arrays_of_game["system"] = np.asarray(model.system)
        model = model.mdp
    with errors_in(f"{name!r}: "):
        mdp, names, _ = padded(model)
    return ReadModel(mdp, names, arrays_of_game)


def padded(model: SparseMDP) -> tuple[MDP, tuple[str, ...], np.ndarray]:
    """A sparse model with padded successor lists, the names of actions, and each choice's action."""
    names = tuple(x or "(no name)" for x in model.action_names)
    if model.action is not None and names:
        state, action = model.host.state, np.asarray(model.action)
        used = np.unique(action)
        pairs = np.unique(state.astype(np.int64) * len(names) + action)
        listed = tuple(names[a] for a in used)
        if pairs.size == action.size and len(set(listed)) == used.size <= _MAX_NAMES:
            column = np.searchsorted(used, action).astype(np.int32)
            return to_padded(replace(model, action=column, action_names=())), listed, column
        model = replace(model, action=None)
    mdp = to_padded(model)
    kind = "choice" if model.action is None else "action"
    return mdp, _numbered(kind, mdp.num_actions), row_actions(model)


def _numbered(noun: str, count: int) -> tuple[str, ...]:
    return tuple(f"{noun} {i}" for i in range(count))
