"""Report of learning in an environment: estimates from fresh episodes, with intervals."""

from __future__ import annotations

from collections.abc import Sequence

from jaxltl.app.reports import proof
from jaxltl.app.reports.drawing import Picture
from jaxltl.app.reports.page import (
    Part,
    Remark,
    number,
    probability,
    render_page,
    render_remarks,
    render_table,
)
from jaxltl.app.wording import Result, many

_PROBABILITIES = ("success", "violation", "undecided")


def page(
    result: Result, parts: Sequence[Part], pictures: Sequence[tuple[Picture, bytes]], task_text: str
) -> str:
    """The report in HTML."""
    seeds, names = result["seeds"], (*_PROBABILITIES, *_visits(result))
    return render_page(
        "environment.html",
        result,
        parts,
        pictures,
        task_text,
        **_texts(result),
        remarks=remarks(result),
        tiles=_tiles(result),
        seed_header=("seed", *names),
        seed_rows=[
            (
                f"{i}{' (kept)' if i == seeds['kept'] else ''}",
                *(" ".join(_numbers(name, found)) for name in names),
            )
            for i, found in enumerate(seeds["evaluations"])
        ],
    )


def table(result: Result) -> str:
    """The result as text."""
    return render_table("environment.txt", remarks(result), result=result, **_texts(result))


def remarks(result: Result) -> list[Remark]:
    """Remarks on the result, with their kinds."""
    return render_remarks("environment_remarks.txt", result=result)


def _visits(result: Result) -> list[str]:
    """The estimate of interest where no finite episode decides the formula."""
    return [] if result["acceptance"] in ("cosafe", "safety") else ["visits"]


def _texts(result: Result) -> dict[str, object]:
    """Sentences on learning, evaluation and proof, and the rows of the estimates."""
    world, found = result["environment"], result["evaluation"]
    actions, drawn = world["actions"], result["policy"]["acts"] == "drawn"
    kind = f"{actions} actions" if isinstance(actions, int) else f"actions in a box {actions}"
    acts = "" if result["method"] == "cce" else f" ({'random' if drawn else 'likeliest'} actions)"
    return {
        "sentence": (
            f"{result['method']} in {world['name']}: {kind}, "
            f"{many(result['num_memory'], 'automaton state')}, "
            f"{result['training']['transitions']:,} simulated steps per seed, "
            f"{many(result['seeds']['number'], 'seed')}; {result['policy']['made_of']}"
        ),
        "evaluation": (
            f"{found['num_episodes']:,} fresh episodes of at most {found['num_steps']:,} steps of "
            f"the kept policy{acts}; each interval holds with confidence {found['confidence']:g}."
        ),
        "proof": proof.sentence(result["proof"]) if result.get("proof") else "",
        "estimates": [
            (name.replace("_", " "), *_numbers(name, found), found[name]["method"])
            for name in found["estimates"]
            if _visits(result) or "visits" not in name
        ],
    }


def _numbers(name: str, found: Result) -> tuple[str, str]:
    """An estimate and its interval."""
    value, *ends = (found[name][key] for key in ("mean", "lower", "upper"))
    if name in _PROBABILITIES:
        return probability(value), "[{:.4f}, {:.4f}]".format(*ends)
    return number(value), "[{}, {}]".format(*map(number, ends))


def _tiles(result: Result) -> list[tuple[str, str]]:
    length = "steps until the formula is decided or the episode ends"
    titles = {**{x: x for x in _PROBABILITIES}, "visits": "accepting visits", "length": length}
    rows = (
        (title, *_numbers(name, result["evaluation"]))
        for name, title in titles.items()
        if name != "visits" or _visits(result)
    )
    tiles = [(value, f"{title}, in {interval}") for title, value, interval in rows]
    return [*proof.tiles(result.get("proof") or {}), *tiles]
