"""Writer of the sections of PRISM's explicit files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.models import IntervalMDP, Rewards, SparseMDP
from jaxltl.io.text_output import check_name, exact_part, labels_with_init, value_texts
from jaxltl.io.tokens import joined_lines

_STEP = 2**17  # lines per piece


@dataclass(frozen=True)
class Written:
    """A section of an explicit file to be written."""

    kind: str  # "tra", "lab", "sta", "srew" or "trew"
    number: str  # number of the reward if there are several
    header: list[bytes]  # lines that introduce the section in a single file
    lines: Callable[[], Iterator[bytes]]  # generator of the lines, in pieces


def written_sections(source: SparseMDP | IntervalMDP, dialect: str) -> list[Written]:
    """Sections of a model's files, in order; ValueError if the format cannot represent it."""
    storm, model = dialect == "storm", exact_part(source)
    chances = value_texts(source, ",")
    if storm and model is not source:
        raise ValueError(
            "Storm reads no intervals in explicit files; write PRISM's (dialect='prism'), or UMB "
            "or DRN."
        )
    labels, holds = _labels(model, storm)
    title = ("" if model is source else "I") + ("DTMC" if model.is_chain else "MDP")
    kind = f"# Transitions ({title})\n".encode()
    action = (
        None if storm and model.is_chain else _action_texts(model)
    )  # Storm reads no actions of chains
    sections = [Written("tra", "", [kind], lambda: _transitions(model, chances, action, storm))]
    if model.valuation and not storm:
        values = [_value_texts(name, x) for name, x in model.valuation.items()]
        names = _plain(model.valuation, "variable", ' "(),')
        sections.append(Written("sta", "", [b"# States\n"], lambda: _states(names, values)))
    sections.append(Written("lab", "", [b"# Labels\n"], lambda: _label_lines(labels, holds, storm)))
    several = len(model.rewards) > 1
    for i, (name, reward) in enumerate(model.rewards.items()):
        _plain([name], "reward", '"')
        sections += _rewards(model, name, reward, str(i + 1) if several else "", storm)
    return sections


def _plain(names: Iterable[str], kind: str, refused: str) -> list[str]:
    """Names, validated against the characters that the format reserves."""
    for name in names:
        check_name(kind, name, refused)
    return list(names)


def _transitions(
    model: SparseMDP,
    chances: Callable[[slice], list[str]],
    action: Callable[[int], str] | None,
    storm: bool,
) -> Iterator[bytes]:
    host = model.host
    if storm:
        yield b"dtmc\n" if model.is_chain else b"mdp\n"
    elif model.is_chain:
        yield b"%d %d\n" % (host.num_states, host.num_transitions)
    else:
        yield b"%d %d %d\n" % (host.num_states, host.num_rows, host.num_transitions)
    numbers = np.asarray(model.action) if model.action is not None else None
    columns_of = _entry_columns(model)
    form = "%d " * (2 if model.is_chain else 3) + "%s"
    for begin in range(0, host.num_transitions, _STEP):
        part = slice(begin, begin + _STEP)
        columns: list[Sequence[object]] = [*columns_of(part), chances(part)]
        if action is not None and numbers is not None:
            columns.append([action(i) for i in numbers[host.row[part]].tolist()])
        yield joined_lines(form + "%s" * (action is not None) + "\n", *columns)


def _entry_columns(model: SparseMDP) -> Callable[[slice | Integers], list[list[int]]]:
    """Function from transitions to the columns of states, choices (if not a chain), successors."""
    host = model.host
    choice = np.arange(host.num_rows) - host.row_start[host.state]

    def columns(part: slice | Integers) -> list[list[int]]:
        row = host.row[part]
        choices = [] if host.is_chain else [choice[row].tolist()]
        return [host.state[row].tolist(), *choices, host.successor[part].tolist()]

    return columns


def _action_texts(model: SparseMDP) -> Callable[[int], str] | None:
    """Function from action numbers to the action column."""
    if model.action is None:
        return None
    if not model.action_names:
        return " _{}".format
    _plain(model.action_names, "action", ' "')
    return [f" {name}" if name else "" for name in model.action_names].__getitem__


def _labels(model: SparseMDP, storm: bool) -> tuple[list[str], list[NDArray[np.bool_]]]:
    """Label names, "init" first, and their masks."""
    masks = labels_with_init(model)
    return _plain(tuple(masks), "label", ' "' if storm else '"'), list(masks.values())


