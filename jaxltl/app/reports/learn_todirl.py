"""Report of a transferable reward: satisfaction probabilities in training and test worlds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from jaxltl.app.reports import steps
from jaxltl.app.reports.drawing import Picture
from jaxltl.app.reports.figures import (
    Remark,
    certified,
    mean_deviation,
    number,
    probability,
    remark_lines,
)
from jaxltl.app.reports.page import Part, render_page
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
            (title, result[key], sorted(result[key]["worlds"], key=_mean_value))
            for key, title in titles
            if result[key]
        ],
    )


def _mean_value(world: Result) -> float:
    value = world["mean"]["value"]
    return -1.0 if value is None else value


def table(result: Result) -> str:
    """The result as text."""
    learning, seeds = result["learning"], result["seeds"]
    lines = [
        f"{result['task']}: {_sentence(result)}",
        "",
        f"mean satisfaction probability{_within(result)}",
    ]
    for kind, about in _groups(result):
        noun = f"{kind} world{'' if about['num_counted'] == 1 else 's'}"
        lines.append(f"  in {_number_of_worlds(about)} {noun}")
        for policy, title in _POLICIES.items():
            one = about[policy]
            worst = (
                f"worst {probability(one['worst_world']['value'])} in {one['worst_world']['name']}"
            )
            lines.append(
                f"    {title:30} {probability(one['mean']['value']):>8}   certified "
                f"{certified(one['mean']):15} {worst if about['num_counted'] > 1 else ''}".rstrip()
            )
        if time := about.get("expected_steps"):
            lines += [
                f"    expected steps, {name} {value}, certified {bounds}"
                for name, value, bounds in steps.rows(time)
            ]
            lines[-1] += f" (the largest multiple, in {time['worst_world']})"
            lines += [f"  {line}" for line in steps.trade_off(time)]
        worst_start = probability(about["learned"]["worst_start"])
        lines.append(f"    {'from the worst initial state':30} {worst_start:>8}")
    lines += ["", f"learning  {_how_it_ended(result)}"]
    if learning["held_out"] is not None:
        lines.append(
            f"          negative log-likelihood of a held-out pair {number(learning['held_out'])}"
        )
    if seeds["number"] > 1:
        lines += [
            "",
            f"over {seeds['number']} seeds (the one of the best held-out likelihood is above)",
            f"  training mean  {mean_deviation(seeds['training_mean'])}",
        ]
        if seeds["test_mean"]:
            lines.append(f"  test mean      {mean_deviation(seeds['test_mean'])}")
    return "\n".join([*lines, *remark_lines(remarks(result))])


def _groups(result: Result) -> Iterator[tuple[str, Result]]:
    """The training worlds and, if there are any, the test worlds."""
    for kind in ("training", "test"):
        if result[kind]:
            yield kind, result[kind]


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
        for kind, about in reversed(list(_groups(result)))
        for policy, one in ((policy, about[policy]) for policy in _POLICIES)
    ]


# --- remarks --------------------------------------------------------------------------------


def remarks(result: Result) -> list[Remark]:
    """Remarks on the result, with their kinds."""
    guarantee = result["guarantee"]
    found: list[Remark] = [("warning", text) for text in warnings(result)]
    if guarantee["asked"] == "best":
        text = (
            "By construction: in every world, also in new ones, the policy takes only actions "
            "that preserve the maximal satisfaction probability; the learned reward chooses among "
            f"them. A loss of at most {number(guarantee['loss'])} is certified here for choosing "
            "uniformly."
        )
        found.append(("good", text))
    elif guarantee["asked"] != "none":
        found.append(("good", _attained(result)))
    if result["trivial"]:
        found.append(("note", result["trivial"]))
    if lost := guarantee["left_out"]:
        text = f"{lost} demonstrated steps lower the satisfaction probability and were left out."
        found.append(("note", text))
    return found + steps.unused(guarantee)


def _attained(result: Result) -> str:
    """Sentence on the certified and the requested probability."""
    asked = result["guarantee"]
    over = (
        "on average over initial states"
        if asked["over"] == "mean"
        else "from the worst initial state"
    )
    worlds = [
        world
        for _, about in _groups(result)
        for world in about["worlds"]
        if world["name"] not in about["left_out"]
    ]
    least = min(world["attained"] for world in worlds)
    how = (
        f"the satisfaction probability has the weight mu = {asked['weight']:.3g} in learning"
        if asked["weight"]
        else "the likeliest reward needs no weight"
    )
    mixed = [world["share"] for world in worlds if world["share"]]
    more = ""
    if mixed:
        shares = number(mixed[0]) if len(mixed) == 1 else f"{min(mixed):.3g} to {max(mixed):.3g}"
        more = (
            f", and in {len(mixed)} of {len(worlds)} worlds a share of {shares} of optimal "
            "actions is mixed in"
        )
    return (
        f"Asked for {probability(asked['asked'])} in every world, also in new ones, {over}; "
        f"certified at least {probability(least)} here: {how}{more}."
    )


def warnings(result: Result) -> list[str]:
    """Warnings about the result, with remedies."""
    found = [text for kind, about in _groups(result) for text in _world_warnings(kind, about)]
    learning = result["learning"]
    if learning["solver"] != "CONVERGED":
        found.append(
            f"The solver of soft values ended with {learning['solver']} during learning; a "
            "smaller learning_rate or discount may help."
        )
    improving = learning["best_step"] >= learning["steps"] - 2
    if learning["held_out"] is not None and not learning["stopped_early"] and improving:
        found.append(
            f"The held-out likelihood was still improving after {learning['steps']} steps: raise "
            "steps."
        )
    return found


def _world_warnings(kind: str, about: Result) -> Iterator[str]:
    worlds = {world["name"]: world for world in about["worlds"]}
    for name in about["infeasible"]:
        world, left_out = worlds[name], name in about["left_out"]
        counted = "it is left out" if left_out else "it counts in the mean"
        fix = " unless [test] leave_out names it" if kind == "test" and not left_out else ""
        yield (
            f"No policy can satisfy the formula from {world['infeasible_starts']} of "
            f"{world['num_starts']} initial states of the {kind} world {name}; {counted}{fix}."
        )
    others = [name for name in about["left_out"] if name not in about["infeasible"]]
    if others:
        yield (
            "Left out of the figures as the file demands, though the formula can be satisfied "
            f"there: {', '.join(others)}."
        )
    if about["solver"] != "CONVERGED":
        yield f"The solver of the policies in the {kind} worlds ended with {about['solver']}."
    for policy, title in _POLICIES.items():
        if names := about[policy]["uncertain"]:
            listed = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
            yield (
                f"The probability in the {kind} worlds ({title}) is known only within its bounds "
                f"in {listed}."
            )
