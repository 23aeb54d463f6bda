"""One self-contained page about a learned policy: its evidence, figures and pictures."""

from __future__ import annotations

import html
import math
from collections.abc import Iterator, Mapping
from typing import Any

from jaxltl.app.files.task import many, place
from jaxltl.app.reports.live import Said, live_page
from jaxltl.app.reports.page import (
    Remark,
    certified,
    number,
    probability,
    rows,
    spread,
    tiles,
    told,
)

_SHORT = 0.01  # share of the best probability that may be missing without a word
_PROVEN = 1e-6  # what a policy may be certified to lose and still be called best
_LITTLE = 0.05  # a weight of which nothing is to be said
_LONG = 10  # times the quickest policy's steps, likewise


def page(result: Mapping[str, Any], *shown: Any) -> str:
    """The report of :func:`jaxltl.app.learn.summary`.

    Args:
      result: the summary.
      shown: what moves, pictures and the task file, as for :func:`~.live.live_page`.
    """
    said = Said(_sentence(result), remarks(result), _tiles(result), _told(result))
    return live_page(result, said, *shown)


def _told(result: Mapping[str, Any]) -> list[str]:
    """What stands after the policies."""
    return [
        f"<h2>Probability of doing the task{_by_frequencies(result)}</h2>",
        _evidence_table(result),
        "<h2>Weights</h2>",
        _weights_table(result),
        _seeds(result),
    ]


def remarks(result: Mapping[str, Any]) -> list[Remark]:
    """What the page says first."""
    data = result.get("data")
    first = [] if data is None else _of_log(data)
    return [*first, *(("warning", text) for text in warnings(result)), *_notes(result)]


def _of_log(data: Mapping[str, Any]) -> list[Remark]:
    """What a log guarantees, what another policy could have, and where more of it would help."""
    found: list[Remark] = [
        (
            "good" if data["guaranteed"] > 0 else "warning",
            (
                f"{_guaranteed(data)}. That is what the log guarantees of this policy, whatever the "
                "probabilities are that it leaves possible; other figures are by the log's frequencies, "
                "as if they were the truth. The best that could be guaranteed by this log is "
                f"{probability(data['best_guaranteed'])}, by the policy of jaxltl certify; no policy has "
                f"more than {probability(data['optimistic'])}, with the same confidence."
            ),
        )
    ]
    if data["status"] != "CONVERGED":
        found.append(
            (
                "warning",
                (
                    f"The solver for what the log guarantees ended with {data['status']}; it holds, and "
                    "may be less than could be shown."
                ),
            )
        )
    if data["sample_next"]:
        first = data["sample_next"][0]
        found.append(
            (
                "note",
                (
                    f"More samples of {first['action']} in {first['state']} ({first['samples']} so far) "
                    "would raise what can be guaranteed most, by up to "
                    f"{probability(first['gain'])}."
                ),
            )
        )
    return found


def _guaranteed(data: Mapping[str, Any]) -> str:
    return (
        f"P >= {math.floor(data['guaranteed'] * 1e4) / 1e4:.4f} with confidence "
        f"{data['confidence']:g}, from {many(data['samples'], 'logged transition')}"
    )


def _if_true(said: Remark) -> Remark:
    """What is proven of a log's frequencies is proven of nothing else."""
    kind, text = said
    return "note" if kind == "good" else kind, (
        f"If the log's frequencies were the truth: {text[0].lower()}{text[1:]}"
    )


def _by_frequencies(result: Mapping[str, Any]) -> str:
    return " by the log's frequencies" if "data" in result else ""


def _notes(result: Mapping[str, Any]) -> list[Remark]:
    """What holds of the policy and why, and what was left out for it."""
    found, best, learned = [], result["best_achievable"], result["satisfaction"]
    asked, logged = result["guarantee"]["asked"], "data" in result
    if asked == "best":
        if learned["minimum"]["lower"] == 1:
            graph = "By the graph, which is what the log showed" if logged else "By the graph"
            found.append(
                (
                    "note" if logged else "good",
                    (
                        f"{graph}: from every initial state the policy does the task with probability "
                        "1, whatever the numbers"
                        + (", if no move leads where the log never saw it lead" if logged else "")
                        + ". It takes moves that keep that possible, and no others."
                    ),
                )
            )
        else:
            said = _nearly_best(learned["mean"]["lower"], best["mean"])
            found.append(_if_true(said) if logged else said)
    elif asked != "none":
        reached = "good", _asked(result["guarantee"])
        found.append(_if_true(reached) if logged else reached)
    if (lost := result["guarantee"].get("left_out")) is not None:
        found.append(("note", _left_out(lost)))
    found += [("note", result[key]) for key in ("remark", "trivial") if result.get(key)]
    return found


