"""Models in the Unified Markov Binary format, version 1, which Storm and PRISM read and write.

The format is described at https://github.com/pmc-tools/umb: an archive of an index in JSON and of
little-endian arrays, plain or compressed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.models.convert import to_sparse
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.interval import IntervalMDP, interval_rows, refuse_ball
from jaxltl.core.models.mdp import checked_initial
from jaxltl.core.models.sparse import Rewards, SparseMDP, make_sparse
from jaxltl.io._files import Compression, compression_by_name, pieces, raw_bytes, write_bytes
from jaxltl.io._umb_index import (
    ACTIONS,
    INITIAL,
    OTHER_LABELS,
    PARTS,
    TEXTS,
    VALUATIONS,
    Index,
    ids_for,
    parse_index,
)
from jaxltl.io._umb_tar import Stream, members, tar_pieces, write_gzip
from jaxltl.io._umb_values import (
    Bytes,
    read_bits,
    read_ends,
    read_numbers,
    read_points,
    read_starts,
    read_texts,
    read_variables,
    write_bits,
    write_texts,
    write_variables,
)

_LARGEST_INDEX = 2**26  # bytes
_PLAYERS = ("system", "environment")
_BOOL, _DOUBLE = {"type": "bool", "size": 1}, {"type": "double", "size": 64}
_INTERVAL = {"type": "double-interval", "size": 128}


def read_umb(path: str | os.PathLike[str]) -> SparseMDP | IntervalMDP | Game:
    """The Markov chain, decision process or turn-based game in a UMB file.

    Read are plain archives and those compressed by gzip or xz: labels, rewards on states, choices
    and branches, names of actions, and variables of states. Probabilities and rewards that are
    rational become the nearest doubles. Branches of a choice with the same target become one.
    Player 0 of a game is the system. Probabilities that are intervals make it an interval model,
    whose rewards may be written as intervals of one point. Where no state is initial, the initial
    distribution is uniform over all.

    Left out, as nothing follows from them: who made the file, the players' names, actions of
    branches, annotations other than labels and rewards, variables of choices and branches, and
    whole numbers of more than 64 bits. A variable that some state lacks is a double, NaN there, or
    an empty text.

    Args:
      path: the file.

    Returns:
      A :class:`~jaxltl.core.models.sparse.SparseMDP`, an
      :class:`~jaxltl.core.models.interval.IntervalMDP`, or a game
      (:class:`~jaxltl.core.models.game.Game`) over a SparseMDP.

    Raises:
      ValueError: the file cannot be read, is damaged or no UMB file, its parts do not fit one
        another, or it holds what is not read: games with intervals, rates, observations, more
        than two players who have a choice, choices whose branches have no probabilities. The
        message names the file, the member, what was found and what was expected.
    """
    name = str(path)
    place = f"{name!r}: "
    data = raw_bytes(path)
    try:
        index = _read_index(data, name, place)
        found = _read_members(data, index, name, place)
        del data
        return _model(found, index, place)
    except MemoryError:
        raise ValueError(f"{place}the model does not fit into the memory.") from None


def _read_index(data: bytes, name: str, place: str) -> Index:
    stream = Stream(pieces(data, name), place)
    for member, size in members(stream):
        if member == "index.json":
            if size > _LARGEST_INDEX:
                raise ValueError(
                    f"{place}index.json has {size} bytes; at most {_LARGEST_INDEX} are read."
                )
            content = bytearray(size)
            stream.fill(content, member)
            return parse_index(bytes(content), f"{place}index.json: ")
    raise ValueError(f"{place}the archive has no index.json; it is no UMB file.")


def _read_members(data: bytes, index: Index, name: str, place: str) -> dict[str, Bytes]:
    """The members that the index tells of; each has the size that follows from the index."""
    bounds, found = index.bounds(), {}
    _check_memory(sum(most for _, most in bounds.values()), place)
    stream = Stream(pieces(data, name), place)
    for member, size in members(stream):
        if member in found:
            raise ValueError(f"{place}two members are named {member!r}.")
        if member not in bounds:
            continue
        least, most = bounds[member]
        if not least <= size <= most:
            wanted = f"{most}" if least == most else f"{least} to {most}"
            raise ValueError(
                f"{place}{member} has {size} bytes; expected {wanted}, by the counts "
                "and types of index.json."
            )
        found[member] = np.empty(size, np.uint8)
        stream.fill(found[member], member)
    return found


def _check_memory(size: int, place: str) -> None:
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # another system
        return
    if 2 * size > memory:
        raise ValueError(
            f"{place}index.json tells of a model of {size / 2**30:.3g} GB, which "
            f"takes twice that; there are {memory / 2**30:.3g} GB."
        )


def _model(found: dict[str, Bytes], index: Index, place: str) -> SparseMDP | IntervalMDP | Game:
    row_start = _starts(found, "state-to-choices.bin", index.states, index.choices, place)
    entry_start = _starts(found, "choice-to-branches.bin", index.choices, index.branches, place)
    target = _needed(found, "branch-to-target.bin", place).view("<u8")
    if index.players == 0:
        _check_chain(row_start, place)
    labels, names = _labels(found, index, place)
    options: dict[str, Any] = {"rewards": _rewards(found, index, place)}
    if index.actions:
        options |= _actions(found, index, place)
    if f"{VALUATIONS}/valuations.bin" in found:
        options["valuation"] = _valuation(found, index, place)
    probability = _probability(found, index, entry_start, place)
    initial = _initial(found, index)
    owner = _owners(found, index, row_start, place)
    rows = row_start, entry_start, target
    options |= {"label": labels, "propositions": names, "initial": initial}
    interval = None
    try:
        if probability.ndim > 1:
            interval = interval_rows(*rows, *probability.T, **options)
            model = interval.nominal
        else:
            model = make_sparse(*rows, probability, **options)
    except ValueError as error:
        raise ValueError(f"{place}{error}") from None
    exact = found.get(f"annotations/{INITIAL}/probability/states/values.bin")
    if exact is not None:  # what was checked may have been scaled
        model = replace(model, initial=exact.view("<f8").astype(np.float64, copy=False))
    if interval is not None:
        return replace(interval, nominal=model)
    return model if owner is None else make_game(model, owner)


def _needed(found: dict[str, Bytes], member: str, place: str) -> Bytes:
    if member not in found:
        raise ValueError(f"{place}{member} is missing.")
    return found[member]


def _starts(
    found: dict[str, Bytes], member: str, count: int, total: int, place: str
) -> NDArray[np.int64]:
    """Where the spans of a member start; without it, each has one."""
    if member in found:
        return read_starts(found.pop(member), total, f"{place}{member}: ")
    if count != total:
        raise ValueError(
            f"{place}{member} is missing, so that {count} are mapped to {total} one "
            "to one; expected the member, or equal counts."
        )
    return np.arange(count + 1)


def _check_chain(row_start: NDArray[np.int64], place: str) -> None:
    count = np.diff(row_start)
    if (count != 1).any():
        state = int(np.flatnonzero(count != 1)[0])
        raise ValueError(
            f"{place}state-to-choices.bin: state {state} has {count[state]} choices; "
            "expected one, as #players is 0."
        )


def _labels(
    found: dict[str, Bytes], index: Index, place: str
) -> tuple[NDArray[np.bool_], tuple[str, ...]]:
    ours = {x.id: x for x in index.annotations if x.group == OTHER_LABELS}
    others = iter([x for x in index.annotations if x.group == "aps"])
    all_of = []
    for i in range(len(index.annotations)):  # the ids of ours are their places
        one = ours.pop(str(i), None) or next(others, None)
        if one is not None:
            all_of.append(one)
    all_of += ours.values()
    label = np.zeros((index.states, len(all_of)), bool)
    for i, one in enumerate(all_of):
        label[:, i] = read_bits(_needed(found, one.member("states"), place), index.states)
    return label, tuple(one.name for one in all_of)


def _rewards(found: dict[str, Bytes], index: Index, place: str) -> dict[str, Rewards]:
    rewards = {}
    for one in index.annotations:
        if one.group == "rewards":
            parts = {
                PARTS[part]: read_points(
                    found.pop(one.member(part)), one.type, f"{place}{one.member(part)}: "
                )
                for part in one.applies_to
                if one.member(part) in found
            }
            rewards[one.name] = Rewards(**parts)
    return rewards


def _actions(found: dict[str, Bytes], index: Index, place: str) -> dict[str, Any]:
    """The number of each choice's action, and the names."""
    member = f"{ACTIONS}/values.bin"
    action = np.zeros(index.choices, np.int32)
    if member in found:
        action = found.pop(member).view("<u4")
        if action.size and action.max() >= index.actions:
            raise ValueError(
                f"{place}{member}: a choice has the action {action.max()}; expected 0 "
                f"to {index.actions - 1}."
            )
    return {"action": action, "action_names": _texts(found, ACTIONS, place)}


