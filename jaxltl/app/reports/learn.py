"""One self-contained page about a learned policy: its evidence, figures and pictures."""


from __future__ import annotations

import html
from collections.abc import Iterable, Mapping
from typing import Any

from jaxltl.app.reports.page import (
    certified,
    frame,
    head,
    number,
    place,
    probability,
    spread,
    tiles,
)


def page(
    result: Mapping[str, Any], pictures: Iterable[tuple[str, bytes, str]], task_text: str
) -> str:
    """The report as HTML that needs no other file and no network.

    Args:
      result: as from :func:`jaxltl.app.learn.summary`.
      pictures: title, SVG and caption of each.
      task_text: the task file, shown at the end.
    """
    parts = [
        *head(result, _sentence(result), warnings(result)),
        _tiles(result),
        "<h2>Probability of doing the task</h2>",
        _evidence_table(result),
        "<h2>What was learned</h2>",
        _weights_table(result),
        _seeds(result),
    ]
    return frame(result, parts, pictures, task_text)


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
    for title, key in (("learned policy", "satisfaction"), ("best achievable", "best_achievable")):
        for what in ("mean", "minimum"):
            entry = result[key][what]
            where = place(entry) if what == "minimum" else ""
            lines.append(
                f"  {title:16} {what:8} {probability(entry['value']):>9}   certified "
                f"{certified(entry):15} {where}".rstrip()
            )
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


def _evidence_table(result: Mapping[str, Any]) -> str:
    rows = []
    for title, key in (("learned policy", "satisfaction"), ("best achievable", "best_achievable")):
        for what in ("mean", "minimum"):
            entry = result[key][what]
            where = place(entry) if what == "minimum" else ""
            rows.append(
                f"<tr><td>{title}, {what}</td><td>{probability(entry['value'])}</td>"
                f"<td>{certified(entry)}</td>"
                f"<td>{html.escape(where)}</td><td>{result[key]['status'].lower()}</td></tr>"
            )
    return (
        "<div class=scroll><table><thead><tr><th></th><th>probability</th><th>certified</th>"
        "<th>where</th><th>solver</th></tr></thead><tbody>"
        + "".join(rows) + "</tbody></table></div>"
        "<p class=muted>The true probability is certified to be that close.</p>"
    )


def _weights_table(result: Mapping[str, Any]) -> str:
    names = "".join(f"<th>{html.escape(n)}</th>" for n in result["weights"])
    values = "".join(f"<td>{number(v)}</td>" for v in result["weights"].values())
    return (
        f"<div class=scroll><table><thead><tr><th>feature</th>{names}</tr></thead>"
        f"<tbody><tr><td>weight</td>{values}</tr></tbody></table></div>"
    )


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
