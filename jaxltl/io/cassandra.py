"""POMDPs in Cassandra's text format (``.pomdp``), as of pomdp-solve and many benchmark collections.

The observation of this format is drawn after each step, with probability ``O(o | a, s')``; that of a
:class:`~jaxltl.core.models.pomdp.POMDP` is a function of the state. A model that is read therefore has the
states (s', o) of a state and the observation with which it was entered:

    P((s', o) | (s, .), a) = T(s' | s, a) O(o | a, s').

Before the first step there is no observation: the initial states have an additional observation, unless all
states of the initial belief have one and the same observation, which is then no information.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.models import POMDP, Rewards, make_pomdp, make_sparse
from jaxltl.core.models.exact_numbers import decimal_numbers
from jaxltl.core.models.number_source import NumberSource
from jaxltl.core.models.sparse import choice_reward
from jaxltl.core.sparse.rows import offsets_from_counts, row_entries
from jaxltl.core.validation import Range, errors_in, require_in_range
from jaxltl.io.files import read_text, write_bytes
from jaxltl.io.tokens import as_double, refuse

_TOKEN = re.compile(r":|[^\s:]+")
_NAME = re.compile(r"[A-Za-z][\w-]*", re.ASCII)
_KINDS = ("states", "actions", "observations")
_STATEMENTS = ("discount", "values", *_KINDS, "start", "T", "O", "R")
_RESERVED = {*_STATEMENTS, "include", "exclude", "uniform", "identity", "reset", "reward", "cost"}
_SUM = 1e-4  # admitted deviation of a row's sum from one; published files round to few digits
_LARGEST = 10_000_000  # entries of all rows, which bounds memory
_LABELS = 2**26  # entries of the labels of named states, beyond which there are none


class DiscountedPOMDP(NamedTuple):
    """A POMDP and the discount of its file.

    Attributes:
      pomdp: the model; its reward is named ``reward`` or ``cost``.
      discount: from 0 to 1.

    >>> DiscountedPOMDP(None, 0.95).discount
    0.95
    """

    pomdp: POMDP
    discount: float


class _Statement(NamedTuple):
    keyword: str
    fields: list[str]  # after a colon each, ``: action : state``
    data: list[str]
    line: int


_Rows = dict[tuple[int, int], dict[int, float]]  # entries of each row


@dataclass
class _PomdpText:
    """The statements of a file, interpreted one by one."""

    name: str
    names: dict[str, dict[str, int]] = field(default_factory=dict)  # numbers of states, ... by name
    discount: float | None = None
    reward: str = "reward"
    start: Floats | None = None
    transition: _Rows = field(default_factory=dict)  # by (action, state)
    sensor: _Rows = field(default_factory=dict)  # by (action, state entered)
    resets: set[tuple[int, int]] = field(default_factory=set)  # rows that are the initial belief
    rules: list[tuple[Sequence[int], float]] = field(default_factory=list)  # of rewards, last wins
    line_of_row: dict[tuple[str, int, int], int] = field(default_factory=dict)
    num_entries: int = 0

    def error(self, line: int, message: str) -> NoReturn:
        raise ValueError(f"{self.name!r}, line {line}: {message}")

    def count(self, kind: str) -> int:
        return len(self.names[kind])

    def number(self, token: str, line: int) -> float:
        value = as_double(token.encode())
        if value is None or not np.isfinite(value):
            self.error(line, f"{token[:60]!r} stands where a number is expected.")
        return value

    def index(self, kind: str, token: str, line: int) -> int:
        """Number of a state, an action or an observation; -1 of ``*``."""
        if token == "*":
            return -1
        names = self.names[kind]
        if token in names:
            return names[token]
        if not (token.isdecimal() and int(token) < len(names)):
            self.error(line, f"{token[:60]!r} is none of the {len(names)} {kind}.")
        return int(token)

    def complete_preamble(self, line: int) -> None:
        for kind in _KINDS:
            if kind not in self.names:
                self.error(line, f"the line '{kind}: ...' is missing before this one.")
        if self.count("states") * self.count("actions") > _LARGEST:
            self.error(line, f"states and actions have more than {_LARGEST} pairs.")

    def numbers(self, statement: _Statement, shape: tuple[int, int]) -> NDArray[np.float64]:
        """The numbers of a matrix or of a row, ``float64[shape]``."""
        data, line = statement.data, statement.line
        if len(data) != shape[0] * shape[1]:
            self.error(
                line,
                f"{statement.keyword} has {len(data)} numbers; expected "
                f"{shape[0]} rows of {shape[1]}.",
            )
        return np.array([self.number(x, line) for x in data]).reshape(shape)


def read_cassandra(path: str | os.PathLike[str]) -> DiscountedPOMDP:
    """POMDP of a file in Cassandra's format, and its discount.

    States are pairs of a state of the file and an observation (see the module); all actions are
    available. The variable ``state`` has the number in the file, named states are labels too, and the
    observable ``observation`` has the name or number of the observation, ``""`` or -1 of the initial one.
    Values are the reward ``reward``, or ``cost`` after ``values: cost``. Later statements replace earlier
    ones; ``reset`` leads to the initial belief.

    Args:
      path: the file, plain or compressed with gzip or xz.

    Returns:
      :class:`DiscountedPOMDP`.

    Raises:
      ValueError: with the file and, for malformed text or a row that does not sum to 1, the line.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp()) / "coin.pomdp"
      >>> _ = path.write_text("discount: 0.9\\nvalues: reward\\nstates: heads tails\\nactions: flip\\n"
      ...     "observations: clear dim\\nT: * uniform\\nO: flip : heads 0.8 0.2\\nO: flip : tails uniform\\n"
      ...     "R: flip : * : heads : * 1")
      >>> pomdp, discount = read_cassandra(path)
      >>> discount, pomdp.num_states, pomdp.observables["observation"].tolist()
      (0.9, 6, ['clear', 'dim', ''])
    """
    text = read_text(path, "a POMDP in Cassandra's format")
    file = _PomdpText(str(path))
    line = 0
    for statement in _statements(file, text):
        line = statement.line
        _read(file, statement)
    if file.discount is None:
        file.error(line, "the line 'discount: ...' is missing.")
    file.complete_preamble(line)
    return DiscountedPOMDP(_model(file), file.discount)


def _statements(file: _PomdpText, text: str) -> Iterator[_Statement]:
    """Keyword, fields and data of each statement."""
    tokens: list[tuple[str, int]] = []
    for number, content in enumerate(text.split("\n"), 1):
        tokens += [(token, number) for token in _TOKEN.findall(content.partition("#")[0])]
    words = [token for token, _ in tokens]
    begins = [
        i
        for i, word in enumerate(words)
        if word in _STATEMENTS and (i == 0 or words[i - 1] != ":") and _is_header(words, i)
    ]
    if not begins or begins[0] > 0:
        first, line = tokens[0] if tokens else ("", 1)
        file.error(line, f"{first[:60]!r}; expected one of {', '.join(_STATEMENTS)}.")
    for begin, end in zip(begins, [*begins[1:], len(words)], strict=True):
        keyword, line = tokens[begin]
        if keyword == "start" and words[begin + 1] in ("include", "exclude"):
            keyword, begin = f"start {words[begin + 1]}", begin + 1
        place, fields = begin + 1, []
        if keyword not in ("T", "O", "R"):
            place += 1
        while keyword in ("T", "O", "R") and place < end and words[place] == ":":
            if place + 1 == end:
                file.error(tokens[place][1], f"{keyword}: ends after ':'; expected a name.")
            fields.append(words[place + 1])
            place += 2
        data = words[place:end]
        if ":" in data:
            at = place + data.index(":")
            file.error(tokens[at][1], f"':' stands where the data of {keyword} are expected.")
        yield _Statement(keyword, fields, data, line)


def _is_header(words: list[str], i: int) -> bool:
    after = words[i + 1 : i + 3]
    return after[:1] == [":"] or (
        words[i] == "start" and after in (["include", ":"], ["exclude", ":"])
    )


def _read(file: _PomdpText, statement: _Statement) -> None:
    """Interprets a statement."""
    keyword, fields, data, line = statement
    if keyword in ("T", "O", "R", "start", "start include", "start exclude"):
        file.complete_preamble(line)
    if keyword == "discount":
        file.discount = file.number(data[0] if len(data) == 1 else " ".join(data), line)
        if not 0 <= file.discount <= 1:
            file.error(line, f"the discount is {data[0]}; expected a number from 0 to 1.")
    elif keyword == "values":
        if data not in (["reward"], ["cost"]):
            file.error(line, f"values are {' '.join(data)[:60]!r}; expected reward or cost.")
        file.reward = data[0]
    elif keyword in _KINDS:
        _read_names(file, statement)
    elif keyword.startswith("start"):
        _read_start(file, statement)
    elif keyword == "R":
        _read_rewards(file, statement)
    else:
        shape = file.count("states"), file.count("states" if keyword == "T" else "observations")
        if not 1 <= len(fields) <= 3:
            file.error(line, f"{keyword} has {len(fields)} names; expected 1 to 3.")
        kinds = ("actions", "states", "states" if keyword == "T" else "observations")
        index = [file.index(k, x, line) for k, x in zip(kinds, fields, strict=False)]
        _read_rows(file, statement, index, shape)


def _read_names(file: _PomdpText, statement: _Statement) -> None:
    kind, _, data, line = statement
    if kind in file.names:
        file.error(line, f"{kind} are given twice.")
    if len(data) == 1 and data[0].isdecimal():
        if not 0 < int(data[0]) <= _LARGEST:
            file.error(line, f"{data[0][:60]} {kind}; expected 1 to {_LARGEST}.")
        data = [str(i) for i in range(int(data[0]))]
    if not data or len({*data}) < len(data) or "*" in data:
        file.error(line, f"{kind} need a number, or distinct names.")
    file.names[kind] = {name: i for i, name in enumerate(data)}


def _read_start(file: _PomdpText, statement: _Statement) -> None:
    keyword, _, data, line = statement
    size = file.count("states")
    start = np.zeros(size)
    if "*" in data:
        file.error(line, f"'*' stands where a state or a number of {keyword} is expected.")
    if keyword != "start":
        some = [file.index("states", x, line) for x in data]
        start[some] = 1
        start = 1 - start if keyword == "start exclude" else start
        if not start.any():
            file.error(line, f"{keyword} leaves no state.")
    elif data == ["uniform"]:
        start[:] = 1
    elif len(data) == 1 and (size > 1 or data[0] in file.names["states"]):
        start[file.index("states", data[0], line)] = 1
    else:
        start = file.numbers(statement, (1, size))[0]
        if not (start >= 0).all() or abs(start.sum() - 1) > _SUM:
            file.error(line, f"the initial belief sums to {start.sum():g}; expected 1.")
        file.start = start if start.sum() == 1 else start / start.sum()
        return
    file.start = start / start.sum()


def _read_rows(
    file: _PomdpText, statement: _Statement, index: list[int], shape: tuple[int, int]
) -> None:
    """Reads transitions or observations: matrices, rows or single probabilities."""
    keyword, fields, data, line = statement
    table = file.transition if keyword == "T" else file.sensor
    actions = range(file.count("actions")) if index[0] < 0 else (index[0],)
    states = range(shape[0]) if len(index) < 2 or index[1] < 0 else (index[1],)
    rows: Sequence[Mapping[int, float]] | None = None  # of each state, or None for one entry
    word = data[0] if len(data) == 1 else ""
    reset = keyword == "T" and word == "reset" and len(fields) < 3
    if reset:
        rows = [{}] * len(states)
    elif len(fields) == 3:
        value = file.numbers(statement, (1, 1))[0, 0]
        if not value >= 0:
            file.error(line, f"the probability is {data[0]}; expected a number from 0 to 1.")
        if index[2] < 0:
            rows = [dict.fromkeys(range(shape[1]), value) if value else {}] * len(states)
    elif word == "uniform":
        rows = [dict.fromkeys(range(shape[1]), 1 / shape[1])] * len(states)
    elif word == "identity" and len(fields) == 1 and shape[0] == shape[1]:
        rows = [{s: 1.0} for s in states]
    else:
        matrix = file.numbers(statement, (shape[0] if len(fields) == 1 else 1, shape[1]))
        if not (matrix >= 0).all():
            file.error(line, f"a probability is {matrix.min():g}; expected numbers from 0 to 1.")
        rows = [{int(t): float(row[t]) for t in np.flatnonzero(row)} for row in matrix]
        rows = rows if len(fields) == 1 else rows * len(states)
    for action, (i, state) in product(actions, enumerate(states)):
        key = action, state
        file.line_of_row[(keyword, *key)] = line
        if keyword == "T":
            (file.resets.add if reset else file.resets.discard)(key)
        if rows is not None:
            table[key] = dict(rows[i])
            file.num_entries += len(rows[i])
        else:
            table.setdefault(key, {})[index[2]] = value
            file.num_entries += 1
        if file.num_entries > _LARGEST:
            file.error(line, f"there are more than {_LARGEST} probabilities; no more are read.")


def _read_rewards(file: _PomdpText, statement: _Statement) -> None:
    fields, line = statement.fields, statement.line
    kinds = ("actions", "states", "states", "observations")
    if not 2 <= len(fields) <= 4:
        file.error(line, f"R has {len(fields)} names; expected 2 to 4.")
    index = [file.index(k, x, line) for k, x in zip(kinds, fields, strict=False)]
    if len(fields) == 4:
        file.rules.append((index, file.numbers(statement, (1, 1))[0, 0]))
        return
    rows = file.count("states") if len(fields) == 2 else 1
    values = file.numbers(statement, (rows, file.count("observations")))
    for (t, o), value in np.ndenumerate(values):
        file.rules.append(([*index, t, o] if len(fields) == 2 else [*index, o], float(value)))


# --- the model ------------------------------------------------------------------------------


def _table(file: _PomdpText, rows: _Rows, keyword: str) -> tuple[Integers, Integers, Floats]:
    """Rows ``action * S + state`` as offsets, columns and probabilities; each row sums to one."""
    size, belief = file.count("states"), {}
    if file.resets:
        start = _initial(file)
        belief = {int(s): float(start[s]) for s in np.flatnonzero(start)}
    columns: list[int] = []
    values: list[float] = []
    counts = []
    for key in product(range(file.count("actions")), range(size)):
        row = belief if keyword == "T" and key in file.resets else rows.get(key, {})
        entries = sorted((t, p) for t, p in row.items() if p > 0)
        total = float(sum(p for _, p in entries))
        if not abs(total - 1) <= _SUM:
            action, state = (
                [*file.names[k]][i] for k, i in zip(("actions", "states"), key, strict=True)
            )
            message = (
                f"{keyword} of action {action!r} and state {state!r} sums to {total:g}; expected 1."
            )
            if (line := file.line_of_row.get((keyword, *key))) is None:
                refuse(file.name, message)
            file.error(line, message)
        counts.append(len(entries))
        columns += [t for t, _ in entries]
        exact = abs(total - 1) < 1e-12
        values += [p if exact else p / total for _, p in entries]
    return offsets_from_counts(np.array(counts)), np.array(columns, np.int64), np.array(values)


def _initial(file: _PomdpText) -> Floats:
    size = file.count("states")
    return np.full(size, 1 / size) if file.start is None else file.start


def _model(file: _PomdpText) -> POMDP:
    size, num_actions, num_seen = (file.count(k) for k in ("states", "actions", "observations"))
    start, successor, chance = _table(file, file.transition, "T")
    seen_start, seen, seen_chance = _table(file, file.sensor, "O")
    # The pairs (s, o) of a state and an observation, of every action.
    row_state = np.tile(np.arange(size), num_actions)
    pairs = np.unique(np.repeat(row_state, np.diff(seen_start)) * num_seen + seen)
    # Entries (a, s) -> (s', o), in the order of the rows a * S + s.
    source = np.repeat(np.arange(row_state.size), np.diff(start))
    entry, count = row_entries(seen_start, source // size * size + successor)
    source, after = np.repeat(source, count), np.repeat(successor, count)
    value = np.repeat(chance, count) * seen_chance[entry]
    offsets = offsets_from_counts(np.bincount(source, minlength=row_state.size))
    earned = _rewards(file, source // size, source % size, after, seen[entry])
    initial = _initial(file)
    first = np.flatnonzero(initial > 0)
    states, number, belief = pairs // num_seen, pairs % num_seen, np.zeros(pairs.size)
    place = np.flatnonzero(np.isin(states, first))
    if place.size == first.size and np.ptp(number[place]) == 0:
        belief[place] = initial[first]
    else:  # initial states of their own, with an additional observation
        states = np.concatenate([states, first])
        number = np.concatenate([number, np.full(first.size, num_seen)])
        belief = np.concatenate([belief, initial[first]])
    rows = (np.arange(num_actions) * size + states[:, None]).ravel()
    target = np.searchsorted(pairs, after * num_seen + seen[entry])
    entry, count = row_entries(offsets, rows)
    entry_start = offsets_from_counts(count)
    reward, first_entry = earned[entry], np.repeat(earned[entry][entry_start[:-1]], count)
    constant = bool((reward == first_entry).all())
    rewards = Rewards(choice=reward[entry_start[:-1]]) if constant else Rewards(transition=reward)
    named = {k: () if "0" in x else tuple(x) for k, x in file.names.items()}
    options = {}
    if named["states"] and states.size * size <= _LABELS:
        options = {"label": states[:, None] == np.arange(size), "propositions": named["states"]}
    values = np.append(np.arange(num_seen), -1)
    if named["observations"]:
        values = np.array([*named["observations"], ""])
    with errors_in(f"{file.name!r}: "):
        model = make_sparse(
            np.arange(states.size + 1) * num_actions,
            entry_start,
            target[entry],
            value[entry],
            initial=belief,
            action=np.tile(np.arange(num_actions), states.size),
            action_names=named["actions"],
            rewards={file.reward: rewards},
            valuation={"state": states.astype(np.int32)},
            **options,
        )
        return make_pomdp(
            replace(model, numbers=NumberSource(decimal_numbers)),
            number,
            observables={"observation": values[: int(number.max()) + 1]},
        )


def _rewards(
    file: _PomdpText, action: Integers, state: Integers, after: Integers, seen: Integers
) -> Floats:
    """The reward of each entry: the value of the last rule that applies, or 0."""
    last = np.full(action.size, -1)
    fields = (action, state, after, seen)
    if file.rules:
        table = np.array([index for index, _ in file.rules])
        sizes = [file.count(k) for k in ("actions", "states", "states", "observations")]
        kind = (table >= 0) @ (1, 2, 4, 8)
        for pattern in np.unique(kind).tolist():
            rule = np.flatnonzero(kind == pattern)
            key, wanted = np.zeros(rule.size, np.int64), np.zeros(action.size, np.int64)
            for i in range(4):
                if pattern >> i & 1:
                    key = key * sizes[i] + table[rule, i]
                    wanted = wanted * sizes[i] + fields[i]
            order = np.argsort(key, kind="stable")
            place = np.searchsorted(key[order], wanted, "right") - 1
            matches = (place >= 0) & (key[order][place] == wanted)
            last = np.where(matches, np.maximum(last, rule[order][place]), last)
    values = np.array([value for _, value in file.rules] + [0.0])
    return np.asarray(values[last])


# --- writing --------------------------------------------------------------------------------


def write_cassandra(path: str | os.PathLike[str], pomdp: POMDP, *, discount: float = 1.0) -> None:
    """Writes a POMDP in Cassandra's format, atomically; :func:`read_cassandra` restores its numbers.

    States have numbers, and labels and state variables are lost. Observations have the names of an
    observable ``observation``, else numbers. A reward is written as a cost if it is named ``cost``.

    Args:
      path: the file, compressed if it ends in ``.gz`` or ``.xz``.
      pomdp: a POMDP with one action set for all observations, one observation for all initial states
        (the format has none before the first step), and at most one reward.
      discount: of the rewards, from 0 to 1.

    Raises:
      ValueError: the format cannot represent the model, or the file cannot be written.

    Example:
      >>> import tempfile, jaxltl as jl
      >>> world = jl.from_dense([[[0, 0.5, 0.5]], [[1.0, 0, 0]], [[1.0, 0, 0]]], initial=[1, 0, 0])
      >>> path = tempfile.mkdtemp() + "/coin.pomdp"
      >>> write_cassandra(path, jl.models.make_pomdp(world, [0, 1, 1]), discount=0.9)
      >>> read_cassandra(path).pomdp.observation.tolist()
      [0, 1, 1]
    """
    require_in_range("discount", discount, Range(0, 1))
    model, seen = pomdp.fully_observable, np.asarray(pomdp.observation)
    occurs = np.isin(np.arange(pomdp.num_observations), seen)
    begins = np.unique(seen[np.asarray(model.initial) > 0])
    problem = None
    if not pomdp.available[occurs].all():
        problem = "some actions are unavailable in some observations"
    elif begins.size > 1:
        problem = (
            f"the initial states have {begins.size} observations, and the format has none of them"
        )
    elif len(model.rewards) > 1:
        problem = (
            f"it has the rewards {', '.join(map(repr, model.rewards))}, and the format has one"
        )
    if problem is not None:
        raise ValueError(f"{str(path)!r}: {problem}; write DRN (.drn) or UMB (.umb).")
    lines = "".join(f"{line}\n" for line in _lines(pomdp, float(discount)))
    with write_bytes(path) as file:
        file.write(lines.encode())


def _lines(pomdp: POMDP, discount: float) -> Iterator[str]:
    model, host = pomdp.fully_observable, pomdp.fully_observable.host
    seen, initial = np.asarray(pomdp.observation), np.asarray(model.initial, np.float64)
    actions: Sequence[str] = ()
    if model.action is not None and model.action_names and pomdp.num_observations:
        first = np.asarray(model.action)[: host.row_start[1]]
        actions = [model.action_names[i] for i in first]
    names = np.asarray(pomdp.observables.get("observation", ())).tolist()
    reward = next(iter(model.rewards), None)
    yield "# Written by jaxltl"
    yield f"discount: {discount!r}"
    yield f"values: {'cost' if reward == 'cost' else 'reward'}"
    yield f"states: {model.num_states}"
    yield f"actions: {_names(actions) or pomdp.num_actions}"
    yield f"observations: {_names(names) or pomdp.num_observations}"
    some = np.flatnonzero(initial)
    belief = str(some[0]) if some.size == 1 else " ".join(map(repr, initial.tolist()))
    yield f"start: {belief}"
    state, action = host.state[host.row], model.action_number[host.row]
    columns = (x.tolist() for x in (action, state, host.successor, host.probability))
    yield from (f"T: {a} : {s} : {t} {p!r}" for a, s, t, p in zip(*columns, strict=True))
    yield from (f"O: * : {t} : {o} 1" for t, o in enumerate(seen.tolist()))
    if reward is None:
        return
    parts = model.rewards[reward]
    value = choice_reward(model, replace(parts, transition=None))
    if parts.transition is None:
        columns = (x.tolist() for x in (model.action_number, host.state, value))
        yield from (f"R: {a} : {s} : * : * {r!r}" for a, s, r in zip(*columns, strict=True))
    else:
        value = value[host.row] + np.asarray(parts.transition)
        columns = (x.tolist() for x in (action, state, host.successor, value))
        yield from (f"R: {a} : {s} : {t} : * {r!r}" for a, s, t, r in zip(*columns, strict=True))


def _names(names: Sequence[object]) -> str:
    """Names as the format has them, or nothing if some are not valid."""
    texts = [str(x) for x in names]
    valid = all(_NAME.fullmatch(x) and x not in _RESERVED for x in texts)
    return " ".join(texts) if valid and len({*texts}) == len(texts) else ""
