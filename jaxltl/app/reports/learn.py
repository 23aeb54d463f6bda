"""One self-contained page about a learned policy: its evidence, figures and pictures."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping
from typing import Any

from jaxltl.app.files.task import place
from jaxltl.app.reports.live import Said, live_page
from jaxltl.app.reports.page import Remark, certified, number, probability, rows, spread, tiles


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
        "<h2>Probability of doing the task</h2>", _evidence_table(result),
        "<h2>Weights</h2>", _weights_table(result), _seeds(result),
    ]


def remarks(result: Mapping[str, Any]) -> list[Remark]:
    """What the page says first."""
    return [("warning", text) for text in warnings(result)]


def table(result: Mapping[str, Any]) -> str:
    """The result as text for the terminal."""
    shown, training, seeds = result["demonstrations"], result["training"], result["seeds"]
    dropped = f", {shown['dropped']} unfinished dropped" if shown["dropped"] else ""
    lines = [
        f"{result['task']}: {result['num_states']} states x {result['num_memory']} memory states, "
        f"{shown['number']} {'synthetic ' * shown['synthetic']}demonstrations "
        f"({shown['pairs']} pairs{dropped}), {result['method']} in the {result['in']}",
        "",
        "probability of doing the task, over "
        f"{result['satisfaction']['num_starts']} initial states",
    ]
    lines += [
        f"  {title:16} {what:8} {value:>9}   certified {bounds:15} {where}".rstrip()
        for title, what, value, bounds, where, _ in _evidence(result)
    ]
    weights = "  ".join(f"{k} {number(v)}" for k, v in result["weights"].items())
    lines += [
        "",
        f"negative log-likelihood  {number(result['neg_log_likelihood'])}",
        f"weights                  {weights}",
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
    lines += [f"\nwarning: {text}" for text in warnings(result)]
    return "\n".join(lines)


def _sentence(result: Mapping[str, Any]) -> str:
    shown = result["demonstrations"]
    kind = "synthetic demonstrations" if shown["synthetic"] else "demonstrations"
    return (
        f"{html.escape(result['method'])} in the {result['in']}: {result['num_states']} states × "
        f"{result['num_memory']} memory states, {shown['number']} {kind} "
        f"({shown['pairs']} state-action pairs)"
    )


def warnings(result: Mapping[str, Any]) -> list[str]:
    """What a reader must know before trusting the figures, as sentences."""
    found = []
    starts, total = result["impossible_starts"], result["satisfaction"]["num_starts"]
    if starts:
        listed = "; ".join(place(s) for s in starts[:5]) + ("; ..." if len(starts) > 5 else "")
        found.append(
            f"No policy can do the task from {len(starts)} of {total} initial states: {listed}."
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
    for key, what in (("satisfaction", "the policy's probability"),
                      ("best_achievable", "the best achievable probability")):
        if result[key]["status"] != "CONVERGED":
            found.append(
                f"The solver for {what} ended with {result[key]['status']}; only its bounds hold."
            )
    return found


def _tiles(result: Mapping[str, Any]) -> str:
    learned, best = result["satisfaction"], result["best_achievable"]
    training = result["training"]
    how = ("<span class=good>converged</span>" if training["converged"]
           else "<span class=bad>not converged</span>")
    return tiles([
        (probability(learned["mean"]["value"]),
         f"mean probability over {learned['num_starts']} initial states"),
        (probability(learned["minimum"]["value"]),
         f"minimum, from {html.escape(place(learned['minimum']))}"),
        (probability(best["mean"]["value"]), "best achievable mean"),
        (number(result["neg_log_likelihood"]),
         f"negative log-likelihood; {how} in {training['steps']} steps"),
    ])


def _evidence(result: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Whose probability, which, its value, its bounds, where, and how its solver ended."""
    for title, key in (("learned policy", "satisfaction"), ("best achievable", "best_achievable")):
        for what in ("mean", "minimum"):
            entry = result[key][what]
            where = place(entry) if what == "minimum" else ""
            yield (title, what, probability(entry["value"]), certified(entry), where,
                   result[key]["status"].lower())


def _evidence_table(result: Mapping[str, Any]) -> str:
    lines = [(f"{title}, {what}", *rest) for title, what, *rest in _evidence(result)]
    return rows(("", "probability", "certified", "where", "solver"), lines) + (
        "<p class=muted>The true probability is certified to be that close.</p>"
    )


def _weights_table(result: Mapping[str, Any]) -> str:
    weights = result["weights"]
    return rows(("feature", *map(html.escape, weights)),
                [("weight", *(number(v) for v in weights.values()))])


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