def _texts(found: dict[str, Bytes], folder: str, place: str) -> tuple[str, ...]:
    """The texts of a folder by their numbers; none if it has none."""
    mapping, strings = f"{folder}/string-mapping.bin", f"{folder}/strings.bin"
    if mapping not in found:
        return ()
    content = _needed(found, strings, place)
    start = read_starts(found[mapping], content.size, f"{place}{mapping}: ")
    return read_texts(start, content, f"{place}{strings}: ")


def _valuation(found: dict[str, Bytes], index: Index, place: str) -> dict[str, NDArray[Any]]:
    of_class = found.get(f"{VALUATIONS}/valuation-to-class.bin")
    return read_variables(
        found.pop(f"{VALUATIONS}/valuations.bin"),
        None if of_class is None else of_class.view("<u4"),
        index.records,
        index.states,
        _texts(found, VALUATIONS, place),
        f"{place}{VALUATIONS}/valuations.bin: ",
    )


def _probability(
    found: dict[str, Bytes], index: Index, entry_start: NDArray[np.int64], place: str
) -> NDArray[np.float64]:
    """The probability of each branch, or lower and upper ends ``[T, 2]``."""
    member, kind = "branch-to-probability.bin", index.probability
    if kind is not None and kind.end is not None and index.players > 1:
        raise ValueError(
            f"{place}the probabilities of this game are intervals; chains and decision processes "
            "are read with them."
        )
    if kind is not None and member in found:
        read = read_numbers if kind.end is None else read_ends
        return read(found.pop(member), kind, f"{place}{member}: ")
    several = np.flatnonzero(np.diff(entry_start) > 1)
    if several.size:
        count = int(np.diff(entry_start)[several[0]])
        raise ValueError(
            f"{place}{member} is missing, and choice {several[0]} has {count} "
            "branches; without probabilities each choice may have one."
        )
    return np.ones(index.branches if kind is None or kind.end is None else (index.branches, 2))


