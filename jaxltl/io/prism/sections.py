"""Sections of PRISM's explicit files: labels, states, rewards, and the writer of all."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.models import IntervalMDP, Rewards, SparseMDP
from jaxltl.io.text_output import check_name, exact_part, labels_with_init, value_texts
from jaxltl.io.tokens import (
    TokenBlock,
    Text,
    as_double,
    bytes_of,
    decoded,
    joined_lines,
    label_matrix,
    numbered,
    refuse,
    split_init,
    truncated,
)

_REWARD_NAME = re.compile(rb'^#[ \t]*Reward structure[ \t]+"([^"\n]*)"', re.MULTILINE)
_LABEL = re.compile(rb'\s*(\d+)\s*=\s*"([^"]*)"')

Section = tuple[str, str, Text]  # "tra", "lab", "sta", "srew" or "trew"; of which reward; the text


def _section(sections: list[Section], kind: str) -> Text | None:
    return next((text for other, _, text in sections if other == kind), None)


def read_labels(
    sections: list[Section], num_states: int
) -> tuple[Booleans, tuple[str, ...], Floats]:
    """Label matrix ``bool[S, P]``, label names and the initial distribution."""
    text = _section(sections, "lab")
    holds, names = np.zeros((num_states, 0), bool), list[str]()
    if text is not None:
        storm = text.data.startswith(b"#DECLARATION", text.begin)
        holds, names = (_storm_labels if storm else _prism_labels)(text, num_states)
        if "init" in names:
            return split_init(text, holds, names)
    return holds, tuple(names), np.eye(1, num_states)[0]


def _prism_labels(text: Text, num_states: int) -> tuple[Booleans, list[str]]:
    first, line, rest = text.first_line(b"#")
    form = '\'0="init" 1="name"\', the labels numbered from 0'
    names: dict[bytes, int] = {}
    place = 0
    while place < len(first.rstrip()):
        match = _LABEL.match(first, place)
        if match is None or match[1] != b"%d" % len(names) or match[2] in names:
            actual = first[place : place + 60].strip().decode(errors="replace")
            raise text.error(line, f"{actual!r}; expected {form}.")
        names[match[2]] = len(names)
        place = match.end()
    holds = label_matrix(text, num_states, len(names))
    for block in rest.blocks(b"#"):
        end, at = block.end.copy(), block.first[:-1]
        end[at] -= 1  # the colon
        valid = (block.data[end[at]] == ord(":")) & (end[at] > block.start[at])
        block.require_form(valid, "'state: label label', by their numbers")
        block = replace(block, end=end)
        state = np.repeat(block.integers(at, "a state", num_states), block.count - 1)
        column = block.integers(_without(at, end.size), "the number of a label", len(names))
        holds[state, column] = True
    return holds, decoded(text, names)


def _without(tokens: Integers, size: int) -> Integers:
    """Indices of all other tokens."""
    mask = np.ones(size, bool)
    mask[tokens] = False
    return np.flatnonzero(mask)


def _storm_labels(text: Text, num_states: int) -> tuple[Booleans, list[str]]:
    stop = text.data.find(b"#END", text.begin, text.stop)
    if stop < 0:
        raise text.error(text.line, "the labels after '#DECLARATION' do not end; expected '#END'.")
    declared = text.data[text.begin : stop].split()[1:]
    names = {name: i for i, name in enumerate(declared)}
    if len(names) < len(declared):
        raise text.error(text.line, "a label is declared twice.")
    holds = label_matrix(text, num_states, len(names))
    line = text.line + text.data.count(b"\n", text.begin, stop)
    end = text.data.find(b"\n", stop, text.stop) + 1 or text.stop
    for block in Text(text.name, text.data, end, text.stop, line + 1).blocks(b"#"):
        at = block.first[:-1]
        state = np.repeat(block.integers(at, "a state", num_states), block.count - 1)
        labels = _without(at, block.end.size)
        column = numbered(block.texts(labels), names)
        if len(names) > len(declared):
            bad = int((column >= len(declared)).argmax())
            raise block.error(int(labels[bad]), "a label that is declared")
        holds[state, column] = True
    return holds, decoded(text, names)


def read_valuation(sections: list[Section], num_states: int) -> dict[str, NDArray]:
    """Values of the state variables, ``[S]`` each: bool, int64 or float64."""
    text = _section(sections, "sta")
    if text is None:
        return {}
    first, line, rest = text.first_line(b"#")
    header = [name.strip() for name in first[1:-1].split(b",")]
    if first[:1] != b"(" or first[-1:] != b")" or not all(header) or len(set(header)) < len(header):
        raise text.error(
            line,
            f"{first[:60].decode(errors='replace')!r}; expected the names of "
            "variables, '(x,y)', each once.",
        )
    names = decoded(text, dict.fromkeys(header, 0))
    columns_of: list[list[NDArray]] = [[] for _ in names]
    count = 0
    for block in rest.blocks(b"#"):
        columns = _fields(block, len(names))
        state = np.fromiter(map(int, columns[0]), np.int64, len(columns[0]))
        wrong = state != np.arange(count, count + state.size)
        if wrong.any():
            raise block.malformed(int(wrong.argmax()), f"state {count + int(wrong.argmax())}")
        count += state.size
        for name, part, column in zip(names, columns_of, columns[1:], strict=True):
            part.append(_values(block, name, column))
    if count != num_states:
        refuse(text.name, f"it has {count} states; expected {num_states}, as in the transitions.")
    for name, parts in zip(names, columns_of, strict=True):
        if len({part.dtype == bool for part in parts}) > 1:
            refuse(text.name, f"the variable {name!r} has truth values and numbers.")
    return {name: np.concatenate(parts) for name, parts in zip(names, columns_of, strict=True)}


def _fields(block: TokenBlock, width: int) -> list[list[bytes]]:
    """Columns of lines such as ``0:(1,true)``: the state and `width` values."""
    block.columns(1, 0, form := "'state:(value,value)' without blanks")
    joined = block.joined(block.first[:-1])
    sign = np.flatnonzero(_SIGN[joined])
    fits = joined[sign].tobytes() == (b":(" + b"," * (width - 1) + b") ") * block.num_lines
    if fits:
        fits = bool((np.diff(sign.reshape(-1, width + 3))[:, [0, -1]] == 1).all())
    fields = joined.tobytes().translate(_TO_BLANKS).split()
    states = fields[:: width + 1]
    if (
        not fits
        or len(fields) != block.num_lines * (width + 1)
        or not all(x.isdigit() and len(x) < 19 for x in states)
    ):
        good = re.compile(rb"\d{1,18}:\([^,():]+" + rb",[^,():]+" * (width - 1) + rb"\)")
        bad = next(i for i in range(block.num_lines) if not good.fullmatch(block.whole(i)))
        raise block.malformed(bad, form)
    return [fields[i :: width + 1] for i in range(width + 1)]


def _values(block: TokenBlock, name: str, texts: list[bytes]) -> NDArray:
    """Values of a column as bool, int64 or float64."""
    if set(texts) <= {b"true", b"false"}:
        return np.fromiter((x == b"true" for x in texts), bool, len(texts))
    try:
        return np.fromiter(map(_integer, texts), np.int64, len(texts))
    except (ValueError, OverflowError):
        pass
    values = [as_double(x) for x in texts]
    if None in values:
        form = f"a value of {name!r}: true, false or a number, in all states alike"
        raise block.malformed(values.index(None), form)
    return np.array(values, np.float64)


def _integer(text: bytes) -> int:
    if not text.lstrip(b"-").isdigit():
        raise ValueError
    return int(text)


_SIGN = bytes_of(b":(), ")
_TO_BLANKS = bytes.maketrans(b":(),", b"    ")


# --- rewards --------------------------------------------------------------------------------


def read_rewards(sections: list[Section], model: SparseMDP, is_chain: bool) -> dict[str, Rewards]:
    """Reward structures of a model by name, from its ``srew`` and ``trew`` sections."""
    sections_by_name: dict[str, dict[str, tuple[Text, Rewards]]] = {}
    reward_sections = [s for s in sections if s[0] in ("srew", "trew")]
    unnamed = len({number for _, number, text in reward_sections if not _reward_name(text)})
    for kind, number, text in reward_sections:
        name = _reward_name(text)
        parts = sections_by_name.setdefault(name or (number if unnamed > 1 else ""), {})
        if kind in parts:
            raise text.error(
                text.line,
                f"a second reward {name!r} of this kind, beside that of {parts[kind][0].name!r}.",
            )
        if kind == "srew":
            parts[kind] = text, _state_reward(text, model.num_states)
        else:
            parts[kind] = text, _transition_reward(text, model, is_chain)
    return {
        key: replace(
            parts["trew"][1] if "trew" in parts else Rewards(),
            state=parts["srew"][1].state if "srew" in parts else None,
        )
        for key, parts in sections_by_name.items()
    }


def _reward_name(text: Text) -> str:
    match = _REWARD_NAME.search(text.data, text.begin, min(text.stop, text.begin + 2000))
    return decoded(text, {match[1]: 0})[0] if match else ""


def _reward_lines(text: Text, num_states: int, form: str) -> tuple[int | None, Text]:
    """Announced number of rewards (None for Storm) and the remaining text."""
    first, line, rest = text.first_line(b"#")
    sizes = first.split()
    if not first:
        return 0, rest
    quoted = repr(first[:60].decode(errors="replace"))
    if not sizes[0].isdigit() or len(sizes[0]) > 18 or int(sizes[0]) > num_states:
        raise text.error(
            line,
            f"{quoted}; expected a number of states, here {num_states}, and of rewards, or {form}.",
        )
    if int(sizes[0]) < num_states:
        return None, text
    if not sizes[-1].isdigit() or len(sizes[-1]) > 18 or len(sizes) not in (2, 3):
        raise text.error(line, f"{quoted}; expected a number of states and of rewards.")
    return int(sizes[-1]), rest


def _state_reward(text: Text, num_states: int) -> Rewards:
    form = "'state reward'"
    announced, rest = _reward_lines(text, num_states, form)
    reward, count = np.zeros(num_states), 0
    for block in rest.blocks(b"#"):
        at = block.columns(2, 0, form)
        reward[block.integers(at, "a state", num_states)] = block.floats(at + 1, "a reward")
        count += at.size
    _check_announced(text, announced, count)
    return Rewards(state=reward) if count else Rewards()


def _check_announced(text: Text, announced: int | None, count: int) -> None:
    if announced is not None and announced != count:
        refuse(text.name, f"from line {text.line} on {truncated(announced, count, 'rewards')}")


def _transition_reward(text: Text, model: SparseMDP, is_chain: bool) -> Rewards:
    width, form = (
        (3, "'state successor reward'") if is_chain else (4, "'state choice successor reward'")
    )
    announced, rest = _reward_lines(text, model.num_states, form)
    host = model.host
    place = host.row.astype(np.int64) * host.num_states + host.successor
    rewards, count = np.zeros(host.num_transitions), 0
    for block in rest.blocks(b"#"):
        at = block.columns(width, 0, form)
        state = block.integers(at, "a state", host.num_states)
        row = host.row_start[state].astype(np.int64)
        if not is_chain:
            row += block.integers(at + 1, "the number of a choice")
        sought = row * host.num_states + block.integers(at + width - 2, "a state", host.num_states)
        entry = np.minimum(np.searchsorted(place, sought), place.size - 1)
        valid = (place[entry] == sought) & (row < host.row_start[state + 1])
        block.require_form(valid, f"{form} of a transition that exists")
        rewards[entry] = block.floats(at + width - 1, "a reward")
        count += at.size
    _check_announced(text, announced, count)
    if not count:
        return Rewards()
    choice = rewards[host.entry_start[:-1]]
    if (rewards == choice[host.row]).all():
        return Rewards(choice=choice)
    return Rewards(transition=rewards)


# --- writing ---------------------------------------------------------------------------------


_STEP = 2**17  # lines per piece


@dataclass(frozen=True)
class WrittenSection:
    """A section of an explicit file to be written."""

    kind: str  # "tra", "lab", "sta", "srew" or "trew"
    number: str  # number of the reward if there are several
    header: list[bytes]  # lines that introduce the section in a single file
    lines: Callable[[], Iterator[bytes]]  # generator of the lines, in pieces


def written_sections(source: SparseMDP | IntervalMDP, dialect: str) -> list[WrittenSection]:
    """Sections of a model's files, in order; ValueError if the format cannot represent it."""
    storm, model = dialect == "storm", exact_part(source)
    chances = value_texts(source, ",")
    if storm and model is not source:
        raise ValueError(
            "Storm reads no intervals in explicit files; write PRISM's (dialect='prism'), or UMB "
            "or DRN."
        )
    masks = labels_with_init(model)
    labels, holds = _plain(tuple(masks), "label", ' "' if storm else '"'), list(masks.values())
    title = ("" if model is source else "I") + ("DTMC" if model.is_chain else "MDP")
    kind = f"# Transitions ({title})\n".encode()
    action = (
        None if storm and model.is_chain else _action_texts(model)
    )  # Storm reads no actions of chains
    sections = [
        WrittenSection("tra", "", [kind], lambda: _transitions(model, chances, action, storm))
    ]
    if model.valuation and not storm:
        values = [_value_texts(name, x) for name, x in model.valuation.items()]
        names = _plain(model.valuation, "variable", ' "(),')
        sections.append(WrittenSection("sta", "", [b"# States\n"], lambda: _states(names, values)))
    sections.append(
        WrittenSection("lab", "", [b"# Labels\n"], lambda: _label_lines(labels, holds, storm))
    )
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
) -> Iterator[WrittenSection]:
    title = f'# Reward structure "{name}"\n' if name else "# Reward structure\n"
    earned = _on_entries(model, reward)
    if reward.state is not None or earned is None:
        none = np.zeros(model.num_states)
        state = none if reward.state is None else np.asarray(reward.state, np.float64)
        header = [title.encode(), b"# State rewards\n"]
        yield WrittenSection(
            "srew",
            number,
            header,
            lambda: _nonzero(state, [state.size], lambda part: [part.tolist()], storm),
        )
    if earned is not None:
        header = [title.encode(), b"# Transition rewards\n"]
        sizes = [model.num_states] if model.is_chain else [model.num_states, model.num_rows]
        yield WrittenSection(
            "trew", number, header, lambda: _nonzero(earned, sizes, _entry_columns(model), storm)
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


def _nonzero(
    reward: Floats, sizes: list[int], columns: Callable[[Integers], list[list[int]]], storm: bool
) -> Iterator[bytes]:
    """Lines of the numbers that are not zero, after columns of their places."""
    place = np.flatnonzero(reward)
    if not storm:
        yield (" ".join(map(str, [*sizes, place.size])) + "\n").encode()
    for begin in range(0, place.size, _STEP):
        part = place[begin : begin + _STEP]
        before = columns(part)
        lines = joined_lines("%d " * len(before) + "%r\n", *before, reward[part].tolist())
        yield lines if storm else lines.replace(b"inf", b"Infinity")
