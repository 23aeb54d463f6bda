"""Explicit-state files of PRISM and Storm: transitions, labels, states and rewards."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.models.exact_numbers import decimal_numbers
from jaxltl.core.models.number_source import NumberSource
from jaxltl.core.models.interval import IntervalMDP, interval_rows
from jaxltl.core.models.sparse import Annotations, SparseMDP, make_sparse
from jaxltl.io.files import read_bytes, write_bytes
from jaxltl.io.intervals import (
    first_invalid_sum,
    has_bracket,
    intervals,
    joined_brackets,
)
from jaxltl.io.prism.sections import (
    Section,
    read_labels,
    read_rewards,
    read_valuation,
    written_sections,
)
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.io.tokens import TokenBlock, Text, decoded, numbered, refuse, truncated

_NAME = re.compile(
    r"(?P<stem>.+)\.(?P<kind>tra|pexp)(?P<packed>\.gz|\.xz)?", re.DOTALL | re.IGNORECASE
)
_SECTION = re.compile(
    rb"^#[ \t]*(Transitions|States|Observations|Labels|Reward structure)\b.*$", re.MULTILINE
)
_KIND = re.compile(rb"^#[ \t]*Transitions[ \t]*\(([^)\n]*)\)", re.MULTILINE)
_KINDS = (b"DTMC", b"MDP", b"IDTMC", b"IMDP")
_NUMBERED = re.compile(rb"_(0|[1-9]\d{0,8}|1\d{9})")  # how actions without names are written


def read_prism(path: str | os.PathLike[str]) -> SparseMDP | IntervalMDP:
    """Markov chain, MDP or interval model from PRISM's or Storm's explicit files.

    The companions of ``name.tra`` are ``name.lab`` (labels), ``name.sta`` (state variables) and
    ``name.srew`` and ``name.trew`` (rewards; numbered ``name1.srew``, ``name2.srew`` if several);
    ``name.pexp`` has all in one file. Storm's dialect starts with ``dtmc`` or ``mdp``.

    States labelled ``init`` are initial, with equal probability; without labels, state 0. Deadlock
    states get a self-loop. Decimals and fractions become the nearest doubles; probabilities
    ``[l,u]`` give an interval model. A transition reward that is constant on every choice becomes a
    choice reward. Rewards without a name are called "", or by their number if several.

    Args:
      path: the ``.tra`` or ``.pexp`` file; each file may be compressed with gzip or xz.

    Returns:
      A SparseMDP or an IntervalMDP.

    Raises:
      ValueError: with file and line, for malformed text, observations or continuous time.

    Example:
      >>> import tempfile
      >>> path = Path(tempfile.mkdtemp()) / "coin.tra"
      >>> _ = path.write_text("3 2\\n0 1 1/2\\n0 2 1/2\\n")
      >>> read_prism(path).successor.tolist()
      [1, 2, 1, 2]
    """
    path, match = _parsed_name(path)
    sections = _in_one(path) if match["kind"].lower() == "pexp" else list(_beside(path, match))
    text = next(text for kind, _, text in sections if kind == "tra")
    try:
        return _model(text, sections)
    except MemoryError:
        refuse(text.name, "it is too large for the memory.")


def write_prism(
    path: str | os.PathLike[str],
    model: SparseMDP | IntervalMDP,
    *,
    dialect: Literal["prism", "storm"] = "prism",
) -> None:
    """Writes a model as explicit-state files.

    Doubles are written exactly. Choice and transition rewards are written as their sum, on
    transitions. Numbered actions without names are written as ``_0``, ``_1``, ....

    Args:
      path: the ``.tra`` file, next to which the others are written, or a ``.pexp`` file; compressed
        with the suffix ``.gz`` or ``.xz``.
      model: a concrete model with equally likely initial states.
      dialect: ``"prism"``, or ``"storm"`` without state variables, names of rewards, intervals, and
        actions of chains.

    Raises:
      ValueError: the format cannot represent the model, a file cannot be written, or companion
        files of another model exist.

    Example:
      >>> import tempfile, jaxltl as jl
      >>> path = tempfile.mkdtemp() + "/coin.tra"
      >>> write_prism(path, jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                                  initial=[1, 0, 0]))
      >>> read_prism(path).probability.tolist()
      [0.5, 0.5, 1.0, 1.0]
    """
    path, match = _parsed_name(path)
    if dialect not in ("prism", "storm"):
        raise ValueError(f"dialect is {dialect!r}; give 'prism' or 'storm'.")
    sections = written_sections(model, dialect)
    if match["kind"].lower() == "pexp":
        if dialect == "storm":
            refuse(str(path), "Storm reads no .pexp; write a .tra.")
        with write_bytes(path) as file:
            for section in sections:
                file.writelines(section.header)
                file.writelines(section.lines())
        return
    names = [f"{match['stem']}{s.number}.{s.kind}{match['packed'] or ''}" for s in sections]
    others = sorted(p.name for _, _, p in _siblings(path, match) if p.name not in names)
    if others:
        refuse(
            str(path),
            f"the companion files {', '.join(others)} exist and would be read with it; "
            "delete them or choose another name.",
        )
    for name, section in zip(names, sections, strict=True):
        with write_bytes(path.parent / name) as file:
            if section.kind in ("srew", "trew") and dialect == "prism":
                file.writelines(section.header)  # contains the name
            file.writelines(section.lines())


def _parsed_name(path: str | os.PathLike[str]) -> tuple[Path, re.Match[str]]:
    """The path, and the parts of its name."""
    match = _NAME.fullmatch(Path(path).name)
    if match is None:
        refuse(str(path), "its name must end in .tra or .pexp, or that and .gz or .xz.")
    return Path(path), match


# --- which files ----------------------------------------------------------------------------


def files_beside(path: str | os.PathLike[str]) -> list[Path]:
    """Companion files (labels, states, rewards) of a ``.tra`` file."""
    match = _NAME.fullmatch(Path(path).name)
    if match is None or match["kind"].lower() != "tra":
        return []
    return [other for _, _, other in _siblings(Path(path), match)]


def _siblings(path: Path, match: re.Match[str]) -> Iterator[tuple[str, str, Path]]:
    """Companion files of a ``.tra`` file: kind, number and path."""
    form = re.compile(re.escape(match["stem"]) + r"\.?(\d{0,9})\.(lab|sta|srew|trew)(\.gz|\.xz)?")
    try:
        names = sorted(os.listdir(path.parent))
    except (OSError, ValueError) as error:
        refuse(str(path), f"its folder cannot be read: {error}.")
    matches = [(name, other) for name in names if (other := form.fullmatch(name))]
    for name, other in sorted(matches, key=lambda x: int(x[1][1] or 0)):
        if other[1] and other[2] in ("lab", "sta"):
            continue
        stem = name.removesuffix(other[3] or "").removesuffix(f".{other[2]}")
        if other[1] and {f"{stem}.tra", f"{stem}.tra.gz", f"{stem}.tra.xz"} & set(names):
            continue  # belongs to another model, name1
        yield other[2], other[1], path.parent / name


def _beside(path: Path, match: re.Match[str]) -> Iterator[Section]:
    chosen: dict[tuple[str, str], Path] = {}
    for kind, number, other in _siblings(path, match):
        packed = match["packed"] or ""
        if (kind, number) not in chosen or other.name.endswith(f".{kind}{packed}"):
            chosen[kind, number] = other
    for (kind, number), other in [(("tra", ""), path), *chosen.items()]:
        data = read_bytes(other)
        yield kind, number, Text(str(other), data, 0, len(data))


def _in_one(path: Path) -> list[Section]:
    data, name = read_bytes(path), str(path)
    starts = list(_SECTION.finditer(data))
    if not starts or starts[0][1] != b"Transitions":
        refuse(name, "it must begin with a line '# Transitions (MDP)' or '# Transitions (DTMC)'.")
    sections: list[Section] = []
    count = {"srew": 0, "trew": 0}
    line, before = 1, 0
    for start, stop in zip(starts, [*(s.start() for s in starts[1:]), len(data)], strict=True):
        line += data.count(b"\n", before, start.start())
        before = start.start()
        text, number = Text(name, data, before, stop, line), ""
        kind = {b"Transitions": "tra", b"States": "sta", b"Labels": "lab"}.get(start[1], "")
        if start[1] == b"Observations":
            raise text.error(line, "models with observations are not read.")
        if not kind:
            second = data[start.end() : min(stop, start.end() + 200)].split(b"\n", 2)[1:2]
            form = re.match(rb"#[ \t]*(State|Transition) rewards", second[0] if second else b"")
            if form is None:
                raise text.error(line + 1, "expected '# State rewards' or '# Transition rewards'.")
            kind = {b"State": "srew", b"Transition": "trew"}[form[1]]
            count[kind] += 1
            number = str(count[kind])
        elif any(kind == other for other, _, _ in sections):
            raise text.error(line, f"a second section of {start[1].decode()}; remove one.")
        sections.append((kind, number, text))
    return sections


# --- transitions ----------------------------------------------------------------------------


@dataclass(frozen=True)
class _TransitionColumns:
    """Transitions as columns."""

    num_states: int  # S
    is_chain: bool  # True if transitions have no choice numbers
    state: Integers  # state, choice, target, action: int32[T]; action -1 for none
    choice: Integers
    target: Integers
    probability: Floats  # float64[T], or bounds float64[T, 2]
    action: Integers
    line: Integers  # int32[T], 0 for added self-loops
    names: dict[bytes, int]  # action names


def _sizes(text: Text) -> tuple[bool, list[int], Text]:
    """True for a chain, the sizes of the first line (none for Storm), and the remaining text."""
    kind = _KIND.search(text.data, text.begin, min(text.stop, text.begin + 2000))
    if kind and kind[1] not in _KINDS:
        raise text.error(
            text.line,
            f"a model of type {kind[1].decode(errors='replace')} is not read; "
            f"{', '.join(x.decode() for x in _KINDS)} are.",
        )
    first, line, rest = text.first_line(b"#")
    if first.lower() in (b"dtmc", b"mdp"):
        return first.lower() == b"dtmc", [], rest
    if first.lower() in (b"ctmc", b"ma", b"pomdp"):
        raise text.error(
            line, f"a model of type {first.decode()} is not supported; expected dtmc or mdp."
        )
    sizes = first.split()
    if len(sizes) == 4 and all(x.isdigit() for x in sizes):
        raise text.error(
            line, "four sizes are those of a model with observations, which is not read."
        )
    if len(sizes) not in (2, 3) or not all(x.isdigit() and len(x) < 19 for x in sizes):
        raise text.error(
            line,
            f"{first[:60].decode(errors='replace')!r}; expected 'states "
            "transitions' of a chain, 'states choices transitions' of an MDP, "
            "or Storm's 'dtmc' or 'mdp'.",
        )
    numbers = [int(x) for x in sizes]
    if kind and kind[1].endswith(b"DTMC") != (len(sizes) == 2):
        raise text.error(line, f"{len(sizes)} sizes; a {kind[1].decode()} has {5 - len(sizes)}.")
    if not 0 < numbers[0] < 2**31 - 1:
        raise text.error(line, f"{numbers[0]} states; expected 1 to {2**31 - 2}.")
    return len(sizes) == 2, numbers, rest


def _read_rows(text: Text) -> _TransitionColumns:
    is_chain, sizes, rest = _sizes(text)
    width, form = (
        (3, "'state successor probability'")
        if is_chain
        else (4, "'state choice successor probability'")
    )
    below = sizes[0] if sizes else 2**31 - 2
    names: dict[bytes, int] = {}
    parts: list[list[NDArray]] = [[] for _ in range(6)]
    kind = _KIND.search(text.data, text.begin, min(text.stop, text.begin + 2000))
    is_interval = kind is not None and kind[1].startswith(b"I")
    for block in rest.blocks(b"#"):
        block = joined_brackets(block, width - 1)
        at = block.columns(width, 1, f"{form}, and an action or none")
        is_interval |= has_bracket(block, at + width - 1)
        for part, column in zip(
            parts, _columns(block, at, width, below, names, is_interval), strict=True
        ):
            part.append(column)
    if not parts[0]:
        raise text.error(rest.line, f"the file ends without a transition; expected {form}.")
    if is_interval:  # blocks before the first interval have numbers
        parts[3] = [x if x.ndim > 1 else np.stack([x, x], 1) for x in parts[3]]
    columns = tuple(np.concatenate(x) for x in parts)
    del parts
    state, choice, target, probability, action, lines = columns
    if sizes and sizes[-1] != state.size:
        raise text.error(rest.line - 1, truncated(sizes[-1], state.size, "transitions"))
    num_states = sizes[0] if sizes else int(max(state.max(), target.max())) + 1
    if num_states > 16 * state.size + 10_000:
        raise text.error(
            rest.line - 1,
            f"{num_states} states are announced, which {state.size} transitions cannot reach.",
        )
    rows = _TransitionColumns(
        num_states, is_chain, state, choice, target, probability, action, lines, names
    )
    new = _new_rows(text, rows, form)
    if len(sizes) == 3 and sizes[1] != new.sum():
        raise text.error(rest.line - 1, truncated(sizes[1], int(new.sum()), "choices"))
    return rows


def _columns(
    block: TokenBlock,
    at: NDArray,
    width: int,
    below: int,
    names: dict[bytes, int],
    is_interval: bool,
) -> tuple[NDArray, ...]:
    """Columns of :class:`_TransitionColumns` for lines with first tokens `at`."""
    action = np.full(at.size, -1, np.int32)
    named = block.count > width
    action[named] = numbered(block.texts(at[named] + width), names)
    return (
        block.integers(at, "a state", below),
        np.zeros(at.size, np.int32)
        if (width == 3)
        else block.integers(at + 1, "the number of a choice"),
        block.integers(at + width - 2, "a state", below),
        np.stack(intervals(block, at + width - 1), 1)
        if is_interval
        else block.probabilities(at + width - 1),
        action,
        block.line.astype(np.int32),
    )


def _new_rows(text: Text, rows: _TransitionColumns, form: str) -> Booleans:
    """Mask of the first transition of each choice, ``bool[T]``; choices must ascend."""
    state, choice = rows.state, rows.choice
    other = np.ones(state.size, bool)
    other[1:] = state[1:] != state[:-1]
    new = other.copy()
    new[1:] |= choice[1:] != choice[:-1]
    wrong = choice != np.where(other, 0, np.roll(choice, 1) + new)
    wrong[1:] |= state[1:] < state[:-1]
    if wrong.any():
        i = int(wrong.argmax())
        raise text.error(
            int(rows.line[i]),
            f"state {state[i]}, choice {choice[i]} out of order; "
            f"expected {form} with states and choices ascending "
            "one by one.",
        )
    return new


def _with_loops(rows: _TransitionColumns) -> _TransitionColumns:
    has = np.zeros(rows.num_states, bool)
    has[rows.state] = True
    missing = np.flatnonzero(~has).astype(np.int32)
    place = np.searchsorted(rows.state, missing)
    loop: dict[str, ArrayLike] = {
        "state": missing,
        "choice": 0,
        "target": missing,
        "probability": 1,
    }
    loop |= {"action": -1, "line": 0}
    columns = {name: np.insert(getattr(rows, name), place, x, axis=0) for name, x in loop.items()}
    return replace(rows, **columns)


def _model(text: Text, sections: list[Section]) -> SparseMDP | IntervalMDP:
    rows = _with_loops(_read_rows(text))
    new = np.ones(rows.state.size, bool)
    new[1:] = (rows.state[1:] != rows.state[:-1]) | (rows.choice[1:] != rows.choice[:-1])
    start = np.flatnonzero(new)
    total = np.add.reduceat(rows.probability, start)
    if (bad := first_invalid_sum(total)) is not None:
        row, subject, problem = bad
        raise text.error(
            int(rows.line[start[row]]),
            f"{subject} of state {rows.state[start[row]]}, choice {rows.choice[start[row]]} {problem}.",
        )
    count = np.bincount(rows.state[start], minlength=rows.num_states)
    action, action_names = _actions(text, rows, start)
    label, propositions, initial = read_labels(sections, rows.num_states)
    annotations = Annotations(
        label=label,
        propositions=propositions,
        action=action,
        action_names=action_names,
        valuation=read_valuation(sections, rows.num_states),
    )
    starts = np.concatenate([[0], count.cumsum()]), np.append(start, rows.state.size)
    is_chain, interval, probability = rows.is_chain, None, rows.probability
    if probability.ndim > 1:
        interval = interval_rows(
            *starts, rows.target, *probability.T, initial=initial, **annotations
        )
        model = interval.nominal
    else:
        model = make_sparse(*starts, rows.target, probability, initial=initial, **annotations)
        model = replace(model, numbers=NumberSource(decimal_numbers))
    del rows, new, start, total, probability, starts  # free memory for the rewards
    model = replace(model, rewards=read_rewards(sections, model, is_chain))
    return model if interval is None else replace(interval, nominal=model)


def _actions(
    text: Text, rows: _TransitionColumns, start: Integers
) -> tuple[Integers | None, tuple[str, ...]]:
    if not rows.names:
        return None, ()
    action = rows.action[start]
    other = rows.action != np.repeat(action, np.diff(start, append=rows.action.size))
    if other.any() and not rows.is_chain:
        i = int(other.argmax())
        raise text.error(
            int(rows.line[i]),
            f"state {rows.state[i]}, choice {rows.choice[i]} has "
            "two actions; expected the same in all of its lines.",
        )
    if other.any():  # transitions of a chain may have different names
        action = np.where(np.add.reduceat(other, start) > 0, -1, action)
    texts = list(rows.names)
    if (action >= 0).all() and all(_NUMBERED.fullmatch(x) for x in texts):
        return np.array([int(x[1:]) for x in texts])[action], ()
    names = decoded(text, rows.names)
    if (action < 0).any():
        action, names = np.where(action < 0, len(names), action), [*names, ""]
    return action, tuple(names)