def _left_out(lost: Mapping[str, Any]) -> str:
    """Which demonstrated steps were not learned from, and why not."""
    one = lost["steps"] == 1
    why, figures = (
        f"{'lowers' if one else 'lower'} the best probability",
        (f": from {probability(lost['from'])} to {probability(lost['to'])}"),
    )
    if lost["from"] - lost["to"] < 1e-9:  # by itself it loses nothing
        why = (
            f"{'leaves' if one else 'leave'} what does the task and may come back, which again "
            "and again would fail it,"
        )
        figures = ""
    return (
        f"{lost['steps']} of {lost['of']} demonstrated steps {why} and {'was' if one else 'were'} "
        f"left out; first at {place(lost)} (demonstration {lost['demonstration']}, step "
        f"{lost['step']}){figures}."
    )


def _nearly_best(lower: float | None, best: Mapping[str, Any]) -> Remark:
    """How near to the best probability the policy is proven to be; it may be no proof of best."""
    gap = math.inf if lower is None or best["upper"] is None else best["upper"] - lower
    if gap > _PROVEN:
        how = f"to lose at most {number(gap)}" if math.isfinite(gap) else "of nothing"
        return "warning", (
            "Bounds do not tell the moves that preserve the best probability from others that are "
            f"near to it: the policy is certified {how} on average."
        )
    return "good", (
        "By construction no policy does the task with a greater probability: this one takes moves "
        f"that preserve the best one ({probability(best['value'])} on average), and no others. "
        f"It is certified to lose at most {number(max(gap, 0.0))} on average."
    )


def _asked(guarantee: Mapping[str, Any]) -> str:
    """How a probability that was asked for was reached."""
    over = "on average" if guarantee["over"] == "mean" else "from the worst initial state"
    text = (
        f"Asked for {probability(guarantee['asked'])} {over}, certified "
        f"{probability(guarantee['attained'])}: "
    )
    share, weight = guarantee["share"], guarantee["weight"]
    if share:
        other = "moves that lose nothing" if weight is None else f"the policy of mu = {weight:.3g}"
        if share == 1:
            return f"{text}no policy was found to reach it but one of {other} alone."
        if share > 0.99:
            return f"{text}a share of {1 - share:.2g} of the likeliest policy is left in {other}."
        return f"{text}a share of {share:.3g} of {other} is mixed into the likeliest policy."
    if weight:
        return f"{text}the least weight of the task that reaches it is mu = {weight:.3g}."
    return f"{text}the likeliest policy does that by itself."


def table(result: Mapping[str, Any]) -> str:
    """The result as text for the terminal."""
    shown, training, seeds = result["demonstrations"], result["training"], result["seeds"]
    dropped = f", {shown['dropped']} unfinished dropped" if shown["dropped"] else ""
    lines = [
        f"{result['task']}: {result['num_states']} states x {result['num_memory']} memory states, "
        f"{many(shown['number'], 'synthetic ' * shown['synthetic'] + 'demonstration')} "
        f"({many(shown['pairs'], 'pair')}{dropped}), {result['method']} in the {result['in']}",
        "",
        f"probability of doing the task{_by_frequencies(result)}, over "
        f"{many(result['satisfaction']['num_starts'], 'initial state')}",
    ]
    lines += [
        f"  {title:16} {what:8} {value:>9}   certified {bounds:15} {where}".rstrip()
        for title, what, value, bounds, where, _ in _evidence(result)
    ]
    if "data" in result:
        lines.append(f"  {_guaranteed(result['data'])}")
    weights = result["weights"]
    width = max(map(len, weights))
    lines += [
        "",
        f"negative log-likelihood  {number(result['neg_log_likelihood'])}",
        "weights",
        *(
            f"  {name:{width}} {number(weight):>9}  {meaning(name, weight)}"
            for name, weight in weights.items()
        ),
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
            f"  mean                    {spread(seeds['mean'])}",
            f"  minimum                 {spread(seeds['minimum'])}",
            f"  negative log-likelihood {spread(seeds['neg_log_likelihood'])}",
        ]
    return "\n".join([*lines, *told(remarks(result))])


def _sentence(result: Mapping[str, Any]) -> str:
    shown = result["demonstrations"]
    kind = "synthetic demonstration" if shown["synthetic"] else "demonstration"
    return (
        f"{html.escape(result['method'])} in the {result['in']}: {result['num_states']} states × "
        f"{result['num_memory']} memory states, {many(shown['number'], kind)} "
        f"({many(shown['pairs'], 'state-action pair')})"
    )


