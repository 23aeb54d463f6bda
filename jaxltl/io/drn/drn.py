"""DRN files of Markov chains, MDPs and POMDPs, in Storm's text format."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.models import (
    POMDP,
    IntervalMDP,
    Rewards,
    SparseMDP,
    interval_rows,
    make_pomdp,
    make_sparse,
)
from jaxltl.core.models.exact_numbers import decimal_numbers
from jaxltl.core.models.number_source import NumberSource
from jaxltl.core.validation import errors_in
from jaxltl.io.drn.body import (
    INTERVALS,
    NO_LABEL,
    Body,
    DrnHeader,
    names_of,
    read_body,
    read_header,
    rewards_of,
)
from jaxltl.io.files import read_bytes, write_bytes
from jaxltl.io.intervals import first_invalid_sum
from jaxltl.io.text_output import check_name, exact_part, labels_with_init, value_texts
from jaxltl.io.tokens import Text, as_double, refuse

_Reward = tuple[ArrayLike | None, ArrayLike | None]  # of states and of choices

_STEP = 2**16  # states per piece


def read_drn(path: str | os.PathLike[str]) -> SparseMDP | IntervalMDP | POMDP:
    """Markov chain, MDP, interval model or POMDP from a DRN file.

    States labelled ``init`` are initial, with equal probability. Decimals, fractions (``1/3``) and
    placeholders (``$name``) become the nearest doubles. Actions have no names if all are numbers or
    ``__NOLABEL__``. Comments, which hold Storm's state variables, are ignored. The value types
    ``double-interval`` and ``rational-interval`` give an interval model. The observation of a state of a
    POMDP follows its number, ``state 0 {3}``.

    Args:
      path: the file, plain or compressed with gzip or xz.

    Returns:
      A SparseMDP, an IntervalMDP or a POMDP.

    Raises:
      ValueError: with file and line, for malformed text, parameters, rates, intervals with observations,
        or states of equal observation with different actions.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp()) / "coin.drn"
      >>> _ = path.write_text("@type: DTMC\\n@nr_states\\n2\\n@model\\n"
      ...     "state 0 init\\n\\taction 0\\n\\t\\t0 : 1/2\\n\\t\\t1 : 1/2\\n"
      ...     "state 1 heads\\n\\taction 0\\n\\t\\t1 : 1\\n")
      >>> model = read_drn(path)
      >>> model.probability.tolist(), model.propositions
      ([0.5, 0.5, 1.0], ('heads',))
    """
    name, data = str(path), read_bytes(path)
    header = read_header(Text(name, data, 0, len(data)))
    if header.value_type == "parametric" or (header.parameters and not header.value_type):
        refuse(
            name,
            f"its probabilities have parameters, {', '.join(header.parameters)}; "
            "jaxltl.io.drn.parametric.read_parametric reads it.",
        )
    if header.kind == "POMDP" and header.value_type in INTERVALS:
        refuse(name, "it is a POMDP with intervals; expected single probabilities.")
    placeholders = _placeholders(header)
    try:
        body = read_body(
            header,
            lambda block, token: block.probabilities(token, placeholders.get),
            lambda block, token: block.floats(token, "a reward", placeholders.get),
        )
        return _model(header, body)
    except MemoryError:
        refuse(name, "it is too large for the memory.")


def _placeholders(header: DrnHeader) -> dict[bytes, float]:
    values: dict[bytes, float] = {}
    for name, text in header.placeholders.items():
        number = values.get(text, as_double(text))
        if number is None:
            refuse(
                header.body.name,
                f"the placeholder {name.decode()} stands for "
                f"{text[:60].decode()!r}; expected a number.",
            )
        values[name] = number
    return values


def _model(header: DrnHeader, body: Body) -> SparseMDP | IntervalMDP | POMDP:
    text = header.body
    state, row, line = (np.concatenate(x) for x in (body.state, body.row, body.line))
    probability = np.concatenate(body.value)
    start = np.concatenate([[0], np.bincount(row, minlength=body.num_rows).cumsum()])
    if (bad := first_invalid_sum(np.add.reduceat(probability, start[:-1]))) is not None:
        action, subject, problem = bad
        raise text.error(
            int(line[action]), f"{subject} of this action of state {state[action]} {problem}."
        )
    count = np.bincount(state, minlength=body.num_states)
    rows = np.concatenate([[0], count.cumsum()]), start, np.concatenate(body.successor)
    options, rewards = names_of(header, body), _rewards(header, body)
    if header.value_type in INTERVALS:
        return interval_rows(*rows, *probability.T, rewards=rewards, **options)
    model = make_sparse(*rows, probability, rewards=rewards, **options)
    model = replace(model, numbers=NumberSource(decimal_numbers))
    if header.kind != "POMDP":
        return model
    with errors_in(f"{text.name!r}: "):
        return make_pomdp(model, np.concatenate(body.observation))


def _rewards(header: DrnHeader, body: Body) -> dict[str, Rewards]:
    """Rewards by name; all-zero arrays become None."""
    return {
        name: Rewards(state=state if state.any() else None, choice=choice if choice.any() else None)
        for name, state, choice in rewards_of(header, body)
    }


# --- writing --------------------------------------------------------------------------------


def write_drn(path: str | os.PathLike[str], model: SparseMDP | IntervalMDP | POMDP) -> None:
    """Writes a model as a DRN file; :func:`read_drn` and Storm read back the same doubles.

    State variables, names of observations, labels of no state and the order of labels are lost. Rewards
    of interval models are written as numbers, since Storm does not read point intervals.

    Args:
      path: the file, compressed if it ends in ``.gz`` or ``.xz``.
      model: a concrete model with equally likely initial states.

    Raises:
      ValueError: the format cannot represent the model, or the file cannot be written.

    Example:
      >>> import tempfile, jaxltl as jl
      >>> path = tempfile.mkdtemp() + "/coin.drn"
      >>> write_drn(path, jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                                initial=[1, 0, 0]))
      >>> read_drn(path).probability.tolist()
      [0.5, 0.5, 1.0, 1.0]
    """
    lines = _written(model)
    with write_bytes(path) as file:
        file.writelines(lines)


def _written(source: SparseMDP | IntervalMDP | POMDP) -> Iterator[bytes]:
    """The file in pieces; validates the model before the first piece."""
    observation = None
    if isinstance(source, POMDP):
        observation, source = np.asarray(source.observation), source.fully_observable
    model = exact_part(source)
    labels, actions = _label_texts(model), _action_texts(model)
    rewards = []
    for name, reward in model.rewards.items():
        check_name("reward", name, ' \t"')
        if reward.transition is not None:
            raise ValueError(
                f"the reward {name!r} has rewards of transitions, which the format does not hold; "
                "give their expectation on choices, Rewards(choice=choice_reward(model, name))."
            )
        rewards.append((reward.state, reward.choice))
    if "" in list(model.rewards)[1:]:
        raise ValueError("only the first reward may have the name ''; give the others names.")
    head = [
        "// Written by jaxltl",
        f"@type: {'POMDP' if observation is not None else 'DTMC' if model.is_chain else 'MDP'}",
        f"@value_type: {'double' if model is source else 'double-interval'}",
        "@parameters",
        "",
        "@reward_models",
        "".join(f"{name} " for name in model.rewards),
        "@nr_states",
        str(model.num_states),
        "@nr_choices",
        str(model.num_rows),
        "@model",
        "",
    ]
    values = value_texts(source, ", ")
    lines = partial(_state_lines, labels=labels, rewards=rewards, observation=observation)
    return _pieces("\n".join(head).encode(), model, values, lines, actions, rewards)


def _pieces(
    head: bytes,
    model: SparseMDP,
    values: Callable[[slice], list[str]],
    state_lines: Callable[[slice], list[str]],
    actions: Callable[[int], str] | None,
    rewards: list[_Reward],
) -> Iterator[bytes]:
    yield head
    host = model.host
    for begin in range(0, host.num_states, _STEP):
        end = min(begin + _STEP, host.num_states)
        rows = slice(*host.row_start[[begin, end]].tolist())
        entries = slice(*host.entry_start[[rows.start, rows.stop]].tolist())
        states = slice(begin, end)
        # Positions of the lines of states, actions and transitions.
        of_row, of_entry = host.state[rows], host.row[entries]
        num_rows, num_entries = of_row.size, of_entry.size
        at_entry = np.arange(num_entries) + of_entry - rows.start + host.state[of_entry] - begin + 2
        at_row = np.arange(num_rows) + of_row - begin + 1 + (host.entry_start[rows] - entries.start)
        at_state = (
            np.arange(end - begin)
            + (host.row_start[states] - rows.start)
            + (host.entry_start[host.row_start[states]] - entries.start)
        )
        lines = np.empty(num_entries + num_rows + end - begin, object)
        lines[at_entry] = [
            f"\t\t{t} : {p}\n"
            for t, p in zip(host.successor[entries].tolist(), values(entries), strict=True)
        ]
        lines[at_row] = _action_lines(model, rows, actions, rewards)
        lines[at_state] = state_lines(states)
        yield "".join(lines.tolist()).encode()


def _state_lines(
    states: slice,
    labels: list[tuple[str, NDArray[np.bool_]]],
    rewards: list[_Reward],
    observation: Integers | None,
) -> list[str]:
    after = _bracketed([state for state, _ in rewards], states, states.stop - states.start)
    for text, holds in labels:
        for i in np.flatnonzero(holds[states]).tolist():
            after[i] += text
    if observation is not None:
        seen = observation[states].tolist()
        after = [f" {{{o}}}{text}" for o, text in zip(seen, after, strict=True)]
    return [f"state {s}{text}\n" for s, text in enumerate(after, states.start)]


def _action_lines(
    model: SparseMDP, rows: slice, actions: Callable[[int], str] | None, rewards: list[_Reward]
) -> list[str]:
    after = _bracketed([choice for _, choice in rewards], rows, rows.stop - rows.start)
    if actions is None or model.action is None:
        return [f"\taction {NO_LABEL.decode()}{text}\n" for text in after]
    numbers = np.asarray(model.action)[rows].tolist()
    return [f"\taction {actions(i)}{text}\n" for i, text in zip(numbers, after, strict=True)]


def _bracketed(rewards: list[ArrayLike | None], part: slice, count: int) -> list[str]:
    """Rewards as ``[1.0, 2.0]``, one text per state or action."""
    if not rewards:
        return [""] * count
    columns = [
        ["0"] * count if x is None else list(map(repr, np.asarray(x, np.float64)[part].tolist()))
        for x in rewards
    ]
    form = f" [{', '.join(['%s'] * len(columns))}]"
    return [form % values for values in zip(*columns, strict=True)]


def _label_texts(model: SparseMDP) -> list[tuple[str, NDArray[np.bool_]]]:
    """Text and mask of each label, the initial states first."""
    labels = []
    for name, where in labels_with_init(model).items():
        check_name("label", name, '"')
        if not name:
            raise ValueError("a label has the name ''; the format requires a name.")
        labels.append((f" {name}" if re.fullmatch(r"[^\s\[\]]+", name) else f' "{name}"', where))
    return labels


def _action_texts(model: SparseMDP) -> Callable[[int], str] | None:
    """Function from action numbers to action names; None without actions."""
    if model.action is None:
        return None
    if not model.action_names:
        return str
    for name in model.action_names:
        check_name("action", name, ' \t"')
    return [name or NO_LABEL.decode() for name in model.action_names].__getitem__
