"""Policy files: reading (of tables with NumPy alone), writing, and export as C code."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.files import atomic_write
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy, Policy
from jaxltl.core.policies.policy_file import (
    load_table,
    read_policy_file,
    save_policy as save_policy,
)
from jaxltl.core.validation import errors_in


def load_policy(path: str | os.PathLike[str]) -> FiniteMemoryPolicy | Policy:
    """Reads a policy from a file that ``jaxltl learn``, `save_policy` or `save_network` wrote.

    A table needs NumPy alone. A network needs JAX, but neither flax nor the environment.

    Args:
      path: the file.

    Returns:
      :class:`~jaxltl.core.policies.finite_memory.FiniteMemoryPolicy`, with NumPy arrays, or
      :class:`~jaxltl.io.network_policy.NetworkPolicy`; both have ``start``, ``act``, ``update`` and ``controller``.

    Raises:
      ValueError: a file that is missing, damaged, or of another format or version.

    Example:
      >>> import tempfile
      >>> import numpy as np
      >>> still = FiniteMemoryPolicy(np.array([[0]]), np.zeros(1, int), np.zeros((1, 1), int))
      >>> save_policy(path := tempfile.mkdtemp() + "/policy.npz", still)
      >>> robot = load_policy(path).controller()
      >>> robot.start(0)
      >>> robot.act()
      0
    """
    arrays = read_policy_file(path)
    if str(arrays.get("kind")) == "network":
        from jaxltl.io.network_policy import network_policy

        with errors_in(f"{path}: "):
            return network_policy(arrays)
    if sys.modules.get("jax") is not None:  # registers the class as a pytree
        import jaxltl.core.models.trajectories  # noqa: F401
    return load_table(path)


_CODE = """\
/* A finite-memory policy, written by jaxltl: {states} states, {memories} memory states, {actions} actions.
 *
 *   q = {name}_start(s);                 the memory state in the initial state s
 *   a = {name}_act(s, q, random32);      an action; random32 is uniform on 0 to 2^32 - 1{ignored}
 *   q = {name}_update(q, s, t);          the memory state after a step from s to t
 *
 * Arguments are not checked. */
#ifndef {guard}_H
#define {guard}_H
#include <stdint.h>

{names}{tables}

static inline int {name}_start(int state) {{ return {name}_initial_memory[state]; }}

static inline int {name}_update(int memory, int state, int successor) {{
  (void){unread};
  return {name}_delta[{name}_letter[{read}]][memory];
}}

static inline int {name}_act(int state, int memory, uint32_t random32) {{
{act}
}}

#endif
"""
_DRAWN = """\
  const uint32_t *first = {name}_first[{name}_row[state][memory]];
  int action = {last};
  if (random32 == 0xFFFFFFFFu) --random32;
  while (random32 < first[action]) --action;
  return action;"""
_CHOSEN = """\
  (void)random32;
  return {name}_action[state][memory];"""


def write_c_policy(
    path: str | os.PathLike[str], policy: FiniteMemoryPolicy, *, name: str = "policy"
) -> None:
    """Writes a policy as a C99 header: constant tables and three functions without a library.

    Probabilities are rounded to multiples of 2^-32; an action of probability 0 is never chosen.

    Args:
      path: the header.
      policy: the policy, without a horizon.
      name: prefix of the functions and tables, a C identifier.

    Raises:
      ValueError: a name that is not an identifier, or a policy with a horizon.

    >>> import tempfile
    >>> still = FiniteMemoryPolicy(np.array([[0]]), np.zeros(1, int), np.zeros((1, 1), int))
    >>> write_c_policy(path := tempfile.mkdtemp() + "/still.h", still, name="still")
    >>> import pathlib
    >>> "static inline int still_act(int state, int memory" in pathlib.Path(path).read_text()
    True
    """
    if not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII):
        raise ValueError(f"name={name!r}; give a C identifier, such as 'policy'.")
    if policy.has_horizon:
        raise ValueError(
            f"the policy has a horizon of {len(policy.action)} steps; C code is written for "
            "policies that do not depend on time."
        )
    step, action = np.asarray(policy.next_memory), np.asarray(policy.action)
    delta, letter = np.unique(step, axis=0, return_inverse=True)
    first = np.asarray(policy.initial_memory)
    tables = {"initial_memory": first, "letter": letter.ravel(), "delta": delta}
    if policy.is_random:
        rows, place = np.unique(_first_numbers(action), axis=0, return_inverse=True)
        tables |= {"row": place.reshape(step.shape), "first": rows}
    else:
        tables["action"] = action
    on_entry = policy.label_on == "entry"
    text = _CODE.format(
        name=name,
        guard=name.upper(),
        states=policy.num_states,
        memories=step.shape[1],
        actions=policy.num_actions,
        ignored="" if policy.is_random else ", ignored",
        names="".join(
            f"/* action {i}: {' '.join(x.replace('*/', '* /').splitlines())} */\n"
            for i, x in enumerate(policy.actions)
        ),
        tables="\n".join(_table(f"{name}_{key}", x) for key, x in tables.items()),
        unread="state" if on_entry else "successor",
        read="successor" if on_entry else "state",
        act=(_DRAWN if policy.is_random else _CHOSEN).format(
            name=name, last=policy.num_actions - 1
        ),
    )
    with atomic_write(Path(path)) as file:
        file.write(text.encode())


def _first_numbers(weight: NDArray[np.floating]) -> NDArray[np.int64]:
    """``int64[S * Q, A]``: action a is drawn by 32-bit numbers from its entry to the next one."""
    # An action of probability 0 has the entry of the next one, and at the end the largest number,
    # which is drawn as the one below.
    weight = weight.reshape(-1, weight.shape[-1]).astype(np.float64)
    total = weight.cumsum(-1)
    before = np.concatenate([np.zeros((len(total), 1)), total[:, :-1]], axis=-1)
    return cast(
        NDArray[np.int64],
        np.minimum(np.rint(before / total[:, -1:] * 2.0**32), 2.0**32 - 1).astype(np.int64),
    )


def _table(name: str, values: NDArray[np.integer]) -> str:
    greatest = int(values.max(initial=0))
    bits = next(b for b in (8, 16, 32) if greatest < 2**b)
    size = "".join(f"[{n}]" for n in values.shape)
    return f"static const uint{bits}_t {name}{size} = {_braces(values.tolist())};"


def _braces(values: list[int] | int) -> str:
    if isinstance(values, int):
        return str(values)
    inside = [_braces(x) for x in values]
    return "{" + (",\n  " if inside and inside[0].startswith("{") else ", ").join(inside) + "}"
