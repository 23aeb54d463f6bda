"""Report of learning in an environment: estimates from fresh episodes, with intervals."""

from __future__ import annotations

from collections.abc import Sequence

from jaxltl.app.reports import proof
from jaxltl.app.reports.drawing import Picture
from jaxltl.app.reports.figures import Remark, number, probability, remark_lines
from jaxltl.app.reports.page import Part, render_page
from jaxltl.app.wording import Result, many


_PROBABILITIES = ("success", "violation", "undecided")


def page(
    result: Result, parts: Sequence[Part], pictures: Sequence[tuple[Picture, bytes]], task_text: str
) -> str:
    """The report in HTML."""
    visits = [] if _is_finite(result) else ["visits"]
    return render_page(
        "environment.html",
        result,
        parts,
        pictures,
        task_text,
        sentence=_sentence(result),
        remarks=remarks(result),
        tiles=_tiles(result),
        evaluation=_evaluation(result),
        proof=proof.sentence(result["proof"]) if result.get("proof") else "",
        estimates=_estimates(result),
        seed_header=("seed", *_PROBABILITIES, *visits),
        seed_rows=_seeds(result),
    )


def table(result: Result) -> str:
    """The result as text."""
    lines = [f"{result['task']}: {_sentence(result)}", "", _evaluation(result)]
    lines += [
        f"  {name:18} {value:>10}  {interval:24} {method}"
        for name, value, interval, method in _estimates(result)
    ]
    if result.get("proof"):
        lines += ["", proof.sentence(result["proof"])]
    seeds = result["seeds"]
    if seeds["number"] > 1:
        each = ", ".join(probability(x["success"]["mean"]) for x in seeds["evaluations"])
        lines += [
            "",
            f"success of {seeds['number']} seeds: {each}; number {seeds['kept']} is "
            "kept, chosen by other episodes",
        ]
    return "\n".join([*lines, *remark_lines(remarks(result))])


def _is_finite(result: Result) -> bool:
    """True if finite episodes can decide the formula, so that visits are of no interest."""
    return result["acceptance"] in ("cosafe", "safety")


def _sentence(result: Result) -> str:
    world, training = result["environment"], result["training"]
    actions = world["actions"]
    kind = f"{actions} actions" if isinstance(actions, int) else f"actions in a box {actions}"
    return (
        f"{result['method']} in {world['name']}: {kind}, "
        f"{many(result['num_memory'], 'automaton state')}, "
        f"{training['transitions']:,} simulated steps per seed, "
        f"{many(result['seeds']['number'], 'seed')}; {result['policy']['made_of']}"
    )


def _evaluation(result: Result) -> str:
    found = result["evaluation"]
    actions = {"drawn": "random actions", "likeliest": "likeliest actions"}
    kind = "" if result["method"] == "cce" else f" ({actions[result['policy']['acts']]})"
    return (
        f"{found['num_episodes']:,} fresh episodes of at most {found['num_steps']:,} steps of the "
        f"kept policy{kind}; each interval holds with confidence {found['confidence']:g}."
    )


def _interval(name: str, entry: Result) -> str:
    if name in _PROBABILITIES:
        return f"[{entry['lower']:.4f}, {entry['upper']:.4f}]"
    return f"[{number(entry['lower'])}, {number(entry['upper'])}]"


def _value(name: str, entry: Result) -> str:
    return (probability if name in _PROBABILITIES else number)(entry["mean"])


def _estimates(result: Result) -> list[tuple[str, str, str, str]]:
    """Name, value, interval and statistical method of each estimate."""
    found = result["evaluation"]
    return [
        (
            name.replace("_", " "),
            _value(name, found[name]),
            _interval(name, found[name]),
            found[name]["method"],
        )
        for name in found["estimates"]
        if not (_is_finite(result) and "visits" in name)
    ]


def _tiles(result: Result) -> list[tuple[str, str]]:
    found = result["evaluation"]
    tiles = [
        (_value(name, found[name]), f"{name}, in {_interval(name, found[name])}")
        for name in _PROBABILITIES
    ]
    if not _is_finite(result):
        entry = found["visits"]
        tiles.append((number(entry["mean"]), f"accepting visits, in {_interval('visits', entry)}"))
    tiles = [*proof.tiles(result.get("proof") or {}), *tiles]
    length = found["length"]
    text = (
        f"steps until the formula is decided or the episode ends, in {_interval('length', length)}"
    )
    return [*tiles, (number(length["mean"]), text)]


def _seeds(result: Result) -> list[tuple[str, ...]]:
    seeds = result["seeds"]
    names = (*_PROBABILITIES, *([] if _is_finite(result) else ["visits"]))
    return [
        (
            f"{i}{' (kept)' if i == seeds['kept'] else ''}",
            *(f"{_value(name, found[name])} {_interval(name, found[name])}" for name in names),
        )
        for i, found in enumerate(seeds["evaluations"])
    ]


def remarks(result: Result) -> list[Remark]:
    """Remarks on the result, with their kinds."""
    found, training = result["evaluation"], result["training"]
    remarks: list[Remark] = [("note", result["trivial"])] if result["trivial"] else []
    if found["threshold"] is not None:
        kind, text = {
            None: ("warning", "It is not decided whether the success probability is"),
            True: ("good", "The success probability is"),
            False: ("warning", "The success probability is not"),
        }[found["decision"]]
        threshold = f"{found['threshold']:g}, with confidence {found['confidence']:g}."
        remarks.append((kind, f"{text} at least {threshold}"))
    if result["acceptance"] == "safety" and found["violation"]["mean"] < 1:
        text = (
            "No finite episode satisfies a safety formula: an undecided episode did not violate "
            f"it in {found['num_steps']:,} steps, or until it was truncated."
        )
        remarks.append(("note", text))
    elif not _is_finite(result) and found["undecided"]["mean"] > 0:
        text = (
            "No finite episode decides this formula: the estimate of interest is the number of "
            "accepting visits."
        )
        remarks.append(("note", text))
    elif found["undecided"]["mean"] > 0.5:
        text = (
            f"{probability(found['undecided']['mean'])} of the episodes end undecided: learn for "
            "more steps, give episodes more time, or shape the reward (shaping in [task])."
        )
        remarks.append(("warning", text))
    if found["status"] == "NONFINITE":
        remarks.append(("warning", "A reward or a cost of an episode is not finite."))
    if training["troubled_rows"]:
        text = (
            f"In {many(training['troubled_rows'], 'reported step')} of the learner a number was "
            "not finite, no step was found, or no action was allowed."
        )
        remarks.append(("warning", text))
    return remarks
