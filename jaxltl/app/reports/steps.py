"""Expected steps to satisfaction in reports: certified bounds, Pareto front, and picture."""

from __future__ import annotations

import math

import numpy as np

from jaxltl.algos.common.guarantees import StepBound, neg_log_likelihood
from jaxltl.plot.drawing import Picture, drawing
from jaxltl.app.reports.page import number, probability
from jaxltl.app.wording import Record, Result, bounds_of, enclosure
from jaxltl.core.models import Product
from jaxltl.core.values.undiscounted.mixture import Mixture
from jaxltl.core.values.undiscounted.satisfaction_steps import Quickest, StepAnalysis, steps_front

_SHARES = np.linspace(0, 0.9, 7)  # of the quickest policy, in the trade-off with the likelihood
_PRINTED = 5  # vertices of the front in the terminal
_DRAWN = 20  # largest multiple of the quickest policy's steps in the picture
_NARROW = 1e-4  # relative width of bounds that are printed as an error


def entry(
    model: Product, bound: StepBound, before: np.ndarray, mixture: Mixture, counts: np.ndarray
) -> Record:
    """The steps of a policy, its trade-off with the likelihood, and the front of the task.

    Args:
      before: ``float[S, Q, A]``, the policy before mixing.
      counts: ``float[S, Q, A]``, of demonstrated pairs.
    """
    clock = StepAnalysis(model)
    learned = mixture.steps or clock.steps(mixture.policy)
    record: Record = {
        "until": "the formula is decided" if model.automaton.is_cosafe else "acceptance",
        "learned": learned.value,
        "learned_bounds": [learned.lower, learned.upper],
        "quickest": bound.quickest.steps.value,
        "quickest_bounds": [bound.quickest.steps.lower, bound.quickest.steps.upper],
        "least": bound.quickest.least,
        "quickest_status": bound.quickest.status.name,
        "limit": bound.limit,
        "factor": bound.factor if np.isfinite(bound.limit) else None,
        "share": mixture.share,
        "status": learned.status.name,
    }
    shares = [0.0] if np.isinf(bound.limit) else sorted({*_SHARES.tolist(), mixture.share})
    mixed = [(x, (1 - x) * before + x * bound.anchor) for x in shares]
    record["likelihood"] = [
        {
            "share": share,
            "steps": bounds_of(clock.steps(policy)),
            "neg_log_likelihood": neg_log_likelihood(policy, counts),
        }
        for share, policy in mixed
    ]
    if model.automaton.is_cosafe:
        record["front"] = front_entry(model, bound.quickest)
    return record


def front_entry(model: Product, quickest: Quickest | None = None) -> list[Record]:
    """The front of probability and steps of a co-safe task."""
    return [
        {"probability": enclosure(*one.probability), "steps": enclosure(*one.steps)}
        for one in steps_front(model, quickest)
    ]


def heading(steps: Result) -> str:
    """Title of the numbers of steps."""
    if steps["limit"] is None:
        bound = ", not bounded"
    elif steps["factor"] is None:
        bound = f", at most {number(steps['limit'])}"
    else:
        which = "the quickest" if _is_quickest(steps) else "a quick"
        bound = f", at most {steps['factor']:g} times those of {which} optimal policy"
    cosafe = steps["until"] == "the formula is decided"
    until = steps["until"] if cosafe else "acceptance, and between two rounds of it"
    return f"expected steps until {until}{bound}"


def rows(steps: Result) -> list[tuple[str, str, str]]:
    """Policy, expected steps and certificate."""
    table = [
        (title, spent(steps[key]), _certified(steps[key], *steps[f"{key}_bounds"]))
        for title, key in (("learned policy", "learned"), ("quickest optimum", "quickest"))
    ]
    if not _is_quickest(steps):  # a quicker one is not excluded
        _, value, certificate = table[1]
        least = f"{certificate}; the quickest takes at least {number(steps['least'])}"
        table[1] = ("a quick optimum", value, least)
    return table


def _is_quickest(steps: Result) -> bool:
    """True if the bounds of the quickest optimal policy meet."""
    return bool(steps.get("quickest_status", "CONVERGED") == "CONVERGED")


def front_rows(steps: Result) -> list[tuple[str, str, str]]:
    """Maximal probability, its expected steps, and their certificate."""
    names = ("value", "lower", "upper")
    front = (
        (x["probability"]["value"], *map(x["steps"].get, names)) for x in steps.get("front", ())
    )
    return [(probability(p), spent(n), _certified(n, low, high)) for p, n, low, high in front]


def lines(steps: Result | None) -> list[str]:
    """The numbers for the terminal."""
    if steps is None:
        return []
    text = [
        "",
        heading(steps),
        *(f"  {title:25} {value:>9}   certified {bounds}" for title, value, bounds in rows(steps)),
    ]
    return text + trade_off(steps)


def trade_off(steps: Result) -> list[str]:
    """A line on the steps of smaller probabilities."""
    others = [f"{p} in {n}" for p, n, _ in front_rows(steps)[1:]]
    more = ", ..." if len(others) > _PRINTED else ""
    return [f"  for less probability      {', '.join(others[:_PRINTED])}{more}"] if others else []


def pictures(steps: Result | None) -> list[Picture]:
    """The front of probability and steps, and the likelihood against steps."""
    if steps is None:
        return []
    panels = {}
    front = steps.get("front", ())
    if len(front) > 1:
        ends = [x["probability"] for x in front]
        value, half = [x["value"] for x in ends], [(x["upper"] - x["lower"]) / 2 for x in ends]
        panels["maximal satisfaction probability"] = {
            "all policies": ([x["steps"]["value"] for x in front], value, half)
        }
    largest = _DRAWN * max(steps["quickest"] or 0, 1)
    curve = [
        (x["steps"]["value"], x["neg_log_likelihood"])
        for x in steps["likelihood"]
        if x["neg_log_likelihood"] is not None and (x["steps"]["value"] or math.inf) <= largest
    ]
    if len(curve) > 1:
        spent, loss = zip(*sorted(curve), strict=True)
        panels["negative log-likelihood"] = {
            "shares of the quick policy": (list(spent), list(loss), [0.0] * len(curve))
        }
    if not panels:
        return []
    text = "Probabilities and steps on and below the first line are attained by some policy."
    if steps["likelihood"]:
        text += (
            " The second line is the likelihood of the demonstrations when a share of the quick "
            "policy is mixed into the learned one."
        )
    bands = drawing("bands", {"": panels}, label="expected steps")
    return [Picture("steps.svg", "Probability, steps and likelihood", bands, text)]


def spent(value: float | None) -> str:
    """The text of a number of expected steps."""
    return "unbounded" if value is None else number(value)


def _certified(value: float | None, lower: float | None, upper: float | None) -> str:
    if value is None or lower is None or upper is None:
        return "no bounds" if lower is None else f"at least {number(lower)}"
    if upper - lower <= _NARROW * max(value, 1):
        return f"within {max(upper - value, value - lower):.1e}"
    return f"in [{number(lower)}, {number(upper)}]"
