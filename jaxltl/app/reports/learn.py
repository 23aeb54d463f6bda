"""Report of inverse reinforcement learning: satisfaction probabilities, weights, and remarks."""

from __future__ import annotations

import math
from collections.abc import Sequence

from markupsafe import Markup

from jaxltl.app.reports import steps
from jaxltl.app.reports.drawing import Picture
from jaxltl.app.reports.figures import (
    Remark,
    certified,
    mean_deviation,
    number,
    probability,
    remark_lines,
    rounded_down,
)
from jaxltl.app.reports.page import Part, render_page
from jaxltl.app.wording import Result, many, place


_SHORTFALL = 0.01  # relative loss of satisfaction probability that is reported
_OPTIMAL = 1e-6  # certified loss up to which a policy is reported as optimal
_NEGLIGIBLE = 0.05  # weight without a reported meaning
_SLOW = 10  # ratio to the quickest policy's steps that is reported


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
    shown, training, seeds = result["demonstrations"], result["training"], result["seeds"]
    dropped = f", {shown['dropped']} unfinished dropped" if shown["dropped"] else ""
    kind = "synthetic demonstration" if shown["synthetic"] else "demonstration"
    weights = _weights(result)
    width = max(len(name) for name, _, _ in weights)
    lines = [
        f"{result['task']}: {result['num_states']} states x {result['num_memory']} memory states, "
        f"{many(shown['number'], kind)} ({many(shown['pairs'], 'pair')}{dropped}), "
        f"{result['method']} in the {result['in']}",
        "",
        f"satisfaction probability{_by_frequencies(result)}, over "
        f"{many(result['satisfaction']['num_starts'], 'initial state')}",
        *(
            f"  {title:16} {kind:8} {value:>9}   certified {bounds:15} {where}".rstrip()
            for title, kind, value, bounds, where, _ in _evidence(result)
        ),
        *([f"  {_guaranteed(result['data'])}"] if "data" in result else []),
        *steps.lines(result["expected_steps"]),
        "",
        f"negative log-likelihood  {_likelihood(result)}",
        "weights",
        *(f"  {name:{width}} {weight:>9}  {meaning}" for name, weight, meaning in weights),
    ]
    if training["converged"]:
        lines.append(
            f"learning                 converged in {training['steps']} steps "
            f"(gradient norm {training['gradient_norm']:.1e})"
        )
    if seeds["number"] > 1:
        lines += [
            "",
            f"over {seeds['number']} seeds ({seeds['converged']} converged; the one of least loss "
            "is above)",
            f"  mean                    {mean_deviation(seeds['mean'])}",
            f"  minimum                 {mean_deviation(seeds['minimum'])}",
            f"  negative log-likelihood {mean_deviation(seeds['neg_log_likelihood'])}",
        ]
    return "\n".join([*lines, *remark_lines(remarks(result))])


def _by_frequencies(result: Result) -> str:
    return " by the log's frequencies" if "data" in result else ""


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
    mean, least = evidence["mean"], evidence["minimum"]
    return probability(mean["value"]) == probability(least["value"])


def _minimum(least: Result) -> tuple[str, str]:
    return probability(least["value"]), f"minimum, from {place(least)}"


def _tiles(result: Result) -> list[tuple[str, str]]:
    learned, best = result["satisfaction"], result["best_achievable"]
    training, data, by = result["training"], result.get("data"), _by_frequencies(result)
    ended = ("good", "converged") if training["converged"] else ("bad", "not converged")
    tiles = [
        (
            probability(learned["mean"]["value"]),
            f"mean probability{by} over {many(learned['num_starts'], 'initial state')}",
        ),
        *([] if _all_equal(learned) else [_minimum(learned["minimum"])]),
        (probability(best["mean"]["value"]), f"maximal mean probability{by}"),
        (
            _likelihood(result),
            Markup('negative log-likelihood; <span class="{}">{}</span> in {} steps').format(
                *ended, training["steps"]
            ),
        ),
    ]
    if data is not None:
        text = (
            f"guaranteed with confidence {data['confidence']:g}, from "
            f"{many(data['samples'], 'logged transition')}, assuming that {data['assumption']}"
        )
        tiles.insert(0, (rounded_down(data["guaranteed"]), text))
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
    """Feature, weight, and the meaning of its sign."""
    return [
        (name, number(weight), meaning(name, weight)) for name, weight in result["weights"].items()
    ]


