"""Policy files: reading (of tables with NumPy alone), writing, and export as C code."""

from __future__ import annotations

import os
import sys

from jaxltl.core.policies.c_code import write_c_policy as write_c_policy
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
