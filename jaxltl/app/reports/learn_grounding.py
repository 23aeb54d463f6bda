"""Report of symbol grounding: the meaning of each symbol, certified probabilities, and the query."""

from __future__ import annotations

from collections.abc import Sequence

from jaxltl.app.reports.drawing import Picture
from jaxltl.app.reports.page import (
    Part,
    Remark,
    aligned,
    certified,
    number,
    probability,
    remark_lines,
    render_page,
    render_remarks,
    rounded_down,
)
from jaxltl.app.wording import Result, many

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
        lines += [*aligned([header, *rows]), ""]
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
    return render_remarks("grounding_remarks.txt", result=result)
