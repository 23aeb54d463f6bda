"""Models in the Unified Markov Binary (UMB) format, version 1, of Storm and PRISM.

https://github.com/pmc-tools/umb: a tar archive of a JSON index and little-endian arrays.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.validation import errors_in
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.interval import IntervalMDP, interval_rows, refuse_ball
from jaxltl.core.models.mdp import checked_initial
from jaxltl.core.models.pomdp import POMDP, make_pomdp
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import SparseMDP, make_sparse
from jaxltl.io.files import Compression, compression_by_name, decompressed, raw_bytes, write_bytes
from jaxltl.io.umb.index import (
    ACTIONS,
    INITIAL,
    OBSERVATIONS,
    OTHER_LABELS,
    PARTS,
    TEXTS,
    Index,
    ids_for,
)
from jaxltl.io.umb.members import (
    annotations_of,
    check_chain,
    check_memory,
    exact_initial,
    fill,
    known_members,
    needed,
    probability_of,
    read_index,
    starts_of,
    tar_pieces,
    texts_of,
    uniform,
    write_gzip,
)
from jaxltl.io.umb.values import (
    Bytes,
    read_bits,
    read_variables,
    write_bits,
    write_texts,
    write_variables,
)

_PLAYERS = ("system", "environment")
_BOOL, _DOUBLE = {"type": "bool", "size": 1}, {"type": "double", "size": 64}
_INTERVAL = {"type": "double-interval", "size": 128}

Members = list[tuple[str, Bytes | bytes]]


def read_umb(path: str | os.PathLike[str]) -> SparseMDP | IntervalMDP | Game | POMDP:
    """Markov chain, MDP, interval model, turn-based game or POMDP of a UMB file.

    Reads labels, rewards on states, choices and branches, action names and state variables.
    Rational numbers become the nearest doubles, and branches of a choice with equal targets are
    merged. Player 0 of a game is the system. Without initial states the initial distribution is
    uniform. A variable that is absent in some states is a double (NaN there) or an empty string.
    Observations of states give a POMDP, whose `observables` are the variables of observations.

    Ignored: metadata, names of players, branch actions, other annotations, variables of choices and
    branches, and integers of more than 64 bits.

    Args:
      path: the file, plain or compressed by gzip or xz.

    Returns:
      A SparseMDP, an IntervalMDP, or a Game or POMDP over a SparseMDP.

    Raises:
      ValueError: with file and member, for unreadable, damaged or inconsistent files, interval
        games, rates, random observations or those of branches, more than two players with choices, and
        missing probabilities.
    """
    data = raw_bytes(path)
    with errors_in(f"{str(path)!r}: "):
        try:
            index = read_index(decompressed(io.BytesIO(data)))
            check_memory(sum(largest for _, largest in index.bounds().values()))
            file, contents = decompressed(io.BytesIO(data)), {}
            del data
            for member, size in known_members(file, index):
                contents[member] = np.empty(size, np.uint8)
                fill(file, contents[member], member)
            return _model(contents, index)
        except MemoryError:
            raise ValueError("the model does not fit into the memory.") from None


def _model(contents: dict[str, Bytes], index: Index) -> SparseMDP | IntervalMDP | Game | POMDP:
    row_start = starts_of(contents, "state-to-choices.bin", index.states, index.choices)
    entry_start = starts_of(contents, "choice-to-branches.bin", index.choices, index.branches)
    target = needed(contents, "branch-to-target.bin").view("<u8")
    if index.players == 0:
        check_chain(row_start)
    annotations = annotations_of(contents, index)
    annotations["valuation"] = _variables(contents, index, "states")
    probability = probability_of(contents, index, entry_start)
    initial = _initial(contents, index)
    owner = _owners(contents, index, row_start)
    rows = row_start, entry_start, target
    interval = None
    if probability.ndim > 1:
        interval = interval_rows(*rows, *probability.T, initial=initial, **annotations)
        model = interval.nominal
    else:
        model = make_sparse(*rows, probability, initial=initial, **annotations)
    exact = exact_initial(contents)
    if exact is not None:  # validation may have rescaled it
        model = replace(model, initial=exact)
    if interval is not None:
        return replace(interval, nominal=model)
    if index.observations:
        return _observed(contents, index, model)
    return model if owner is None else make_game(model, owner)


def _variables(contents: dict[str, Bytes], index: Index, entity: str) -> dict[str, Array]:
    """Variables of states or observations."""
    for one in index.layouts:
        member = f"{one.folder}/valuations.bin"
        if one.entity == entity and member in contents:
            of_class = contents.get(f"{one.folder}/valuation-to-class.bin")
            texts = texts_of(contents, one.folder)
            with errors_in(f"{member}: "):
                return read_variables(
                    contents.pop(member),
                    None if of_class is None else of_class.view("<u4"),
                    one.records,
                    index.num_records(one),
                    texts,
                )
    return {}


def _observed(contents: dict[str, Bytes], index: Index, model: SparseMDP) -> POMDP:
    """The POMDP with the observations of states, which are 0 if the member is missing."""
    seen = contents.get(OBSERVATIONS, np.zeros(8 * index.states, np.uint8)).view("<u8")
    if seen.max() >= index.observations:
        raise ValueError(
            f"{OBSERVATIONS}: a state has the observation {seen.max()}; expected 0 to "
            f"{index.observations - 1}."
        )
    observables = _variables(contents, index, "observations")
    used = int(seen.max()) + 1
    with errors_in(f"{OBSERVATIONS}: "):
        return make_pomdp(
            model,
            seen.astype(np.int64),
            observables={name: x[:used] for name, x in observables.items()},
        )


def _initial(contents: dict[str, Bytes], index: Index) -> NDArray[np.float64] | None:
    """Initial distribution; None for the uniform one over all states."""
    if (exact := exact_initial(contents)) is not None:
        return exact
    if "state-is-initial.bin" not in contents:
        return None
    return uniform(read_bits(contents["state-is-initial.bin"], index.states))


def _owners(
    contents: dict[str, Bytes], index: Index, row_start: NDArray[np.int64]
) -> NDArray[np.bool_] | None:
    """Mask of the system's states in a two-player game; None for other models."""
    if index.players < 2:
        return None
    member = "state-to-player.bin"
    player = np.zeros(index.states, np.uint32)
    if member in contents:
        player = contents[member].view("<u4")
    if player.max() >= index.players:
        raise ValueError(
            f"{member}: a state is of player {player.max()}; expected 0 to {index.players - 1}."
        )
    # Storm assigns states with one choice to a third player; their owner is irrelevant.
    more = np.flatnonzero((player > 1) & (np.diff(row_start) > 1))
    if more.size:
        names = ", ".join(map(repr, index.player_names[:9])) or "no names"
        raise ValueError(
            f"the game has {index.players} players ({names}), and player "
            f"{player[more[0]]} chooses in state {more[0]}; games of two are read."
        )
    return player != 1


