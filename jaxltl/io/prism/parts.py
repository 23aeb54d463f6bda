"""Reader of labels, state variables and rewards in PRISM's explicit files."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.models.sparse import Rewards, SparseMDP
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.io.tokens import (
    Block,
    Text,
    as_double,
    bytes_of,
    decoded,
    label_matrix,
    numbered,
    refuse,
    split_init,
    truncated,
)

_REWARD_NAME = re.compile(rb'^#[ \t]*Reward structure[ \t]+"([^"\n]*)"', re.MULTILINE)
_LABEL = re.compile(rb'\s*(\d+)\s*=\s*"([^"]*)"')

Section = tuple[str, str, Text]  # "tra", "lab", "sta", "srew" or "trew"; of which reward; the text


def read_labels(
    sections: list[Section], num_states: int
) -> tuple[Booleans, tuple[str, ...], Floats]:
    """Label matrix ``bool[S, P]``, label names and the initial distribution."""
    text = next((text for kind, _, text in sections if kind == "lab"), None)
    if text is None:
        return np.zeros((num_states, 0), bool), (), np.eye(1, num_states)[0]
    if text.data.startswith(b"#DECLARATION", text.begin):
        holds, names = _storm_labels(text, num_states)
    else:
        holds, names = _prism_labels(text, num_states)
    if "init" not in names:
        return holds, tuple(names), np.eye(1, num_states)[0]
    return split_init(text, holds, names)


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
    kept = np.ones(size, bool)
    kept[tokens] = False
    return np.flatnonzero(kept)


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
    text = next((text for kind, _, text in sections if kind == "sta"), None)
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


def _fields(block: Block, width: int) -> list[list[bytes]]:
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


def _values(block: Block, name: str, texts: list[bytes]) -> NDArray:
    """Values of a column as bool, int64 or float64."""
    is_true = np.fromiter((x == b"true" for x in texts), bool, len(texts))
    if (is_true | np.fromiter((x == b"false" for x in texts), bool, len(texts))).all():
        return is_true
    try:
        return np.fromiter(map(_integer, texts), np.int64, len(texts))
    except (ValueError, OverflowError):
        pass
    values = [as_double(x) for x in texts]
    if None in values:
        bad = values.index(None)
        raise block.malformed(
            bad, f"a value of {name!r}: true, false or a number, in all states alike"
        )
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
    parts: dict[str, tuple[str, Text, Rewards]] = {}
    reward_sections = [s for s in sections if s[0] in ("srew", "trew")]
    unnamed = len({number for _, number, text in reward_sections if not _reward_name(text)})
    for kind, number, text in reward_sections:
        name = _reward_name(text)
        key = name or (number if unnamed > 1 else "")
        part = (
            _state_reward(text, model.num_states)
            if kind == "srew"
            else _transition_reward(text, model, is_chain)
        )
        before = parts.get(key)
        if before is None:
            parts[key] = kind, text, part
        elif before[0] == kind:
            raise text.error(
                text.line,
                f"a second reward {name!r} of this kind, beside that of {before[1].name!r}.",
            )
        else:
            states, moves = (part, before[2]) if kind == "srew" else (before[2], part)
            parts[key] = "both", text, replace(moves, state=states.state)
    return {key: part for key, (_, _, part) in parts.items()}


def _reward_name(text: Text) -> str:
    match = _REWARD_NAME.search(text.data, text.begin, min(text.stop, text.begin + 2000))
    return decoded(text, {match[1]: 0})[0] if match else ""


def _reward_lines(text: Text, num_states: int, form: str) -> tuple[int | None, Text]:
    """Announced number of rewards (None for Storm) and the remaining text."""
    first, line, rest = text.first_line(b"#")
    sizes = first.split()
    if not first:
        return 0, rest
    if not sizes[0].isdigit() or len(sizes[0]) > 18 or int(sizes[0]) > num_states:
        raise text.error(
            line,
            f"{first[:60].decode(errors='replace')!r}; expected a number of "
            f"states, here {num_states}, and of rewards, or {form}.",
        )
    if int(sizes[0]) < num_states:
        return None, text
    if not sizes[-1].isdigit() or len(sizes[-1]) > 18 or len(sizes) not in (2, 3):
        raise text.error(
            line,
            f"{first[:60].decode(errors='replace')!r}; expected a number of states and of rewards.",
        )
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
