"""Report of symbol grounding: the meaning of each symbol, certified probabilities, and the query."""

from __future__ import annotations

from collections.abc import Sequence

from jaxltl.app.reports.drawing import Picture
from jaxltl.app.reports.figures import (
    Remark,
    certified,
    number,
    probability,
    remark_lines,
    rounded_down,
)
from jaxltl.app.reports.page import Part, render_page
from jaxltl.app.wording import Result, many, place

_HEADER = ("symbol", "meaning", "weight", "alternatives", "decisive steps")
_WORLDS = ("map", "probability", "certified", "maximum", "robust policy, at least")


def page(
    result: Result, parts: Sequence[Part], pictures: Sequence[tuple[Picture, bytes]], task_text: str
) -> str:
    """The report in HTML."""
    return render_page(
        "grounding.html",
        result,
        parts,
        pictures,
        task_text,
        sentence=_sentence(result),
        remarks=remarks(result),
        tables=(
            ("Grounding", _HEADER, _rows(result)),
            ("Satisfaction probability", _WORLDS, _worlds(result)),
        ),
    )


def table(result: Result) -> str:
    """The result as text."""
    lines = [f"{result['task']}: {_sentence(result)}", ""]
    for header, rows in ((_HEADER, _rows(result)), (_WORLDS, _worlds(result))):
        width = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
        for row in (header, *rows):
            lines.append("  ".join(x.ljust(n) for x, n in zip(row, width, strict=True)).rstrip())
        lines.append("")
    return "\n".join([*lines[:-1], *remark_lines(remarks(result))])


def _sentence(result: Result) -> str:
    shown = result["demonstrations"]
    kind = "synthetic demonstration" if shown["synthetic"] else "demonstration"
    return (
        f"{many(len(result['grounding']), 'symbol')} of {many(len(result['meanings']), 'possible meaning')}, "
        f"{many(shown['number'], kind)} ({many(shown['pairs'], 'step')}) in "
        f"{many(result['num_demonstrated'], 'map')}"
    )


def _rows(result: Result) -> list[tuple[str, ...]]:
    return [
        (
            row["symbol"],
            row["meaning"],
            probability(row["weight"]),
            ", ".join(f"{x} {probability(w)}" for x, w in row["alternatives"][:2]) or "none",
            "; ".join(
                f"map {x['map']} demonstration {x['demonstration']} step {x['step']} (+{number(x['gain'])})"
                for x in row["steps"]
            )
            or "none",
        )
        for row in result["grounding"]
    ]


def _worlds(result: Result) -> list[tuple[str, ...]]:
    return [
        (
            str(w),
            probability(world["attained"]["value"]),
            certified(world["attained"]),
            probability(world["best_achievable"]["value"]),
            "the same" if world["robust"] is None else rounded_down(world["robust"]["worst"]),
        )
        for w, world in enumerate(result["worlds"], start=1)
    ]


def remarks(result: Result) -> list[Remark]:
    """Remarks on the grounding: undecided symbols, the query, and solvers without a proof."""
    found: list[Remark] = []
    credible, query = result["credible_set"], result["query"]
    for symbol, meanings in result["ambiguous"].items():
        text = f"The demonstrations do not decide what {symbol} means: {' or '.join(meanings)}."
        found.append(("warning", text))
    if credible["number"] == 1:
        text = f"One grounding has a posterior weight of {probability(result['groundings'][0]['weight'])}."
        found.append(("good", text))
    else:
        text = (
            f"{credible['number']} groundings have a posterior weight of {credible['level']:g} "
            f"together. The robust policy has the certified probability under each of the likeliest "
            f"{len(result['groundings'])}, of weight {probability(credible['robust_weight'])}."
        )
        found.append(("note", text))
    if query["information"] > 1e-3:
        answers = "; ".join(
            f"{', '.join(x['symbols']) or 'no symbol'} {probability(x['weight'])}"
            for x in query["labels"][:4]
        )
        text = (
            f"Query: the label of {place(query)} of map {query['map']} gives most information "
            f"({query['information']:.3f} nats). Possible answers: {answers}."
        )
        found.append(("note", text))
    if not result["complete"]:
        found.append(("note", "Only a beam of the possible groundings was weighed."))
    for w, world in enumerate(result["worlds"], start=1):
        for key, noun in (("attained", "policy's"), ("best_achievable", "maximal")):
            if world[key]["status"] != "CONVERGED":
                text = f"The solver of the {noun} probability in map {w} ended with {world[key]['status']}."
                found.append(("warning", text))
    return found