# --- writing --------------------------------------------------------------------------------


def write_umb(
    path: str | os.PathLike[str],
    model: Model | POMDP,
    *,
    compression: Compression | Literal["by name"] | None = "by name",
) -> None:
    """Writes a model as a UMB file for Storm and PRISM, atomically.

    :func:`read_umb` restores the model bit for bit, except that numeric variables are widened to at
    least 32-bit integers or to doubles, an empty reward becomes zeros on states, and action names
    require numbers. A non-uniform initial distribution and a label named init are stored in
    extensions that other tools ignore; they read its support. The output is deterministic.

    Args:
      path: the file.
      model: a model that ``to_sparse`` takes, a game, a POMDP, or an interval model; the rewards of
        the last are written as point intervals.
      compression: "gzip", "xz", None for none, or by suffix: xz for ``.xz``, else gzip.

    Raises:
      ValueError: for variables of an unsupported type, names that are not Unicode, or the file
        cannot be written.

    Example:
      >>> import tempfile, jaxltl as jl
      >>> path = tempfile.mkdtemp() + "/coin.umb"
      >>> write_umb(path, jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1]))
      >>> read_umb(path).probability.tolist()
      [0.5, 0.5, 1.0, 1.0]
    """
    if compression not in ("gzip", "xz", "by name", None):
        raise ValueError(
            f"compression is {compression!r}; expected 'gzip', 'xz', None or 'by name'."
        )
    with errors_in(f"{str(path)!r}: "):
        contents = umb_contents(model)
    if compression == "by name":
        compression = compression_by_name(path) or "gzip"
    if compression == "gzip":
        with write_bytes(path, None) as file:
            write_gzip(file, tar_pieces(contents))
    else:
        with write_bytes(path, compression) as file:
            for piece in tar_pieces(contents):
                file.write(piece)


