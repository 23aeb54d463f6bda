"""Header, states, actions and transitions of a DRN file."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray

from jaxltl.io.intervals import intervals, point_rewards, joined_brackets
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.io.tokens import (
    TokenBlock,
    Text,
    decoded,
    label_matrix,
    numbered,
    refuse,
    split_init,
    truncated,
)

Numbers = NDArray[np.generic]  # doubles, or indices of rational functions
Values = Callable[[TokenBlock, Integers], Numbers]  # parser of the tokens of a block

NO_LABEL = b"__NOLABEL__"  # the name of actions that have none
INTERVALS = ("double-interval", "rational-interval")  # types of values
_MODEL = re.compile(rb"^@model[ \t\r]*$", re.MULTILINE)
_LINE = re.compile(
    rb"(?:state|action)\s+\S+?\s*(?:\{\d+\}\s*)?(?:\[([^\[\]]*)\]\s*)?((?:(?<=\s)[^\[\]].*)?)",
    re.DOTALL,
)
_NUMBER = re.compile(rb"0|[1-9]\d{0,8}|1\d{9}")
_LABEL = re.compile(rb'"([^"]+)"|([^\s"]+)')


@dataclass(frozen=True)
class DrnHeader:
    """Header of a DRN file, up to ``@model``."""

    kind: str  # "DTMC", "MDP" or "POMDP"
    value_type: str  # @value_type, or ""
    parameters: tuple[str, ...]  # names of the parameters
    placeholders: dict[bytes, bytes]  # value of each $name
    rewards: list[str]  # names of the rewards; some may be empty
    num_states: int  # num_states, num_choices: announced counts, or None
    num_choices: int | None
    body: Text  # the text after the header


@dataclass
class Body:
    """States, actions and transitions of a DRN file as columns, collected block by block."""

    # state, line: state and line number of each action, int32[R] and int64[R]
    state: list[Integers] = field(default_factory=list)
    line: list[Integers] = field(default_factory=list)
    # row, successor, value: row, successor and probability (or its two bounds) of each transition
    row: list[Integers] = field(default_factory=list)
    successor: list[Integers] = field(default_factory=list)
    value: list[Numbers] = field(default_factory=list)
    # index into `action_names` of each action, int32[R]
    action: list[Integers] = field(default_factory=list)
    action_names: dict[bytes, int] = field(default_factory=dict)
    label_names: dict[bytes, int] = field(default_factory=dict)
    # labelled, label: pairs of states and indices into `label_names`
    labelled: list[Integers] = field(default_factory=list)
    label: list[Integers] = field(default_factory=list)
    rewards: int = 0  # number of rewards per state or action; 0 until the first one is read
    # state_reward, choice_reward: pairs of a first state or action and rewards [n, rewards]
    state_reward: list[tuple[int, Numbers]] = field(default_factory=list)
    choice_reward: list[tuple[int, Numbers]] = field(default_factory=list)
    observation: list[Integers] = field(default_factory=list)  # of each state of a POMDP
    num_states: int = 0  # num_states, num_rows: counts so far
    num_rows: int = 0
    after_action: bool = False  # True if the last line other than a transition was an action


# --- the header -----------------------------------------------------------------------------


def read_header(text: Text) -> DrnHeader:
    """Parses the header, up to ``@model``; ValueError with the line for other model types."""
    model_line = _MODEL.search(text.data)
    if model_line is None:
        refuse(text.name, "it has no line '@model'; expected a model in the DRN format.")
    lines = text.data[: model_line.start()].decode(errors="replace").split("\n")[:-1]
    entries: dict[str, tuple[int, str]] = {}
    placeholders: dict[bytes, bytes] = {}
    i = 0
    while i < len(lines):
        line, number = lines[i].strip(), i + 1
        i += 1
        if not line or line.startswith("//"):
            continue
        key, colon, value = line.partition(":")
        if key in entries or (key == "@placeholders" and placeholders):
            raise text.error(number, f"{key} is given twice.")
        if key in ("@type", "@value_type") and colon:
            entries[key] = number, value.strip()
        elif line in ("@parameters", "@reward_models", "@nr_states", "@nr_choices"):
            entries[line] = number + 1, lines[i].strip("\r") if i < len(lines) else ""
            i += 1
        elif line == "@placeholders":
            while i < len(lines) and not lines[i].startswith("@"):
                _placeholder(text, i + 1, lines[i].strip(), placeholders)
                i += 1
        else:
            raise text.error(
                number,
                f"{line[:60]!r}; expected @type, @value_type, @parameters, "
                "@placeholders, @reward_models, @nr_states or @nr_choices.",
            )
    at = text.data.count(b"\n", 0, model_line.end()) + 1
    stop = text.data.find(b"\n", model_line.end()) + 1 or text.stop
    body = Text(text.name, text.data, stop, text.stop, at + 1)
    num_states = _count(text, entries, "@nr_states")
    if num_states is None:
        raise text.error(at, "expected the number of states, '@nr_states', before '@model'.")
    return DrnHeader(
        _kind(text, entries, at),
        _value_type(text, entries),
        tuple(entries.get("@parameters", (0, ""))[1].split()),
        placeholders,
        re.split("[ \t]", entries["@reward_models"][1]) if "@reward_models" in entries else [],
        num_states,
        _count(text, entries, "@nr_choices"),
        body,
    )


def _placeholder(text: Text, line: int, entry: str, placeholders: dict[bytes, bytes]) -> None:
    if not entry or entry.startswith("//"):
        return
    name, colon, value = (x.strip().encode() for x in entry.partition(":"))
    if not colon or not value or name[:1] != b"$" or name in placeholders:
        raise text.error(line, f"{entry[:60]!r}; expected '$name : value', each name once.")
    placeholders[name] = value


def _kind(text: Text, entries: dict[str, tuple[int, str]], line: int) -> str:
    if "@type" not in entries:
        raise text.error(line, "expected a line '@type: MDP' or '@type: DTMC' before '@model'.")
    line, kind = entries["@type"]
    if kind.upper() not in ("DTMC", "MDP", "POMDP"):
        raise text.error(
            line, f"a model of type {kind[:60]!r} is not supported; expected DTMC, MDP or POMDP."
        )
    return kind.upper()


def _value_type(text: Text, entries: dict[str, tuple[int, str]]) -> str:
    line, value_type = entries.get("@value_type", (0, ""))
    if value_type not in ("", "double", "rational", "parametric", *INTERVALS):
        raise text.error(
            line,
            f"the value type is {value_type[:60]!r}; expected double, rational, {' or '.join(INTERVALS)}"
            ", or parametric.",
        )
    return value_type


def _count(text: Text, entries: dict[str, tuple[int, str]], key: str) -> int | None:
    if key not in entries:
        return None
    line, digits = entries[key][0], entries[key][1].strip()
    if not re.fullmatch("[0-9]{1,18}", digits) or not 0 < int(digits) < 2**31 - 1:
        raise text.error(line, f"{digits[:60]!r}; expected a number from 1 to {2**31 - 2}.")
    return int(digits)


# --- the body -------------------------------------------------------------------------------


def read_body(header: DrnHeader, probabilities: Values, numbers: Values) -> Body:
    """Parses states, actions and transitions, with number parsers for probabilities and rewards."""
    body, text = Body(), header.body
    is_interval = header.value_type in INTERVALS
    for block in (point_rewards(text) if is_interval else text).blocks(b"//"):
        at = block.first[:-1]
        is_state, is_action = _begins(block, at, b"state"), _begins(block, at, b"action")
        if header.kind == "POMDP":
            block = _read_observations(block, body, np.flatnonzero(is_state), header.num_states)
            at = block.first[:-1]
        if is_interval:
            block = joined_brackets(block, 2, ~is_state & ~is_action)
            at = block.first[:-1]
        order = _order(block, body, is_state, is_action)
        state = body.num_states - 1 + np.cumsum(is_state)
        row = body.num_rows - 1 + np.cumsum(is_action)
        _read_states(header, block, body, np.flatnonzero(is_state), numbers)
        _read_actions(block, body, np.flatnonzero(is_action), state, numbers)
        entry = np.flatnonzero(~is_state & ~is_action)
        if entry.size:
            first, valid = at[entry], block.count[entry] == 3
            colon = np.minimum(first + 1, block.start.size - 1)
            valid &= block.end[colon] == block.start[colon] + 1
            valid &= block.data[block.start[colon]] == ord(":")
            block.require_form(valid, "'successor : probability'", entry)
            body.successor.append(block.integers(first, "a state", header.num_states))
            body.value.append(
                np.stack(intervals(block, first + 2), 1)
                if is_interval
                else probabilities(block, first + 2)
            )
            body.row.append(row[entry].astype(np.int32))
        body.num_states, body.num_rows = int(state[-1]) + 1, int(row[-1]) + 1
        if order[-1] >= 0:
            body.after_action = bool(is_action[order[-1]])
    _check_counts(header, body)
    return body


def _read_observations(
    block: TokenBlock, body: Body, lines: Integers, num_states: int
) -> TokenBlock:
    """Reads the observations of states, ``{3}``; returns the block without these tokens."""
    token = np.minimum(block.first[:-1][lines] + 2, block.start.size - 1)
    start, end = block.start.copy(), block.end.copy()
    valid = (block.count[lines] >= 3) & (block.data[start[token]] == ord("{"))
    valid &= block.data[end[token] - 1] == ord("}")
    block.require_form(valid, "'state number {observation}'", lines)
    start[token] += 1
    end[token] -= 1
    inner = replace(block, start=start, end=end)
    body.observation.append(inner.integers(token, "an observation", num_states))
    removed = np.zeros(block.num_lines + 1, np.int64)
    removed[lines + 1] = 1
    kept = np.delete(np.arange(start.size), token)
    first = block.first - np.cumsum(removed)
    return replace(block, start=block.start[kept], end=block.end[kept], first=first)


def _begins(block: TokenBlock, at: Integers, word: bytes) -> Booleans:
    """Mask of the tokens that equal a word."""
    matches = block.end[at] - block.start[at] == len(word)
    for i, letter in enumerate(word):
        matches[matches] = block.data[block.start[at[matches]] + i] == letter
    return matches


def _order(block: TokenBlock, body: Body, is_state: Booleans, is_action: Booleans) -> Integers:
    """Index of the last state or action line up to each line of the block, or -1."""
    last = np.maximum.accumulate(np.where(is_state | is_action, np.arange(is_state.size), -1))
    within = np.where(last >= 0, is_action[last], body.after_action)
    block.require_form(is_state | is_action | within, "'state number' or 'action name' before it")
    block.require_form(
        ~is_action | (body.num_states + np.cumsum(is_state) > 0), "'state 0' before it"
    )
    return last


def _read_states(
    header: DrnHeader, block: TokenBlock, body: Body, lines: Integers, numbers: Values
) -> None:
    if not lines.size:
        return
    at, form = block.first[:-1][lines], "'state number [reward, reward] label label'"
    block.require_form(block.count[lines] >= 2, form, lines)
    state = block.integers(at + 1, "the number of a state", header.num_states)
    wrong = state != body.num_states + np.arange(lines.size)
    if wrong.any():
        i = int(wrong.argmax())
        raise block.error(int(at[i]) + 1, f"state {body.num_states + i}")
    reward, label, rest = _rewards(block, body, lines, numbers, form)
    if reward is not None:
        body.state_reward.append((body.num_states, reward))
    # Labels without quotation marks are tokens; quoted ones are parsed from their lines.
    count = np.maximum(block.count[lines] - (label - at), 0)
    for i in rest:
        count[i] = 0
    token = np.repeat(label - np.cumsum(count) + count, count) + np.arange(int(count.sum()))
    names, owners = block.texts(token), [np.repeat(state, count)]
    for i, labels in rest.items():
        pairs = _LABEL.findall(labels)
        if _LABEL.sub(b"", labels).strip():
            raise block.malformed(int(lines[i]), form)
        names += [quoted or plain for quoted, plain in pairs]
        owners.append(np.full(len(pairs), state[i]))
    body.label.append(numbered(names, body.label_names))
    body.labelled.append(np.concatenate(owners))


def _read_actions(
    block: TokenBlock, body: Body, lines: Integers, state: Integers, numbers: Values
) -> None:
    if not lines.size:
        return
    at, form = block.first[:-1][lines], "'action name [reward, reward]'"
    block.require_form(block.count[lines] >= 2, form, lines)
    body.action.append(numbered(block.texts(at + 1), body.action_names))
    body.state.append(state[lines].astype(np.int32))
    body.line.append(block.line[lines])
    reward, after, rest = _rewards(block, body, lines, numbers, form)
    if reward is not None:
        body.choice_reward.append((body.num_rows, reward))
    valid = at + block.count[lines] <= after
    for i, more in rest.items():
        valid[i] = not more
    block.require_form(valid, form, lines)


def _rewards(
    block: TokenBlock, body: Body, lines: Integers, numbers: Values, form: str
) -> tuple[Numbers | None, Integers, dict[int, bytes]]:
    """Rewards ``[n, rewards]`` or None, next token index, and the rest of irregular lines."""
    at, count = block.first[:-1][lines], block.count[lines]
    third = np.minimum(at + 2, block.start.size - 1)
    has = (count > 2) & (block.data[block.start[third]] == ord("["))
    quotes = np.searchsorted(block.start, np.flatnonzero(block.data == ord('"')), "right") - 1
    odd = np.zeros(block.num_lines, bool)
    odd[np.searchsorted(block.first, quotes, "right") - 1] = True
    odd = odd[lines]
    if has.any() and not body.rewards:
        match = _LINE.fullmatch(block.whole(int(lines[int(has.argmax())])))
        if match is None or match[1] is None:
            raise block.malformed(int(lines[int(has.argmax())]), form)
        body.rewards = match[1].count(b",") + 1
    if body.rewards * lines.size > 8 * len(block.text.data) + 2**24:
        raise block.text.error(
            int(block.line[lines[0]]),
            f"{body.rewards} rewards are announced before, more than this file can hold.",
        )
    width = body.rewards
    odd |= has & (count < 2 + width)
    start, end = block.start.copy(), block.end.copy()
    plain = np.flatnonzero(has & ~odd)
    token = at[plain][:, None] + 2 + np.arange(width)
    if plain.size:
        sign = block.data[end[token] - 1]
        wrong = (sign[:, :-1] != ord(",")).any(1) | (sign[:, -1] != ord("]"))
        odd[plain[wrong]] = True
        plain, token = plain[~wrong], token[~wrong]
        start[token[:, 0]] += 1
        end[token] -= 1
    reward = None
    if has.any():
        values = numbers(replace(block, start=start, end=end), token.ravel())
        reward = np.zeros((lines.size, width), values.dtype)
        reward[plain] = values.reshape(token.shape)
    rest: dict[int, bytes] = {}
    for i in np.flatnonzero(odd).tolist():
        part, rest[i] = _odd_line(block, int(lines[i]), width, form)
        if part is not None and reward is not None:
            reward[i] = numbers(part, np.arange(width))
    return reward, at + 2 + np.where(has, width, 0), rest


def _odd_line(
    block: TokenBlock, line: int, width: int, form: str
) -> tuple[TokenBlock | None, bytes]:
    """Parses the rewards of one irregular line; returns them (or None) and the rest of the line."""
    match = _LINE.fullmatch(block.whole(line))
    if match is None:
        raise block.malformed(line, form)
    if match[1] is None:
        return None, match[2]
    texts = [x.strip() for x in match[1].split(b",")]
    if len(texts) != width or not all(texts) or any(b" " in x for x in texts):
        raise block.malformed(line, f"{form} with {width} rewards")
    data = np.frombuffer(b" ".join(texts) + b" ", np.uint8)
    length = np.array([len(x) for x in texts])
    end = np.cumsum(length + 1) - 1
    first, number = np.array([0, width]), block.line[line : line + 1]
    return TokenBlock(block.text, data, end - length, end, first, number), match[2]


def _check_counts(header: DrnHeader, body: Body) -> None:
    name = header.body.name
    if body.num_states != header.num_states:
        refuse(name, truncated(header.num_states, body.num_states, "states"))
    if header.num_choices is not None and body.num_rows != header.num_choices:
        refuse(name, truncated(header.num_choices, body.num_rows, "choices"))
    state = np.concatenate(body.state) if body.state else np.zeros(0, np.int32)
    count = np.bincount(state, minlength=body.num_states)
    if not count.all():
        refuse(
            name,
            f"state {int(count.argmin())} has no action; give it one, for example a loop "
            "to itself.",
        )
    lines = np.concatenate(body.line)
    if header.kind == "DTMC" and (count > 1).any():
        second = int(np.searchsorted(state, int((count > 1).argmax()))) + 1
        raise header.body.error(
            int(lines[second]),
            f"a second action of state {state[second]}; a DTMC has one in each state.",
        )
    row = np.concatenate(body.row) if body.row else np.zeros(0, np.int32)
    width = np.bincount(row, minlength=body.num_rows)
    if not width.all():
        raise header.body.error(
            int(lines[int(width.argmin())]),
            "this action leads nowhere; expected a successor after it.",
        )


# --- what the columns say -------------------------------------------------------------------


class Names(TypedDict):
    """Labels, action names and initial distribution, as arguments of ``make_sparse``."""

    initial: Floats
    label: Booleans
    propositions: tuple[str, ...]
    action: Integers | None
    action_names: tuple[str, ...]
    valuation: NotRequired[dict[str, NDArray[np.generic]]]


def names_of(header: DrnHeader, body: Body) -> Names:
    """Labels, initial states and names of actions of a DRN file."""
    text = header.body
    holds = label_matrix(text, body.num_states, len(body.label_names))
    for state, column in zip(body.labelled, body.label, strict=True):
        holds[state, column] = True
    label, propositions, initial = split_init(text, holds, decoded(text, body.label_names))
    action, action_names = _actions(text, body)
    return Names(
        initial=initial,
        label=label,
        propositions=propositions,
        action=action,
        action_names=action_names,
    )


def _actions(text: Text, body: Body) -> tuple[Integers | None, tuple[str, ...]]:
    action = np.concatenate(body.action)
    if list(body.action_names) == [NO_LABEL]:
        return None, ()
    if all(_NUMBER.fullmatch(name) for name in body.action_names):
        return np.array([int(name) for name in body.action_names])[action], ()
    names = decoded(text, body.action_names)
    return action, tuple("" if name == NO_LABEL.decode() else name for name in names)


def rewards_of(header: DrnHeader, body: Body) -> Iterator[tuple[str, Numbers, Numbers]]:
    """Yields the name, state rewards ``[S]`` and choice rewards ``[R]`` (or empty arrays)."""
    text, width = header.body, body.rewards
    if width * (body.num_states + body.num_rows) > 8 * len(text.data) + 2**24:
        refuse(
            text.name,
            f"{width} rewards of {body.num_states} states are more than the file can hold.",
        )
    announced = header.rewards if width else [x for x in header.rewards if x]
    names = [
        announced[i] if i < len(announced) else f"rew{i}" for i in range(width or len(announced))
    ]
    seen: set[str] = set()
    for i, name in enumerate(names):
        if name in seen:
            refuse(text.name, f"two rewards are called {name!r}; rename one.")
        seen.add(name)
        yield (
            name,
            _gathered(body.state_reward, body.num_states, i),
            _gathered(body.choice_reward, body.num_rows, i),
        )


def _gathered(parts: list[tuple[int, Numbers]], size: int, column: int) -> Numbers:
    column_values = np.zeros(size if parts else 0, parts[0][1].dtype if parts else None)
    for begin, part in parts:
        column_values[begin : begin + len(part)] = part[:, column]
    return column_values
