"""Report of inverse reinforcement learning: satisfaction probabilities, weights, and remarks."""

from __future__ import annotations

from collections.abc import Sequence

from markupsafe import Markup

from jaxltl.app.reports import steps
from jaxltl.app.reports.drawing import Picture
from jaxltl.app.reports.figures import Remark, certified, number, probability, rounded_down
from jaxltl.app.reports.page import Part, render_page, render_remarks, render_table
from jaxltl.app.wording import Result, many, place

_OPTIMAL = 1e-6  # certified loss up to which a policy is reported as optimal
_NEGLIGIBLE = 0.05  # weight without a reported meaning


def page(
    result: Result, parts: Sequence[Part], pictures: Sequence[tuple[Picture, bytes]], task_text: str
) -> str:
    """The report in HTML."""
    return render_page(
        "mlirl.html",
        result,
        parts,
        pictures,
        task_text,
        remarks=remarks(result),
        tiles=_tiles(result),
        evidence=[(f"{policy}, {kind}", *rest) for policy, kind, *rest in _evidence(result)],
        weights=_weights(result),
        steps=steps,
    )


def table(result: Result) -> str:
    """The result as text."""
    return render_table(
        "mlirl.txt",
        remarks(result),
        result=result,
        evidence=_evidence(result),
        weights=_weights(result),
        likelihood=_likelihood(result),
        guaranteed=_guaranteed(result),
        steps=steps,
    )


def _evidence(result: Result) -> list[tuple[str, ...]]:
    """Policy, mean or minimum, probability, certificate, initial state, status of the solver."""
    return [
        (
            title,
            kind,
            probability(result[key][kind]["value"]),
            certified(result[key][kind]),
            place(result[key][kind]) if kind == "minimum" else "",
            result[key]["status"].lower(),
        )
        for title, key in (("learned policy", "satisfaction"), ("optimum", "best_achievable"))
        for kind in ("mean", "minimum")
        if kind == "mean" or not _all_equal(result[key])
    ]


def _likelihood(result: Result) -> str:
    """The negative log-likelihood, infinite if a demonstrated step has probability 0."""
    never = result["guarantee"].get("never")
    return "infinite" if never else number(result["neg_log_likelihood"])


def _all_equal(evidence: Result) -> bool:
    """True if all initial states have the same probability, to four places."""
    return probability(evidence["mean"]["value"]) == probability(evidence["minimum"]["value"])


def _guaranteed(result: Result, form: str = "P >= {} ") -> str:
    """The guarantee from a log as text; empty for other worlds."""
    if (data := result.get("data")) is None:
        return ""
    return form.format(rounded_down(data["guaranteed"])) + (
        f"with confidence {data['confidence']:g}, from "
        f"{many(data['samples'], 'logged transition')}, assuming that {data['assumption']}"
    )


def _tiles(result: Result) -> list[tuple[str, str]]:
    learned, best = result["satisfaction"], result["best_achievable"]
    training, data = result["training"], result.get("data")
    by = "" if data is None else " by the log's frequencies"
    ended = ("good", "converged") if training["converged"] else ("bad", "not converged")
    least = learned["minimum"]
    tiles = [
        (
            probability(learned["mean"]["value"]),
            f"mean probability{by} over {many(learned['num_starts'], 'initial state')}",
        ),
        (probability(least["value"]), f"minimum, from {place(least)}"),
        (probability(best["mean"]["value"]), f"maximal mean probability{by}"),
        (
            _likelihood(result),
            Markup('negative log-likelihood; <span class="{}">{}</span> in {} steps').format(
                *ended, training["steps"]
            ),
        ),
    ]
    if _all_equal(learned):
        del tiles[1]
    if data is not None:
        tiles.insert(0, (rounded_down(data["guaranteed"]), _guaranteed(result, "guaranteed ")))
    return tiles


_MEANINGS = {
    "demonstrated": ("takes demonstrated actions", "avoids demonstrated actions"),
    "goal": ("moves to goal states", "avoids goal states"),
    "progress": ("moves on in the automaton", "avoids progress in the automaton"),
    "accepting": ("moves to accepting transitions", "avoids accepting transitions"),
    "avoid": ("avoids these states", "moves to these states"),
    "time": ("prefers short episodes", "prefers long episodes"),
    "nearer": ("takes short paths", "takes long paths"),
}


def _weights(result: Result) -> list[tuple[str, str, str]]:
    """Feature, weight, and the effect of its sign on the policy unless it is negligible."""
    return [
        (
            name,
            number(x),
            "negligible" if x is None or abs(x) < _NEGLIGIBLE else _MEANINGS[name][x < 0],
        )
        for name, x in result["weights"].items()
    ]


def remarks(result: Result) -> list[Remark]:
    """Remarks on the result, with their kinds."""
    learned, best = (result[k]["mean"] for k in ("satisfaction", "best_achievable"))
    known = learned["lower"] is not None and best["upper"] is not None
    return [
        *render_remarks(
            "mlirl_remarks.txt",
            result=result,
            guaranteed=_guaranteed(result),
            gap=best["upper"] - learned["lower"] if known else None,
            optimal=_OPTIMAL,
        ),
        *steps.unused(result["guarantee"]),
        *steps.mixing(result["expected_steps"]),
        *(("note", result[key]) for key in ("remark", "trivial") if result.get(key)),
    ]