def meaning(name: str, weight: float | None) -> str:
    """Effect of a weight's sign on the policy, unless the weight is negligible."""
    if weight is None or abs(weight) < _NEGLIGIBLE:
        return "negligible"
    return _MEANINGS[name][weight < 0]


# --- remarks --------------------------------------------------------------------------------


def remarks(result: Result) -> list[Remark]:
    """Remarks on the result, with their kinds."""
    data = result.get("data")
    first = [] if data is None else _log_remarks(data)
    return [*first, *(("warning", text) for text in warnings(result)), *_guarantees(result)]


def _log_remarks(data: Result) -> list[Remark]:
    """The guarantee from a log, the best that another policy could have, and useful samples."""
    text = (
        f"{_guaranteed(data)}. This holds for all transition probabilities that are consistent "
        "with the log; other figures take the log's frequencies as the true probabilities. The "
        "best lower bound that this log gives for any policy is "
        f"{probability(data['best_guaranteed'])} (jaxltl certify computes that policy); with the "
        f"same confidence no policy has more than {probability(data['optimistic'])}."
    )
    found: list[Remark] = [("good" if data["guaranteed"] > 0 else "warning", text)]
    if data["status"] != "CONVERGED":
        text = (
            f"The solver of the log's guarantee ended with {data['status']}; the bound holds, and "
            "may not be tight."
        )
        found.append(("warning", text))
    if data["sample_next"]:
        first = data["sample_next"][0]
        text = (
            f"More samples of {first['action']} in {first['state']} ({first['samples']} so far) "
            f"would raise the guarantee most, by up to {probability(first['gain'])}."
        )
        found.append(("note", text))
    return found


def _guaranteed(data: Result) -> str:
    return (
        f"P >= {rounded_down(data['guaranteed'])} with confidence {data['confidence']:g}, from "
        f"{many(data['samples'], 'logged transition')}, assuming that {data['assumption']}"
    )


def _if_true(remark: Remark) -> Remark:
    """A remark that assumes the log's frequencies; no proof of the true model."""
    kind, text = remark
    return "note" if kind == "good" else kind, (
        f"If the log's frequencies were the truth: {text[0].lower()}{text[1:]}"
    )


def _guarantees(result: Result) -> list[Remark]:
    """The certified properties of the policy, and the demonstrated steps that were left out."""
    found, learned, guarantee = [], result["satisfaction"], result["guarantee"]
    asked, logged = guarantee["asked"], "data" in result
    if asked == "best" and learned["minimum"]["lower"] == 1:
        graph = "By the log's transition graph" if logged else "By the transition graph"
        condition = ", if no other transition is possible" if logged else ""
        text = (
            f"{graph}: from every initial state the policy satisfies the formula with probability "
            f"1, whatever the transition probabilities are{condition}. It takes only actions that "
            "preserve this."
        )
        found.append(("note" if logged else "good", text))
    elif asked != "none":
        remark = (
            _nearly_best(learned["mean"]["lower"], result["best_achievable"]["mean"])
            if asked == "best"
            else ("good", _attained(guarantee))
        )
        found.append(_if_true(remark) if logged else remark)
    if (lost := guarantee.get("left_out")) is not None:
        found.append(("note", _left_out(lost)))
    found += steps.unused(guarantee)
    found += steps.mixing(result["expected_steps"])
    return found + [("note", result[key]) for key in ("remark", "trivial") if result.get(key)]


def _left_out(lost: Result) -> str:
    """The demonstrated steps that were left out, and the reason."""
    subject = f"{lost['steps']} of {lost['of']} demonstrated steps"
    one = lost["steps"] == 1
    if lost["from"] - lost["to"] < 1e-9:  # optimal once, but not if repeated for ever
        reason = (
            f"{'leads' if one else 'lead'} away from the goal and back, which violates the formula "
            "if repeated for ever, and"
        )
        figures = ""
    else:
        reason = f"{'lowers' if one else 'lower'} the maximal satisfaction probability and"
        figures = f": from {probability(lost['from'])} to {probability(lost['to'])}"
    return (
        f"{subject} {reason} {'was' if one else 'were'} left out; first at {place(lost)} "
        f"(demonstration {lost['demonstration']}, step {lost['step']}){figures}."
    )


