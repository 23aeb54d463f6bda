"""What learners are given: numbers within their ranges, arrays, and parameters of their network."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import flax.errors
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos.common.schedules import is_schedule
from jaxltl.core import validation

UNBOUNDED = (-np.inf, np.inf)


def require_numbers(
    hparams: Any,
    ranges: Mapping[str, tuple[float, float]],
    *,
    optional: Collection[str] = (),
    schedules: Collection[str] = (),
) -> None:
    """Refuses settings that are not one number each, or lie outside of their ranges.

    Args:
      hparams: whose attributes they are.
      ranges: least and most of each, both allowed; of what is traced they are not looked at.
      optional: names of those that may be None.
      schedules: names of those that may be a schedule of the step.

    Raises:
      ValueError: naming the setting, what it is and what to give.

    Example:
      >>> from types import SimpleNamespace
      >>> require_numbers(SimpleNamespace(discount=1.5), {"discount": (0, 1)})
      Traceback (most recent call last):
      ValueError: discount=1.5; it must lie in [0, 1].
    """
    for name, (low, high) in ranges.items():
        number = getattr(hparams, name)
        if (number is None and name in optional) or (name in schedules and is_schedule(number)):
            continue
        kind = getattr(number, "dtype", None)
        kind = np.asarray(number).dtype if kind is None and not isinstance(number, dict) else kind
        real = kind is not None and any(
            jnp.issubdtype(kind, x) for x in (jnp.integer, jnp.floating)
        )
        if np.ndim(number) or not real:  # a whole number that is too large is an object
            raise ValueError(
                f"{name}={validation.shorten(number)}; give one number"
                f"{', or a Partial(function) of the step' if name in schedules else ''}. Many "
                "settings are a vmap."
            )
        if not isinstance(number, jax.core.Tracer) and not low <= number <= high:
            raise ValueError(f"{name}={number}; it must lie in [{low}, {high}].")


def require_arrays(**trees: Any) -> None:
    """Refuses trees in which something is no array and no number, which nothing compiled takes.

    Args:
      trees: by name, as they are told.

    Raises:
      ValueError: naming the place in the tree.

    Example:
      >>> require_arrays(problem={"limit": "high"})
      Traceback (most recent call last):
      ValueError: problem['limit'] is 'high'; give a number or an array.
    """
    for name, tree in trees.items():
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            if not _is_array(leaf):
                place = f"{name}{jax.tree_util.keystr(path)}"
                raise ValueError(
                    f"{place} is {validation.shorten(leaf)}; give a number or an array."
                )


def _is_array(leaf: Any) -> bool:
    if isinstance(leaf, bool | float | complex | jax.Array):
        return True
    if isinstance(leaf, int):
        most = jnp.iinfo(jnp.result_type(int)).max
        return -most <= leaf <= most
    return isinstance(leaf, np.ndarray | np.generic) and leaf.dtype.kind in "biufc"


def applied(network: nn.Module, parameters: Any, *read: Any) -> Any:
    """What a network says with some parameters.

    Args:
      network: the module.
      parameters: of it.
      read: what it is called with.

    Returns:
      What it returns.

    Raises:
      ValueError: the parameters are of another network, or it reads something else.

    Example:
      >>> applied(nn.Dense(2), {"kernel": np.eye(2), "bias": np.zeros(2)}, np.zeros(3))
      ... # doctest: +IGNORE_EXCEPTION_DETAIL
      Traceback (most recent call last):
      ValueError: the parameters are not those of this Dense ...
    """
    if not isinstance(parameters, Mapping):
        raise ValueError(
            f"the parameters are {validation.shorten(parameters)}; give the dict of those of the "
            f"{type(network).__name__}, such as state.parameters."
        )
    try:
        return network.apply({"params": parameters}, *read)
    except flax.errors.FlaxError as problem:
        text = str(problem).partition(" (https:")[0]
        raise ValueError(
            f"the parameters are not those of this {type(network).__name__} for what it reads: "
            f"{text} Give the state, the problem and the settings of one run, and observations "
            "of its environment."
        ) from problem