def umb_contents(model: Model | POMDP) -> Members:
    """Members of the output, the index first."""
    system: NDArray[np.bool_] | None = None
    interval = pomdp = None
    if isinstance(model, POMDP):
        pomdp = model
        model = pomdp.fully_observable
    if isinstance(model, Game):
        system = np.asarray(model.system, np.bool_).ravel()
        model = model.mdp
    if isinstance(model, IntervalMDP):
        refuse_ball(model, "the format holds intervals")
        interval, model = model.host, model.nominal
    sparse = to_sparse(cast(Model, model))
    host, initial = sparse.host, np.asarray(sparse.initial, np.float64)
    players = 2 if system is not None else 0 if host.is_chain and pomdp is None else 1
    counts = {
        "time": "discrete",
        "#players": players,
        "#states": host.num_states,
        "#initial-states": int((initial > 0).sum()),
        "#choices": host.num_rows,
        "#choice-actions": 0,
        "#branches": host.num_transitions,
        "#branch-actions": 0,
        "#observations": 0,
        "branch-probability-type": _DOUBLE if interval is None else _INTERVAL,
    }
    chances = _packed(host.probability, "<f8")
    if interval is not None:
        chances = _pairs(interval.lower, interval.upper)
    contents: Members = [("state-is-initial.bin", write_bits(initial > 0))]
    if not host.is_chain:
        contents.append(("state-to-choices.bin", _packed(host.row_start, "<u8")))
    contents += [
        ("choice-to-branches.bin", _packed(host.entry_start, "<u8")),
        ("branch-to-target.bin", _packed(host.successor, "<u8")),
        ("branch-to-probability.bin", chances),
    ]
    if pomdp is not None:
        counts |= {"#observations": pomdp.num_observations, "observations-apply-to": "states"}
        contents.append((OBSERVATIONS, _packed(pomdp.observation, "<u8")))
    if system is not None:
        counts["player-names"] = list(_PLAYERS)
        contents.append(("state-to-player.bin", _packed(~system, "<u4")))
    if sparse.action is not None:
        action, names = np.asarray(sparse.action), sparse.action_names
        counts["#choice-actions"] = len(names) or int(action.max()) + 1
        contents.append((f"{ACTIONS}/values.bin", _packed(action, "<u4")))
        contents += _written_texts(names, ACTIONS)
    annotations, more = _annotations(sparse, initial, interval is not None)
    metadata: dict[str, object] = {"tool": "jaxltl"}
    index: dict[str, object] = {
        "format-version": 1,
        "format-revision": 0,
        "file-data": metadata,
        "transition-system": counts,
        "annotations": annotations,
    }
    contents += more
    valuations: dict[str, object] = {}
    named: list[str] = []
    observables = {} if pomdp is None else pomdp.observables
    for entity, valuation in (("states", sparse.valuation), ("observations", observables)):
        if valuation:
            variables, folder = write_variables(valuation), f"valuations/{entity}"
            classes = [{"variables": variables.variables}]
            layout: dict[str, object] = {"unique": False, "classes": classes}
            if variables.named:
                layout["#strings"] = len(variables.texts)
                named += variables.named
                metadata["parameters"] = {TEXTS: named}
            valuations[entity] = layout
            contents.append((f"{folder}/valuations.bin", variables.records))
            contents += _written_texts(variables.texts, folder)
    if valuations:
        index["valuations"] = valuations
    return [("index.json", json.dumps(index, indent=1).encode()), *contents]


def _packed(array: ArrayLike, dtype: str) -> Bytes:
    return np.ascontiguousarray(array, np.dtype(dtype)).view(np.uint8)


def _written_texts(texts: Sequence[str], folder: str) -> Members:
    """Members of an array of strings; none if it is empty."""
    if not texts:
        return []
    with errors_in(f"{folder}: "):
        start, content = write_texts(texts)
    return [(f"{folder}/string-mapping.bin", start), (f"{folder}/strings.bin", content)]


def _pairs(lower: NDArray[np.float64], upper: NDArray[np.float64]) -> Bytes:
    return _packed(np.stack([lower, upper], 1).ravel(), "<f8")


def _annotations(
    model: SparseMDP, initial: NDArray[np.float64], points: bool
) -> tuple[dict[str, dict[str, object]], Members]:
    """Index entries and members of labels, rewards and a non-uniform initial distribution."""
    described: dict[str, dict[str, object]] = {"aps": {}, "rewards": {}}
    contents: Members = []

    def add(
        group: str, key: str, name: str, kind: Mapping[str, object], parts: dict[str, Bytes]
    ) -> None:
        described.setdefault(group, {})[key] = {
            "alias": name,
            "applies-to": list(parts),
            "type": kind,
        }
        contents.extend(
            (f"annotations/{group}/{key}/{part}/values.bin", content)
            for part, content in parts.items()
        )

    label = np.asarray(model.label)
    for i, (name, key) in enumerate(
        zip(model.propositions, ids_for(model.propositions, "ap"), strict=True)
    ):
        # Storm and PRISM reserve the label init for the initial states.
        group, key = (OTHER_LABELS, str(i)) if name == "init" else ("aps", key)
        add(group, key, name, _BOOL, {"states": write_bits(label[:, i])})
    names = list(model.rewards)
    for name, key in zip(names, ids_for(names, "r"), strict=True):
        reward_parts = {part: getattr(model.rewards[name], ours) for part, ours in PARTS.items()}
        parts = {part: x for part, x in reward_parts.items() if x is not None}
        parts = parts or {"states": np.zeros(model.num_states)}
        packed = {k: _pairs(x, x) if points else _packed(x, "<f8") for k, x in parts.items()}
        add("rewards", key, name, _INTERVAL if points else _DOUBLE, packed)
    if not np.array_equal(initial, checked_initial(uniform(initial > 0), initial.size)):
        add(
            INITIAL,
            "probability",
            "initial distribution",
            _DOUBLE,
            {"states": _packed(initial, "<f8")},
        )
    return described, contents