def _nearly_best(lower: float | None, best: Result) -> Remark:
    """The certified loss of a policy of optimal actions."""
    gap = math.inf if lower is None or best["upper"] is None else best["upper"] - lower
    if gap > _OPTIMAL:
        bound = f"a loss of at most {number(gap)}" if math.isfinite(gap) else "no bound"
        return "warning", (
            "The certified bounds do not separate optimal actions from others that are nearly "
            f"optimal: for the policy {bound} is certified on average."
        )
    return "good", (
        "By construction no policy has a greater satisfaction probability: this one takes only "
        f"actions that preserve the maximum ({probability(best['value'])} on average). A loss of "
        f"at most {number(max(gap, 0.0))} on average is certified."
    )


def _attained(guarantee: Result) -> str:
    """Sentence on the certified and the requested probability."""
    over = "on average" if guarantee["over"] == "mean" else "from the worst initial state"
    text = (
        f"Asked for {probability(guarantee['asked'])} {over}, certified "
        f"{probability(guarantee['attained'])}: "
    )
    share, weight, never = guarantee["share"], guarantee["weight"], guarantee.get("never")
    if share:
        if share == 1:
            text += "the only policy found that attains it is one of optimal actions alone."
            lost = f" It never takes {never} of the demonstrated steps, whose likelihood is then 0."
            return text + lost * bool(never)
        if share > 0.99:
            return f"{text}a share of {1 - share:.2g} of the likeliest policy is left in optimal actions."
        return (
            f"{text}a share of {share:.3g} of optimal actions is mixed into the likeliest policy."
        )
    if weight:
        return f"{text}the weight of the satisfaction probability is mu = {weight:.3g}."
    return f"{text}the likeliest policy attains it without a weight."


def warnings(result: Result) -> list[str]:
    """Warnings about the result, with remedies."""
    found = []
    learned, best = (result[k]["mean"]["value"] for k in ("satisfaction", "best_achievable"))
    if learned < (1 - _SHORTFALL) * best:
        found.append(
            f"The policy satisfies the formula with probability {probability(learned)} where "
            f"{probability(best)} is possible. " + _remedy(result)
        )
    time = result["expected_steps"] or {"quickest": None}
    if time["quickest"] and (time["learned"] or math.inf) > _SLOW * time["quickest"]:
        mean = number(time["learned"]) if time["learned"] else "an unbounded number of"
        found.append(
            f"The policy takes {mean} steps on average where {number(time['quickest'])} suffice: "
            "it repeats rewarded demonstrated actions. Lower the discount in [learner]; with 0 "
            "each action is rewarded on its own."
        )
    starts, total = result["impossible_starts"], result["satisfaction"]["num_starts"]
    if starts:
        listed = "; ".join(place(s) for s in starts[:5]) + ("; ..." if len(starts) > 5 else "")
        no = "By the log, no" if "data" in result else "No"
        found.append(
            f"{no} policy can satisfy the formula from {len(starts)} of {total} initial states: "
            f"{listed}."
        )
    training = result["training"]
    if not training["converged"]:
        reason = f"gradient norm {number(training['gradient_norm'])}"
        if training["solver"] != "CONVERGED":
            reason += f", value solver {training['solver']}"
        found.append(
            f"Learning did not converge in {training['steps']} steps ({reason}): raise steps, "
            "loosen tolerance, or choose another optimizer."
        )
    for key, noun in (
        ("satisfaction", "policy's probability"),
        ("best_achievable", "maximal probability"),
    ):
        if result[key]["status"] != "CONVERGED":
            found.append(
                f"The solver of the {noun} ended with {result[key]['status']}; only its bounds "
                "hold."
            )
    return found


def _remedy(result: Result) -> str:
    if result["in"] == "world":
        return (
            'A learner with in = "product" can have a guarantee: leave out in, goal and progress.'
        )
    if (bound := result["guarantee"].get("remedy")) is not None:
        return (
            f'With guarantee = "best" in [task] at least {probability(bound)} is certified: tried.'
        )
    return 'guarantee = "best" in [task] attains it.'
