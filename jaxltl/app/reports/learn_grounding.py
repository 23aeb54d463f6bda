"""Report of symbol grounding: the meaning of each symbol, certified probabilities, and the query."""

from __future__ import annotations

from jaxltl.app.reports.page import (
    Report,
    aligned,
    certified,
    number,
    probability,
    rounded_down,
)
from jaxltl.app.wording import Record, Result, many

_HEADER = ("symbol", "meaning", "weight", "alternatives", "decisive steps")
_WORLDS = ("map", "probability", "certified", "maximum", "robust policy, at least")


def _sentence(result: Result) -> str:
    demonstrations = result["demonstrations"]
    kind = "synthetic demonstration" if demonstrations["synthetic"] else "demonstration"
    return (
        f"{many(len(result['grounding']), 'symbol')} of {many(len(result['meanings']), 'possible meaning')}, "
        f"{many(demonstrations['number'], kind)} ({many(demonstrations['pairs'], 'step')}) in "
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


def _values(result: Result) -> Record:
    return {
        "sentence": _sentence(result),
        "tables": (
            ("Grounding", _HEADER, _rows(result)),
            ("Satisfaction probability", _WORLDS, _worlds(result)),
        ),
        "aligned": aligned,
    }


report = Report("grounding", _values)