def _label_lines(names: list[str], holds: list[NDArray[np.bool_]], storm: bool) -> Iterator[bytes]:
    if storm:
        yield f"#DECLARATION\n{' '.join(names)}\n#END\n".encode()
    else:
        yield (" ".join(f'{i}="{name}"' for i, name in enumerate(names)) + "\n").encode()
    texts = [f" {name}" if storm else f" {i}" for i, name in enumerate(names)]
    for begin in range(0, holds[0].size, _STEP):
        state, column = np.nonzero(np.stack([h[begin : begin + _STEP] for h in holds], 1))
        first = np.diff(state, prepend=-1) > 0
        after = "" if storm else ":"
        lines = [
            f"\n{s + begin}{after}{texts[c]}" if new else texts[c]
            for s, c, new in zip(state.tolist(), column.tolist(), first.tolist(), strict=True)
        ]
        yield ("".join(lines)[1:] + "\n").encode() if lines else b""


def _value_texts(name: str, value: ArrayLike) -> Callable[[slice], list[str]]:
    value = np.asarray(value)
    if value.dtype == bool:
        return lambda part: np.where(value[part], "true", "false").tolist()
    if np.issubdtype(value.dtype, np.integer) or np.issubdtype(value.dtype, np.floating):
        if np.issubdtype(value.dtype, np.floating) and np.isnan(value).any():
            raise ValueError(f"the variable {name!r} is NaN somewhere; leave it out.")
        return lambda part: list(map(repr, value[part].tolist()))
    raise ValueError(
        f"the variable {name!r} has values of dtype {value.dtype}; the format holds "
        "truth values and numbers. Leave it out, or number its values."
    )


def _states(names: list[str], values: list[Callable[[slice], list[str]]]) -> Iterator[bytes]:
    yield f"({','.join(names)})\n".encode()
    form, begin = f"%d:({','.join(['%s'] * len(names))})\n", 0
    while columns := [value(slice(begin, begin + _STEP)) for value in values]:
        if not columns[0]:
            return
        yield joined_lines(form, range(begin, begin + len(columns[0])), *columns)
        begin += _STEP


def _rewards(
    model: SparseMDP, name: str, reward: Rewards, number: str, storm: bool
) -> Iterator[Written]:
    title = f'# Reward structure "{name}"\n' if name else "# Reward structure\n"
    state = None if reward.state is None else np.asarray(reward.state, np.float64)
    earned = _on_entries(model, reward)
    if state is not None or earned is None:
        state_rewards = np.zeros(model.num_states) if state is None else state
        yield Written(
            "srew",
            number,
            [title.encode(), b"# State rewards\n"],
            lambda: _state_rewards(state_rewards, storm),
        )
    if earned is not None:
        entry_rewards = earned
        yield Written(
            "trew",
            number,
            [title.encode(), b"# Transition rewards\n"],
            lambda: _transition_rewards(model, entry_rewards, storm),
        )


def _on_entries(model: SparseMDP, reward: Rewards) -> NDArray[np.float64] | None:
    """Sum of choice and transition rewards per transition, ``[T]``."""
    choice = None
    if reward.choice is not None:
        choice = np.asarray(reward.choice, np.float64)[model.host.row]
    if reward.transition is None:
        return choice
    transition = np.asarray(reward.transition, np.float64)
    return transition if choice is None else choice + transition


def _state_rewards(reward: NDArray[np.float64], storm: bool) -> Iterator[bytes]:
    state = np.flatnonzero(reward)
    if not storm:
        yield b"%d %d\n" % (reward.size, state.size)
    for begin in range(0, state.size, _STEP):
        part = state[begin : begin + _STEP]
        yield _infinity(joined_lines("%d %r\n", part.tolist(), reward[part].tolist()), storm)


def _transition_rewards(
    model: SparseMDP, earned: NDArray[np.float64], storm: bool
) -> Iterator[bytes]:
    host = model.host
    entries = np.flatnonzero(earned)
    sizes = [host.num_states] if host.is_chain else [host.num_states, host.num_rows]
    if not storm:
        yield (" ".join(map(str, [*sizes, entries.size])) + "\n").encode()
    columns_of = _entry_columns(model)
    form = "%d " * (len(sizes) + 1) + "%r\n"
    for begin in range(0, entries.size, _STEP):
        part = entries[begin : begin + _STEP]
        yield _infinity(joined_lines(form, *columns_of(part), earned[part].tolist()), storm)


def _infinity(lines: bytes, storm: bool) -> bytes:
    return lines if storm else lines.replace(b"inf", b"Infinity")
