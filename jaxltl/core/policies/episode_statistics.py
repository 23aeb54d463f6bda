"""Statistics of simulated episodes: success frequencies and means with confidence intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Array
from jaxltl.core.automata.runs import Verdict
from jaxltl.core.pretty_print import brief
from jaxltl.core.statistics.binomial import anytime, bounded_mean, clopper_pearson
from jaxltl.core.status import Status


@brief
class EpisodeTotals(NamedTuple):
    """Totals of one episode, or of many with a leading axis.

    Attributes:
      reward, cost: sums of the rewards and of the costs.
      discounted_reward: with the discount, and that of the environment.
      length: ``int32``, number of steps.
      terminated, truncated: kind of end; neither if it was cut off.
      verdict: ``int32``, the task's :class:`~jaxltl.environments.Verdict` at the end; None without a task.
      visits: ``int32``, accepting readings, that of the first label included; None without.
      discounted_visits: the k-th reading, from 0, counts ``discount ** k``.

    >>> zero = np.zeros(4)
    >>> EpisodeTotals(zero, zero, zero, zero + 3, zero, zero, None, None, None).length.tolist()
    [3.0, 3.0, 3.0, 3.0]
    """

    reward: Array
    discounted_reward: Array
    cost: Array
    length: Array
    terminated: Array
    truncated: Array
    verdict: Array | None
    visits: Array | None
    discounted_visits: Array | None


@brief
@dataclass(frozen=True)
class Estimate:
    """A frequency or a mean with its confidence interval.

    Attributes:
      mean: over the episodes; a share is in [0, 1].
      lower, upper: ends of the interval.
      error: the standard error of the mean.
      method: the statistical method of the interval.

    >>> found = frequency_estimate(8, 10, 0.05)
    >>> found.mean, round(found.lower, 3), round(found.upper, 3)
    (0.8, 0.444, 0.975)
    """

    mean: float
    lower: float
    upper: float
    error: float
    method: str


@brief
@dataclass(frozen=True)
class Evaluation:
    """Result of :func:`evaluate`; printed as a table.

    Attributes:
      success, violation, undecided: shares of the episodes, by the task's verdict at their end;
        None without a task.
      reward, discounted_reward, cost: of an episode; the second None without a discount.
      length: steps of an episode.
      visits, discounted_visits: accepting readings of an episode, see :class:`EpisodeTotals`; None
        without a task, or without a discount.
      terminated, truncated, cut_off: numbers of episodes with each end.
      num_episodes: number of simulated episodes.
      num_steps, confidence, threshold, discount: the arguments.
      decision: True if the success probability is at least the threshold, False if it is below, None
        if undecided or without a threshold.
      status: CONVERGED; MAX_STEPS if a threshold was not decided; NONFINITE if a sum was not finite.

    >>> reward, codes = np.array([0.0, 1.0, 1.0]), np.array([2, 1, 1])  # violated, satisfied
    >>> ended = np.ones(3, bool)
    >>> totals = EpisodeTotals(reward, reward, 0 * reward, ended * 4, ended, ~ended, codes, None, None)
    >>> found = evaluation_of(totals, num_steps=9, confidence=0.9)
    >>> round(found.success.lower, 3), found.success.method, found.terminated, found.status.name
    (0.135, 'Clopper-Pearson', 3, 'CONVERGED')
    """

    success: Estimate | None
    violation: Estimate | None
    undecided: Estimate | None
    reward: Estimate
    discounted_reward: Estimate | None
    cost: Estimate
    length: Estimate
    visits: Estimate | None
    discounted_visits: Estimate | None
    terminated: int
    truncated: int
    cut_off: int
    num_episodes: int
    num_steps: int
    confidence: float
    threshold: float | None
    discount: float | None
    decision: bool | None
    status: Status

    def __str__(self) -> str:
        lines = [
            f"{self.num_episodes:,} episodes of at most {self.num_steps:,} steps; each interval "
            f"holds with {self.confidence:g}"
        ]
        rows = [
            (name.replace("_", " "), f"{x.mean:.6g}", f"[{x.lower:.6g}, {x.upper:.6g}]", x.method)
            for name in ESTIMATES
            if (x := getattr(self, name)) is not None
        ]
        widths = [max(len(row[i]) for row in rows) for i in range(3)]
        lines += [
            "  " + "  ".join((*(c.ljust(n) for c, n in zip(row, widths, strict=False)), row[3]))
            for row in rows
        ]
        lines.append(
            f"  ended: {self.terminated:,} terminated, {self.truncated:,} truncated, "
            f"{self.cut_off:,} cut off"
        )
        if self.threshold is not None:
            said = {None: "open whether success is", True: "success is", False: "success is not"}
            lines.append(f"  {said[self.decision]} at least {self.threshold:g}")
        if self.status == Status.NONFINITE:
            lines.append("  a reward or a cost is not finite")
        return "\n".join(lines)


_SHARES = {
    "success": Verdict.SATISFIED,
    "violation": Verdict.VIOLATED,
    "undecided": Verdict.UNDECIDED,
}
_MEANS = ("reward", "discounted_reward", "cost", "length", "visits", "discounted_visits")
ESTIMATES = (*_SHARES, *_MEANS)


def evaluation_of(
    totals: EpisodeTotals,
    num_steps: int,
    confidence: float,
    threshold: float | None = None,
    discount: float | None = None,
    decision: bool | None = None,
) -> Evaluation:
    """The :class:`Evaluation` of a batch of episodes on the host."""
    total, failure, fixed = len(totals.length), 1 - confidence, threshold is None
    sums = (totals.reward, totals.discounted_reward, totals.cost)
    fine = all(np.isfinite(x).all() for x in sums)
    status = Status.CONVERGED if fixed or decision is not None else Status.MAX_STEPS
    shares: dict[str, Estimate | None] = dict.fromkeys(_SHARES)
    if totals.verdict is not None:
        shares = {
            name: frequency_estimate(int((totals.verdict == code).sum()), total, failure, fixed)
            for name, code in _SHARES.items()
        }

    def bounded(x: Array | None, low: float, high: float) -> Estimate | None:
        planned = total if fixed else None
        return None if x is None else _bounded_estimate(x, low, high, failure, planned)

    early = None
    if discount is not None:
        # All readings accepting, the first label's included.
        max_visits = (1 - discount ** (num_steps + 1)) / (1 - discount)
        early = bounded(totals.discounted_visits, 0, max_visits)
    length = bounded(totals.length, 1, num_steps)
    assert length is not None
    return Evaluation(
        **shares,
        reward=_mean_estimate(totals.reward, failure),
        discounted_reward=None
        if discount is None
        else _mean_estimate(totals.discounted_reward, failure),
        cost=_mean_estimate(totals.cost, failure),
        length=length,
        visits=bounded(totals.visits, 0, num_steps + 1),
        discounted_visits=early,
        terminated=int(totals.terminated.sum()),
        truncated=int(totals.truncated.sum()),
        cut_off=int((~totals.terminated & ~totals.truncated).sum()),
        num_episodes=total,
        num_steps=num_steps,
        confidence=confidence,
        threshold=threshold,
        discount=discount,
        decision=decision,
        status=status if fine else Status.NONFINITE,
    )


def frequency_estimate(count: int, total: int, failure: float, fixed: bool = True) -> Estimate:
    """Frequency with its interval: exact for a fixed number of trials, or anytime-valid."""
    total = validation.integer("total", total, least=1, limit=2**53)
    count = validation.integer("count", count, limit=total)
    failure = validation.fraction("failure", failure, ends=(False, False))
    ends = clopper_pearson if fixed else anytime
    (lower,), (upper,) = ends(np.array([count]), np.array([total]), failure)
    share = count / total
    return Estimate(
        share,
        float(lower),
        float(upper),
        math.sqrt(share * (1 - share) / total),
        "Clopper-Pearson" if fixed else "Jeffreys' mixture, at any time",
    )


def _mean_estimate(x: Array, failure: float) -> Estimate:
    from scipy.special import stdtrit  # a tenth of a second

    mean, error = _mean_error(x)
    margin = float(stdtrit(len(x) - 1, 1 - failure / 2)) * error if len(x) > 1 else math.inf
    return Estimate(mean, mean - margin, mean + margin, error, "central limit theorem")


def _bounded_estimate(
    x: Array, low: float, high: float, failure: float, planned: int | None
) -> Estimate:
    mean, error = _mean_error(x)
    size = high - low
    if not size:
        return Estimate(mean, low, high, error, "exact")
    lower, upper = bounded_mean((np.asarray(x, np.float64) - low) / size, failure, planned=planned)
    method = "empirical Bernstein" + (", at any time" if planned is None else "")
    return Estimate(mean, low + size * lower, low + size * upper, error, method)


def _mean_error(x: Array) -> tuple[float, float]:
    """The mean and its standard error, which is infinite for one number."""
    x = np.asarray(x, np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        error = float(x.std(ddof=1)) / math.sqrt(len(x)) if len(x) > 1 else math.inf
        return float(x.mean()), error
