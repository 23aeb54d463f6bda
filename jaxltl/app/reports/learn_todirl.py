"""Report of a transferable reward: satisfaction probabilities in training and test worlds."""

from __future__ import annotations

from collections.abc import Sequence

from jaxltl.app.reports import steps
from jaxltl.app.reports.drawing import Picture
from jaxltl.app.reports.figures import Remark, certified, number, probability
from jaxltl.app.reports.page import Part, render_page, render_remarks, render_table
from jaxltl.app.wording import Result, many


_POLICIES = {
    "learned": "learned reward",
    "expert": "expert, who knows the formula",
    "random": "random actions",
}
_EXPERT = {
    "soft": "The expert knows the formula and is soft-optimal for a reward of it.",
    "quickest": "The expert knows the formula: its policy is the quickest of those with maximal "
    "satisfaction probability.",
}


def page(
    result: Result, parts: Sequence[Part], pictures: Sequence[tuple[Picture, bytes]], task_text: str
) -> str:
    """The report in HTML."""
    titles = (("test", "Test worlds"), ("training", "Training worlds"))

    def mean_value(world: Result) -> float:
        value: float | None = world["mean"]["value"]
        return -1.0 if value is None else value

    return render_page(
        "todirl.html",
        result,
        parts,
        pictures,
        task_text,
        sentence=_sentence(result),
        remarks=remarks(result),
        tiles=_tiles(result),
        within=_within(result),
        evidence=_evidence(result),
        steps=steps,
        expert=_EXPERT[result["expert"]],
        world_tables=[
            (title, result[key], sorted(result[key]["worlds"], key=mean_value))
            for key, title in titles
            if result[key]
        ],
    )


def table(result: Result) -> str:
    """The result as text."""
    return render_table(
        "todirl.txt",
        remarks(result),
        result=result,
        sentence=_sentence(result),
        within=_within(result),
        groups=_groups(result),
        policies=_POLICIES,
        counted=_number_of_worlds,
        ended=_how_it_ended(result),
        steps=steps,
    )


def _groups(result: Result) -> list[tuple[str, Result]]:
    """The training worlds and, if there are any, the test worlds."""
    return [(kind, result[kind]) for kind in ("training", "test") if result[kind]]


def _within(result: Result) -> str:
    preposition = "for" if result["acceptance"] == "safety" else "within"
    return f" {preposition} {result['horizon']} steps" if result["horizon"] else ""


def _number_of_worlds(about: Result) -> str:
    left_out = f" of {about['num_worlds']}" if about["left_out"] else ""
    return f"{about['num_counted']}{left_out}"


def _sentence(result: Result) -> str:
    shown, tests = result["demonstrations"], result["test"]
    kind = "synthetic demonstrations" if shown["synthetic"] else "demonstrations"
    dropped = f", {shown['dropped']} unfinished dropped" if shown["dropped"] else ""
    tested = f", tested in {tests['num_worlds']}" if tests else ""
    return (
        f"todirl in {many(result['training']['num_worlds'], 'world')}{tested}, "
        f"{result['num_memory']} memory states, {sum(shown['number'])} {kind} "
        f"({sum(shown['pairs'])} pairs{dropped})"
    )


def _how_it_ended(result: Result) -> str:
    learning = result["learning"]
    if learning["held_out"] is None:
        return f"{learning['steps']} steps, without held-out demonstrations"
    end = "stopped early" if learning["stopped_early"] else "to the end"
    return (
        f"{learning['steps']} steps, {end}; the parameters after {learning['best_step']} are kept"
    )


def _tiles(result: Result) -> list[tuple[str, str]]:
    training, test, learning = result["training"], result["test"], result["learning"]
    tiles = []
    if test:
        one = test["learned"]
        counted = f"{_number_of_worlds(test)} test worlds"
        tiles += [
            (probability(one["mean"]["value"]), f"mean probability in {counted}"),
            (
                probability(one["worst_world"]["value"]),
                f"in the worst test world, {one['worst_world']['name']}",
            ),
        ]
    held_out = learning["held_out"]
    kind = "loss" if held_out is None else "negative log-likelihood of a held-out pair"
    return [
        *tiles,
        (
            probability(training["learned"]["mean"]["value"]),
            f"mean probability in {many(training['num_counted'], 'training world')}",
        ),
        (
            number(learning["loss"] if held_out is None else held_out),
            f"{kind}; {_how_it_ended(result)}",
        ),
    ]


def _evidence(result: Result) -> list[tuple[str, ...]]:
    return [
        (
            f"{kind}, {policy}",
            probability(one["mean"]["value"]),
            certified(one["mean"]),
            number(one["std"]) if about["num_counted"] > 1 else "",
            f"{probability(one['worst_world']['value'])}, {one['worst_world']['name']}",
            probability(one["worst_start"]),
        )
        for kind, about in reversed(_groups(result))
        for policy in _POLICIES
        for one in [about[policy]]
    ]


def remarks(result: Result) -> list[Remark]:
    """Remarks on the result, with their kinds."""
    groups = _groups(result)
    counted = [x for _, y in groups for x in y["worlds"] if x["name"] not in y["left_out"]]
    found = render_remarks(
        "todirl_remarks.txt",
        result=result,
        groups=groups,
        policies=_POLICIES,
        counted_worlds=counted,
    )
    return found + steps.unused(result["guarantee"])
