"""Schedules of hyperparameters, and the convergence conditions of theorem 1 (chapter 4) on them.

>>> from jaxltl.algos import cce
>>> from jaxltl.algos.common import schedules
>>> hparams = cce.Hparams(  # those of theorem 1
...     rate=schedules.Polynomial(0.5, -0.7), num_samples=schedules.Polynomial(10, 0.5),
...     weighting="literal")
>>> schedules.theorem_conditions(hparams, num_steps=90).holds
True
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxltl.core import struct
from jaxltl.core.array_types import PyTree
from jaxltl.core.pretty_print import brief

# Products such as .07 * 100 round to slightly more than the exact integer.
SLACK = 1e-9


@struct.dataclass
class Polynomial:
    """The schedule ``scale * (l + offset) ** power`` of the steps l = 1, 2, ...

    Attributes:
      scale, power: the numbers; a negative power decays.
      offset: added to the step; default 0.

    >>> [round(float(at(Polynomial(0.5, -1.0), step)), 3) for step in range(3)]
    [0.5, 0.25, 0.167]
    """

    scale: jax.Array | float
    power: jax.Array | float
    offset: jax.Array | float = 0.0


@struct.dataclass
class Linear:
    """Linear interpolation from `first` in the first step to `last` after `num_steps`, then constant.

    >>> [float(at(Linear(1.0, 0.0, 4), step)) for step in range(6)]
    [1.0, 0.75, 0.5, 0.25, 0.0, 0.0]
    """

    first: jax.Array | float
    last: jax.Array | float
    num_steps: jax.Array | int

    def __call__(self, l: jax.Array | int) -> jax.Array:  # noqa: E741
        """The number in step l = 1, 2, ..."""
        steps = jnp.asarray(l, jnp.result_type(float)) - 1
        share = jnp.clip(steps / jnp.asarray(self.num_steps), 0, 1)
        return self.first + (self.last - self.first) * share


Schedule = Any  # a number, a Polynomial, or a pytree that is called with l = 1, 2, ...


def is_schedule(value: object) -> bool:
    """``True`` if `value` is a schedule of the step, a pytree that is traced, and not a number.

    >>> import math
    >>> [is_schedule(x) for x in (Linear(1.0, 0.0, 4), Polynomial(1.0, -1.0), 0.5, math.exp)]
    [True, True, False, False]
    """
    own = isinstance(value, Polynomial) or callable(value)
    return own and not jax.tree_util.all_leaves([value])


def at(schedule: Schedule, step: jax.Array | int) -> Any:
    """The value of a `schedule` in step l = `step` + 1; None of None.

    A number, :class:`Polynomial`, :class:`Linear`, or a function of l in a pytree. Differentiable in
    the schedule's numbers.

    >>> at(Linear(1.0, 0.0, 2), 1).item(), at(0.5, 1)
    (0.5, 0.5)
    """
    l = jnp.asarray(step) + 1  # noqa: E741
    if isinstance(schedule, Polynomial):
        return schedule.scale * (l + jnp.asarray(schedule.offset)) ** jnp.asarray(schedule.power)
    return schedule(l) if callable(schedule) else schedule


@brief
class TheoremCondition(NamedTuple):
    """A condition of theorem 1: its `name`, `holds` (None if that is unknown), and the `reason`.

    >>> TheoremCondition("samples grow", False, "constant").holds
    False
    """

    name: str
    holds: bool | None
    reason: str


@brief
class TheoremConditions(NamedTuple):
    """Result of :func:`theorem_conditions`.

    Attributes:
      holds: True if all conditions hold, False if one fails, else None.
      failing: names of those that fail.
      conditions: all, with reasons.
      assumed: assumptions of the theorem on the problem, which hyperparameters cannot show.
    """

    holds: bool | None
    failing: tuple[str, ...]
    conditions: tuple[TheoremCondition, ...]
    assumed: tuple[str, ...]


_ASSUMED = (
    "(1) the covariance of the sufficient statistics is positive definite",
    "(2a) the differential equation (4.12) is continuous with unique solutions",
    "(2c) the quantiles of H and U are unique",
    "(2d) policies and distributions lie in compact sets",
    "(2e) G is bounded and bounded away from 0, and H is bounded",
    "(2f) the distribution stays in the interior of its set",
)


def theorem_conditions(hparams: PyTree, *, num_steps: int | None = None) -> TheoremConditions:
    """The :class:`TheoremConditions` of theorem 1 (assumption 2b) on concrete `hparams` of ``cce``; on the host.

    ``n_l`` grows as ``l^beta`` with beta > 0; ``alpha_l`` is positive, decreases to 0 and has an infinite
    sum; ``lambda_l = O(l^-lambda)`` with lambda > 0 and ``beta + 2 lambda > 1``; and the method is
    algorithm 2 as printed. With `num_steps` the run ends, and `population` bounds n_l, so that samples
    grow for a limited number of steps.

    >>> from jaxltl.algos.cce import Hparams
    >>> theorem_conditions(Hparams(weighting="literal")).failing
    ('samples grow', 'rate decreases', 'rate vanishes')
    """
    growth, samples = _samples_condition(hparams, num_steps)
    decay, share = _share_condition(hparams.sample_share)
    both = None if growth is None or decay is None else growth + 2 * decay > 1
    conditions = (
        samples,
        *_rate_conditions(hparams.rate),
        share,
        TheoremCondition("beta + 2 lambda > 1", both, f"beta = {growth}, lambda = {decay}"),
        TheoremCondition(
            "weights are G", hparams.weighting == "literal", f"weighting={hparams.weighting!r}"
        ),
        *(
            TheoremCondition(
                f"no {name}", getattr(hparams, name) in (None, False), "not part of algorithm 2"
            )
            for name in ("elite_reuse", "antithetic", "variance_floor", "noise", "restart_below")
        ),
    )
    failing = tuple(c.name for c in conditions if c.holds is False)
    unknown = any(c.holds is None for c in conditions)
    return TheoremConditions(
        False if failing else None if unknown else True, failing, conditions, _ASSUMED
    )


def _polynomial(schedule: Schedule) -> tuple[float, float, float] | None:
    """Scale, power and offset; None for a function."""
    if isinstance(schedule, Polynomial):
        return float(schedule.scale), float(schedule.power), float(schedule.offset)
    return None if callable(schedule) else (float(schedule), 0.0, 0.0)


_FUNCTION = "it is a function with unknown limits"


def _samples_condition(
    hparams: PyTree, num_steps: int | None
) -> tuple[float | None, TheoremCondition]:
    name = "samples grow"
    if hparams.num_samples is None:
        return 0.0, TheoremCondition(name, False, f"n_l is always {hparams.population}")
    polynomial = _polynomial(hparams.num_samples)
    if polynomial is None:
        return None, TheoremCondition(name, None, f"num_samples: {_FUNCTION}")
    scale, power, offset = polynomial
    if not (scale > 0 and power > 0):
        return min(power, 0.0), TheoremCondition(name, False, f"n_l = {scale:g} l^{power:g}")
    full = max(math.floor((hparams.population / scale) ** (1 / power) - offset + SLACK), 0)
    reason = f"n_l ~ l^{power:g} until step {full}, then population={hparams.population}"
    return power, TheoremCondition(name, num_steps is not None and num_steps <= full, reason)


def _rate_conditions(rate: Schedule) -> list[TheoremCondition]:
    names = ("rate in (0, 1]", "rate decreases", "rate vanishes", "rate has an infinite sum")
    polynomial = _polynomial(rate)
    if polynomial is None:
        return [TheoremCondition(name, None, f"rate: {_FUNCTION}") for name in names]
    scale, power, offset = polynomial
    first = scale * (1 + offset) ** power if offset > -1 else math.nan
    decays = power < 0 and scale > 0
    holds = (0 < first <= 1 and power <= 0, decays, decays, power >= -1 and scale > 0)
    reason = f"alpha_l = {scale:g} (l + {offset:g})^{power:g}"
    return [TheoremCondition(name, held, reason) for name, held in zip(names, holds, strict=True)]


def _share_condition(share: Schedule) -> tuple[float | None, TheoremCondition]:
    name = "sample share decays"
    polynomial = (0.0, 0.0, 0.0) if share is None else _polynomial(share)
    if polynomial is None:
        return None, TheoremCondition(name, None, f"sample_share: {_FUNCTION}")
    scale, power, offset = polynomial
    if scale == 0:  # of any order
        return math.inf, TheoremCondition(name, True, "lambda_l = 0")
    first = scale * (1 + offset) ** power if offset > -1 else math.nan
    reason = f"lambda_l = {scale:g} (l + {offset:g})^{power:g}"
    return -power, TheoremCondition(name, power < 0 and 0 <= first <= 1, reason)
