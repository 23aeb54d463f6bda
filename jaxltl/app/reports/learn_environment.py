"""Report of learning in an environment: estimates from fresh episodes, with intervals."""

from __future__ import annotations

from jaxltl.app.reports import proof
from jaxltl.app.reports.page import Report, number, probability
from jaxltl.app.wording import Record, Result, many

_PROBABILITIES = ("success", "violation", "undecided")


def _visits(result: Result) -> list[str]:
    """The estimate of interest where no finite episode decides the formula."""
    return [] if result["acceptance"] in ("cosafe", "safety") else ["visits"]


def _values(result: Result) -> Record:
    """Sentences on learning, evaluation and proof, and rows of estimates."""
    world, evaluation = result["environment"], result["evaluation"]
    actions, drawn = world["actions"], result["policy"]["acts"] == "drawn"
    kind = f"{actions} actions" if isinstance(actions, int) else f"actions in a box {actions}"
    acts = "" if result["method"] == "cce" else f" ({'random' if drawn else 'likeliest'} actions)"
    names = (*_PROBABILITIES, *_visits(result))
    seeds = result["seeds"]
    return {
        "tiles": [(name, *_numbers(name, evaluation)) for name in (*names, "length")],
        "bounds": proof.bounds(result.get("proof") or {}),
        "sentence": (
            f"{result['method']} in {world['name']}: {kind}, "
            f"{many(result['num_memory'], 'automaton state')}, "
            f"{result['training']['transitions']:,} simulated steps per seed, "
            f"{many(result['seeds']['number'], 'seed')}; {result['policy']['made_of']}"
        ),
        "evaluation": (
            f"{evaluation['num_episodes']:,} fresh episodes of at most {evaluation['num_steps']:,} steps of "
            f"the kept policy{acts}; each interval holds with confidence {evaluation['confidence']:g}."
        ),
        "proof": proof.sentence(result["proof"]) if result.get("proof") else "",
        "estimates": [
            (name.replace("_", " "), *_numbers(name, evaluation), evaluation[name]["method"])
            for name in evaluation["estimates"]
            if _visits(result) or "visits" not in name
        ],
        "seed_header": ("seed", *names),
        "seed_rows": [
            (
                f"{i}{' (kept)' if i == seeds['kept'] else ''}",
                *(" ".join(_numbers(name, one)) for name in names),
            )
            for i, one in enumerate(seeds["evaluations"])
        ],
    }


def _numbers(name: str, evaluation: Result) -> tuple[str, str]:
    """An estimate and its interval."""
    value, *ends = (evaluation[name][key] for key in ("mean", "lower", "upper"))
    if name in _PROBABILITIES:
        return probability(value), "[{:.4f}, {:.4f}]".format(*ends)
    return number(value), "[{}, {}]".format(*map(number, ends))


report = Report("environment", _values)
