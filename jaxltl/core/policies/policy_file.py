"""Files of policies: one ``.npz`` format for tables and networks, without JAX.

Every file has ``format``, ``version`` and ``kind``; see the page on deployment. Readers ignore
arrays that they do not know.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import PyTree
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.text import from_dict, to_dict
from jaxltl.core.files import atomic_write, read_arrays
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.validation import errors_in, first_true

FORMAT, VERSION = "jaxltl policy", 1
_TABLE = ("initial_memory", "next_memory", "label_on", "letter", "actions", "states")

Arrays = dict[str, NDArray[np.generic]]


def save_policy(
    path: str | os.PathLike[str] | BinaryIO,
    policy: FiniteMemoryPolicy,
    more: Mapping[str, PyTree] | None = None,
) -> None:
    """Writes a finite-memory policy as ``.npz``, atomically.

    Args:
      path, policy: the file, or one that is open, and the policy.
      more: further arrays and texts by name, for readers that know them.

    Raises:
      ValueError: the file cannot be written, or `more` has the name of an array of the policy.

    >>> import tempfile
    >>> still = FiniteMemoryPolicy(np.array([[0]]), np.zeros(1, int), np.zeros((1, 1), int))
    >>> save_policy(path := tempfile.mkdtemp() + "/policy.npz", still, {"satisfaction": [1.0]})
    >>> load_table(path).action.tolist()
    [[0]]
    """
    parts = {name: getattr(policy, name) for name in _TABLE}
    written = {name: x for name, x in parts.items() if x is not None and len(x)}
    written["policy"] = policy.action
    if policy.automaton is not None:
        written["automaton"] = automaton_text(policy.automaton)
    write_policy_file(path, "table", written, more)


def write_policy_file(
    path: str | os.PathLike[str] | BinaryIO,
    kind: str,
    arrays: Mapping[str, PyTree],
    more: Mapping[str, PyTree] | None = None,
) -> None:
    """Writes the arrays of a policy of a kind, and further ones."""
    head = {"format": FORMAT, "version": VERSION, "kind": kind}
    if taken := sorted({*head, *arrays} & {*(more or {})}):
        raise ValueError(f"more has {taken[0]!r}, an array of the policy; choose another name.")
    is_path = isinstance(path, str | os.PathLike)
    with atomic_write(Path(str(path))) if is_path else contextlib.nullcontext(path) as file:
        named = {**head, **arrays, **(more or {})}
        np.savez(file, allow_pickle=False, **{k: np.asarray(v) for k, v in named.items()})


def read_policy_file(path: str | os.PathLike[str]) -> Arrays:
    """The arrays of a policy file, with its ``kind``; ValueError for other files and versions."""
    try:
        with open(path, "rb") as file, errors_in(f"{path}: "):
            arrays: Arrays = read_arrays(file)
    except OSError as error:
        raise ValueError(f"the policy cannot be read: {str(path)!r}: {error.strerror}.") from None
    format_name = str(arrays.get("format", "no format"))
    version = arrays.get("version", np.zeros(()))
    if format_name != FORMAT or version.shape or version != VERSION:
        raise ValueError(
            f"{path}: {format_name}, version {version}, is not a policy that this version of jaxltl "
            f"reads; expected {FORMAT}, version {VERSION}. Write it again, or update jaxltl."
        )
    return arrays


def load_table(path: str | os.PathLike[str]) -> FiniteMemoryPolicy:
    """Reads a finite-memory policy; ValueError names the array that does not fit."""
    arrays = read_policy_file(path)
    if str(arrays.get("kind")) != "table":
        raise ValueError(
            f"{path}: a {arrays.get('kind')}, not a table; jl.io.load_policy reads it."
        )
    with errors_in(f"{path}: "):
        return _table(arrays)


def _table(arrays: Arrays) -> FiniteMemoryPolicy:
    for name in ("policy", "initial_memory", "next_memory", "label_on"):
        if name not in arrays:
            raise ValueError(f"the array {name} is missing; write the file by save_policy.")
    policy = FiniteMemoryPolicy(
        arrays["policy"],
        arrays["initial_memory"],
        arrays["next_memory"],
        str(arrays["label_on"]),
        automaton_of(arrays),
        arrays.get("letter"),
        **{x: tuple(map(str, arrays[x])) for x in ("actions", "states") if x in arrays},
    )
    _check(policy)
    return policy


def automaton_text(automaton: Automaton) -> str:
    """The automaton as JSON."""
    host = {name: np.asarray(getattr(automaton, name)) for name in ("delta", "priority", "letters")}
    return json.dumps(to_dict(Automaton(**{**vars(automaton), **host})))


def automaton_of(arrays: Arrays) -> Automaton | None:
    """The automaton of a policy file; None if it has none."""
    if "automaton" not in arrays:
        return None
    try:
        return from_dict(json.loads(str(arrays["automaton"])))
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"automaton is not one that save_policy writes: {error}") from None


def _check(policy: FiniteMemoryPolicy) -> None:
    """Raises ValueError for arrays of shapes or with entries that do not fit one another."""
    step, action = policy.next_memory, policy.action
    if step.ndim != 2 or step.dtype.kind not in "iu" or not step.size:
        raise ValueError(f"next_memory is {step.dtype}{list(step.shape)}; expected int32[S, Q].")
    count, memories = step.shape
    if policy.label_on not in ("entry", "exit"):
        raise ValueError(f'label_on is {policy.label_on!r}; expected "entry" or "exit".')
    lead = action.ndim - policy.is_random - 2
    if (
        action.dtype.kind not in "iuf"
        or lead not in (0, 1)
        or action.shape[lead:][:2] != step.shape
    ):
        raise ValueError(
            f"policy is {action.dtype}{list(action.shape)}; expected int[{count}, {memories}] or "
            f"float[{count}, {memories}, A], or with an axis of time steps in front."
        )
    automaton, indices = policy.automaton, [("next_memory", step, memories)]
    indices.append(("initial_memory", policy.initial_memory, memories))
    if policy.letter is not None and automaton is not None:
        if automaton.delta.shape[0] != memories:
            raise ValueError(f"automaton has {len(automaton.delta)} states; expected {memories}.")
        indices.append(("letter", policy.letter, automaton.delta.shape[1]))
    if not policy.is_random:
        indices.append(("policy", action, policy.num_actions))
    for name, table, size in indices:
        if table.dtype.kind not in "iu" or (
            name in ("initial_memory", "letter") and table.shape != (count,)
        ):
            raise ValueError(
                f"{name} is {table.dtype}{list(table.shape)}; expected int32[{count}]."
            )
        if ((table < 0) | (table >= size)).any():
            raise ValueError(
                f"{name} has {table[(table < 0) | (table >= size)][0]}; expected 0 to {size - 1}."
            )
    for name in ("actions", "states"):
        width = policy.num_actions if name == "actions" else count
        if len(getattr(policy, name)) not in (0, width):
            raise ValueError(f"{name} has {len(getattr(policy, name))} names; expected {width}.")
    if policy.is_random:
        total = action.sum(-1)
        bad = ~(np.abs(total - 1) < 1e-3) | (action < 0).any(-1)
        for place in first_true(bad):
            raise ValueError(
                f"policy{place} sums to {total[tuple(place)]:g}; expected a distribution."
            )