def _initial(found: dict[str, Bytes], index: Index) -> NDArray[np.float64] | None:
    """A distribution; None is the uniform one over all states."""
    exact = found.get(f"annotations/{INITIAL}/probability/states/values.bin")
    if exact is not None:
        return exact.view("<f8").astype(np.float64, copy=False)
    if "state-is-initial.bin" not in found:
        return None
    return _uniform(read_bits(found["state-is-initial.bin"], index.states))


def _uniform(initial: NDArray[np.bool_]) -> NDArray[np.float64] | None:
    """The distribution over some states that a reader takes; None if these are all or none."""
    count = int(initial.sum())
    return None if count in (0, initial.size) else initial / count


def _owners(
    found: dict[str, Bytes], index: Index, row_start: NDArray[np.int64], place: str
) -> NDArray[np.bool_] | None:
    """Where the system moves in a game of two; None if there is one player or chance alone."""
    if index.players < 2:
        return None
    member = "state-to-player.bin"
    player = np.zeros(index.states, np.uint32)
    if member in found:
        player = found[member].view("<u4")
    if player.max() >= index.players:
        raise ValueError(
            f"{place}{member}: a state is of player {player.max()}; expected 0 to "
            f"{index.players - 1}."
        )
    # Who owns a state with one choice does not matter: Storm gives such ones to another player.
    more = np.flatnonzero((player > 1) & (np.diff(row_start) > 1))
    if more.size:
        names = ", ".join(map(repr, index.player_names[:9])) or "no names"
        raise ValueError(
            f"{place}the game has {index.players} players ({names}), and player "
            f"{player[more[0]]} chooses in state {more[0]}; games of two are read."
        )
    return player != 1


# --- writing --------------------------------------------------------------------------------


def write_umb(
    path: str | os.PathLike[str],
    model: Any,
    *,
    compression: Compression | Literal["by name"] | None = "by name",
) -> None:
    """Writes a model as a UMB file that Storm and PRISM read, whole or not at all.

    :func:`read_umb` gives back the same model bit for bit, except that variables narrower than 32
    bits become int32 (floating ones double), that an empty reward is written as zeros on states,
    and that names of actions go with their numbers. An initial distribution that is not
    uniform and a label named init, which other tools have of their own, are kept where other
    tools pass over them; those see the set of states with a positive initial probability. The
    same model gives the same bytes.

    Args:
      path: the file.
      model: a model that :func:`~jaxltl.core.models.convert.to_sparse` takes, an interval model,
        whose rewards are written as intervals of one point, or a game over a model.
      compression: "gzip", "xz", None for none, or by the end of the name: xz for ``.xz``, else
        gzip.

    Raises:
      ValueError: a variable holds neither truth values, numbers nor texts, a name is no Unicode,
        or the place cannot be written to.
    """
    if compression not in ("gzip", "xz", "by name", None):
        raise ValueError(
            f"compression is {compression!r}; expected 'gzip', 'xz', None or 'by name'."
        )
    contents = _contents(model, f"{str(path)!r}: ")
    if compression == "by name":
        compression = compression_by_name(path) or "gzip"
    if compression == "gzip":
        with write_bytes(path, None) as file:
            write_gzip(file, tar_pieces(contents))
    else:
        with write_bytes(path, compression) as file:
            for piece in tar_pieces(contents):
                file.write(piece)