def warnings(result: Mapping[str, Any]) -> list[str]:
    """What a reader must know before trusting the figures, as sentences."""
    found = []
    learned, best = (result[k]["mean"] for k in ("satisfaction", "best_achievable"))
    if learned["value"] < (1 - _SHORT) * best["value"]:
        found.append(
            f"The policy does the task with probability {probability(learned['value'])} where "
            f"{probability(best['value'])} is possible. " + _remedy(result)
        )
    steps = result["expected_steps"] or {"quickest": None}
    if steps["quickest"] and (steps["learned"] or math.inf) > _LONG * steps["quickest"]:
        much = f"{number(steps['learned'])}" if steps["learned"] else "more than can be told"
        found.append(
            f"The policy takes {much} steps on average where {number(steps['quickest'])} would "
            "do: it goes round where it earns what was shown again and again. A smaller discount "
            "in [learner] helps; with 0 each action counts for itself."
        )
    starts, total = result["impossible_starts"], result["satisfaction"]["num_starts"]
    if starts:
        listed = "; ".join(place(s) for s in starts[:5]) + ("; ..." if len(starts) > 5 else "")
        none = "By what the log showed, no" if "data" in result else "No"
        found.append(
            f"{none} policy can do the task from {len(starts)} of {total} initial states: {listed}."
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
    for key, what in (
        ("satisfaction", "the policy's probability"),
        ("best_achievable", "the best achievable probability"),
    ):
        if result[key]["status"] != "CONVERGED":
            found.append(
                f"The solver for {what} ended with {result[key]['status']}; only its bounds hold."
            )
    return found


def _remedy(result: Mapping[str, Any]) -> str:
    if result["in"] == "world":
        return 'A learner in = "product" can be held to it: leave out in, goal and progress.'
    if (tried := result["guarantee"].get("remedy")) is not None:
        return (
            'With guarantee = "best" in [task] it is certified to be at least '
            f"{probability(tried)}: tried."
        )
    return 'guarantee = "best" in [task] attains it.'


def _tiles(result: Mapping[str, Any]) -> str:
    learned, best = result["satisfaction"], result["best_achievable"]
    training = result["training"]
    how = (
        "<span class=good>converged</span>"
        if training["converged"]
        else "<span class=bad>not converged</span>"
    )
    data = result.get("data")
    sure = (
        []
        if data is None
        else [
            (
                probability(math.floor(data["guaranteed"] * 1e4) / 1e4),
                f"guaranteed with confidence {data['confidence']:g}, from "
                f"{many(data['samples'], 'logged transition')}",
            )
        ]
    )
    by = _by_frequencies(result)
    return tiles(
        [
            *sure,
            (
                probability(learned["mean"]["value"]),
                f"mean probability{by} over {many(learned['num_starts'], 'initial state')}",
            ),
            (
                probability(learned["minimum"]["value"]),
                f"minimum, from {html.escape(place(learned['minimum']))}",
            ),
            (probability(best["mean"]["value"]), f"best achievable mean{by}"),
            (
                number(result["neg_log_likelihood"]),
                f"negative log-likelihood; {how} in {training['steps']} steps",
            ),
        ]
    )


def _evidence(result: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Whose probability, which, its value, its bounds, where, and how its solver ended."""
    for title, key in (("learned policy", "satisfaction"), ("best achievable", "best_achievable")):
        for what in ("mean", "minimum"):
            entry = result[key][what]
            where = place(entry) if what == "minimum" else ""
            yield (
                title,
                what,
                probability(entry["value"]),
                certified(entry),
                where,
                result[key]["status"].lower(),
            )


def _evidence_table(result: Mapping[str, Any]) -> str:
    lines = [
        (f"{title}, {what}", *map(html.escape, rest)) for title, what, *rest in _evidence(result)
    ]
    true = "The probability" if "data" in result else "The true probability"
    return rows(("policy", "probability", "certified", "where", "solver"), lines) + (
        f"<p class=muted>{true}{_by_frequencies(result)} is certified to be that close.</p>"
    )


def _weights_table(result: Mapping[str, Any]) -> str:
    lines = [
        (html.escape(name), number(weight), meaning(name, weight))
        for name, weight in result["weights"].items()
    ]
    return rows(("feature", "weight", "what it says"), lines)


_MEANING = {
    "demonstrated": ("does what was shown", "does other than what was shown"),
    "goal": ("drawn to where the task is done", "kept away from where the task is done"),
    "progress": ("drawn to the next part of the task", "kept away from the next part of the task"),
    "accepting": ("drawn to what is to be visited again and again", "kept away from it"),
    "avoid": ("kept away from them", "drawn to them"),
    "time": ("hurries", "takes its time"),
    "nearer": ("takes short ways", "takes long ways"),
}


def meaning(name: str, weight: float | None) -> str:
    """What a weight's sign says of the policy; nothing where it hardly weighs."""
    if weight is None or abs(weight) < _LITTLE:
        return "hardly counts"
    return _MEANING[name][weight < 0]


def _seeds(result: Mapping[str, Any]) -> str:
    seeds = result["seeds"]
    if seeds["number"] == 1:
        return ""
    return (
        f"<p class=muted>{seeds['number']} seeds, {seeds['converged']} converged; over them the "
        f"mean probability is {spread(seeds['mean'])}, the minimum {spread(seeds['minimum'])}, the "
        f"negative log-likelihood {spread(seeds['neg_log_likelihood'])}. The seed with the least "
        "loss is shown.</p>"
    )