def _contents(model: Any, place: str) -> list[tuple[str, Any]]:
    """The members of a model's file, the index first."""
    system, interval = None, None
    if isinstance(model, Game):
        model, system = model.mdp, np.asarray(model.system, bool).ravel()
    if isinstance(model, IntervalMDP):
        refuse_ball(model, "the format holds intervals")
        interval, model = model.host, model.nominal
    sparse = to_sparse(model)
    host, initial = sparse.host, np.asarray(sparse.initial, np.float64)
    players = 2 if system is not None else 0 if host.is_chain else 1
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
    contents: list[tuple[str, Any]] = [("state-is-initial.bin", write_bits(initial > 0))]
    if not host.is_chain:
        contents.append(("state-to-choices.bin", _packed(host.row_start, "<u8")))
    contents += [
        ("choice-to-branches.bin", _packed(host.entry_start, "<u8")),
        ("branch-to-target.bin", _packed(host.successor, "<u8")),
        (
            "branch-to-probability.bin",
            _packed(host.probability, "<f8")
            if interval is None
            else _pairs(interval.lower, interval.upper),
        ),
    ]
    if system is not None:
        counts["player-names"] = list(_PLAYERS)
        contents.append(("state-to-player.bin", _packed(~system, "<u4")))
    if sparse.action is not None:
        action = np.asarray(sparse.action)
        names = sparse.action_names
        counts["#choice-actions"] = len(names) or int(action.max()) + 1
        contents.append((f"{ACTIONS}/values.bin", _packed(action, "<u4")))
        contents += _written_texts(names, ACTIONS, place)
    annotations, more = _annotations(sparse, initial, interval is not None)
    index: dict[str, Any] = {
        "format-version": 1,
        "format-revision": 0,
        "file-data": {"tool": "jaxltl"},
        "transition-system": counts,
        "annotations": annotations,
    }
    contents += more
    if sparse.valuation:
        written = write_variables(sparse.valuation, place)
        states: dict[str, Any] = {"unique": False, "classes": [{"variables": written.variables}]}
        if written.named:
            states["#strings"] = len(written.texts)
            index["file-data"]["parameters"] = {TEXTS: written.named}
        index["valuations"] = {"states": states}
        contents.append((f"{VALUATIONS}/valuations.bin", written.records))
        contents += _written_texts(written.texts, VALUATIONS, place)
    return [("index.json", json.dumps(index, indent=1).encode()), *contents]


def _packed(array: Any, dtype: str) -> Bytes:
    """An array as bytes."""
    return np.ascontiguousarray(array, np.dtype(dtype)).view(np.uint8)


def _written_texts(texts: Sequence[str], folder: str, place: str) -> list[tuple[str, Any]]:
    """The members for texts by their numbers; none if there are none."""
    if not texts:
        return []
    start, content = write_texts(texts, f"{place}{folder}: ")
    return [(f"{folder}/string-mapping.bin", start), (f"{folder}/strings.bin", content)]


def _pairs(lower: Any, upper: Any) -> Bytes:
    """Intervals as bytes."""
    return _packed(np.stack([lower, upper], 1).ravel(), "<f8")


def _annotations(
    model: SparseMDP, initial: NDArray[np.float64], points: bool
) -> tuple[dict[str, Any], list[tuple[str, Any]]]:
    """The labels, the rewards and the initial distribution if need be: described, and members.

    Args:
      model, initial: the model.
      points: whether rewards are written as intervals, as Storm has them in interval models.
    """
    described: dict[str, Any] = {"aps": {}, "rewards": {}}
    contents: list[tuple[str, Any]] = []

    def add(group: str, key: str, name: str, kind: dict[str, Any], parts: dict[str, Bytes]) -> None:
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
        # Storm and PRISM have a label init of their own, the initial states.
        group, key = (OTHER_LABELS, str(i)) if name == "init" else ("aps", key)
        add(group, key, name, _BOOL, {"states": write_bits(label[:, i])})
    names = list(model.rewards)
    for name, key in zip(names, ids_for(names, "r"), strict=True):
        given = {part: getattr(model.rewards[name], ours) for part, ours in PARTS.items()}
        parts = {part: x for part, x in given.items() if x is not None}
        parts = parts or {"states": np.zeros(model.num_states)}
        packed = {k: _pairs(x, x) if points else _packed(x, "<f8") for k, x in parts.items()}
        add("rewards", key, name, _INTERVAL if points else _DOUBLE, packed)
    if not np.array_equal(initial, checked_initial(_uniform(initial > 0), initial.size)):
        add(
            INITIAL,
            "probability",
            "initial distribution",
            _DOUBLE,
            {"states": _packed(initial, "<f8")},
        )
    return described, contents
